"""RL-Zoo's commands, with this package's algorithms in its tables."""

from __future__ import annotations

import importlib
import itertools
import runpy
import subprocess
import sys
from collections.abc import Sequence
from typing import Any
from unittest import mock

import gymnasium

from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.zoo.configurations import with_configuration
from sb3_combrel.zoo.plot_checks import check_window, with_evaluations

PROGRAM = "python -m sb3_combrel.zoo"
# Packages of the extra "zoo".
OF_EXTRA = ("huggingface_hub", "huggingface_sb3", "matplotlib", "optuna", "pandas", "rl_zoo3", "sb3_contrib", "seaborn")
# What a configuration or an argument causes.
USERS_ERRORS = (ValueError, AssertionError, OSError, ImportError, gymnasium.error.Error)
FUNCTIONS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "plot_train": "rl_zoo3.plots.plot_train",
    "all_plots": "rl_zoo3.plots.all_plots",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
}
"""Commands that are functions, by the module that has them."""
SCRIPTS = {
    "record_video": "rl_zoo3.record_video",
    "record_training": "rl_zoo3.record_training",
    "benchmark": "rl_zoo3.benchmark",
    "push_to_hub": "rl_zoo3.push_to_hub",
    "load_from_hub": "rl_zoo3.load_from_hub",
}
"""Commands that are scripts and do their work as ``__main__`` only; they know no ``--gym-packages``."""
CHECKS = {"train": with_configuration, "all_plots": with_evaluations, "plot_train": check_window}
"""What completes the arguments of a command, or refuses those by which it would draw nothing, or zeros, and say nothing."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one of RL-Zoo's commands; an error is reported in one sentence, with ``--verbose 2`` as a traceback.

    :return: exit status: 0, or 1 if something was wrong, or 2 if there is no such command
    """
    command, *rest = list(sys.argv[1:] if args is None else args) or ["--help"]
    if command not in FUNCTIONS | SCRIPTS:
        close = did_you_mean(command, FUNCTIONS | SCRIPTS)
        print(f"usage: {PROGRAM} {{{','.join(FUNCTIONS | SCRIPTS)}}} ...   (each has --help){close}")
        return 0 if command in ("-h", "--help") else 2
    try:
        if command in CHECKS:
            rest = CHECKS[command](rest)
        return _run(command, rest)
    except Exception as error:
        if _is_verbose(rest) or not (isinstance(error, USERS_ERRORS) or _comes_from("yaml", error) or _is_of_network(error)):
            raise
        entry = "; add an entry for the task, with policy and transfer, to a file of your own, and pass --conf-file"
        advice = entry if "Hyperparameters not found" in str(error) else ""
        print(f"sb3_combrel.zoo: {_message_of(error)}{advice}", file=sys.stderr)
        return 1


def _run(command: str, args: list[str]) -> int:
    from sb3_combrel.zoo import hub
    from sb3_combrel.zoo.registration import register

    register()
    with mock.patch.object(sys, "argv", [f"{PROGRAM} {command}", *args]):
        if command in FUNCTIONS:
            getattr(importlib.import_module(FUNCTIONS[command]), command)()
        elif command in hub.COMMANDS:
            with hub.mended():
                _run_script(command)
        else:
            _run_script(command)
    return 0


def _run_script(command: str) -> None:
    packages, sys.argv[1:] = _without_gym_packages(sys.argv[1:])
    for package in packages:
        importlib.import_module(package)
    import rl_zoo3.utils

    trained_models, real_call = rl_zoo3.utils.get_trained_models, subprocess.call

    def by_file_name(log_folder: str) -> dict[str, tuple[str, Any]]:
        """Find runs by file name: RL-Zoo's benchmark uses the id of their task, which is none if it has a namespace."""
        from huggingface_sb3 import EnvironmentName

        return {name: (algo, EnvironmentName(env_id)) for name, (algo, env_id) in trained_models(log_folder).items()}

    def enjoy_here(call: Any, **options_of_call: Any) -> int:
        """Replace the call of ``python enjoy.py``, which exists in a clone of RL-Zoo only, by this package's ``enjoy``."""
        if list(call[:2]) != ["python", "enjoy.py"]:
            return real_call(call, **options_of_call)
        arguments = [str(getattr(argument, "gym_id", argument)) for argument in call[2:]]
        options = ["--gym-packages", *packages] if packages else []
        return subprocess.run([sys.executable, "-m", "sb3_combrel.zoo", "enjoy", *arguments, *options], check=False).returncode

    with (
        mock.patch.object(rl_zoo3.utils, "get_trained_models", by_file_name),
        mock.patch.object(subprocess, "call", enjoy_here),
    ):
        runpy.run_module(SCRIPTS[command], run_name="__main__")


def _without_gym_packages(args: list[str]) -> tuple[list[str], list[str]]:
    """Separate the packages after ``--gym-packages`` from the other arguments."""
    if "--gym-packages" not in args:
        return [], args
    at = args.index("--gym-packages")
    end = next((i for i in range(at + 1, len(args)) if args[i].startswith("-")), len(args))
    return args[at + 1 : end], args[:at] + args[end:]


def _comes_from(package: str, error: BaseException) -> bool:
    return type(error).__module__.partition(".")[0] == package


def _is_of_network(error: BaseException) -> bool:
    """Return whether an error, or one that caused it, says that another machine cannot be reached."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, ConnectionError):
            return True
        if any(_comes_from(package, seen) for package in ("requests", "httpx", "httpcore", "urllib3")):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def _message_of(error: Exception) -> str:
    if _is_of_network(error):
        reason = " ".join(str(error).split()) or type(error).__name__
        return f"the Hugging Face hub cannot be reached (benchmark does without it by --no-hub): {reason}"
    if isinstance(error, gymnasium.error.NameNotFound | gymnasium.error.NamespaceNotFound):
        return f"{error}\nIf a package of yours registers it, name that: --gym-packages my_package"
    if isinstance(error, ModuleNotFoundError) and error.name in OF_EXTRA:
        return f"{error}; what RL-Zoo's commands need comes with: pip install 'sb3-combrel[zoo]'"
    return str(error) or type(error).__name__


def _is_verbose(args: list[str]) -> bool:
    return any(a == "--verbose" and b.isdigit() and int(b) >= 2 for a, b in itertools.pairwise(args))
