"""Sources by name: a file of instances, or a task that is learnt once and kept in a file."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import os
import re
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator

from sb3_combrel.sources.source_instances import SourceInstances

CACHE_VARIABLE = "SB3_COMBREL_CACHE"
RENEW_VARIABLE = "SB3_COMBREL_RENEW"
RENEW = "renew"
FITTED_RMAX = "fitted_rmax"
LEARNERS = ("q_learning", FITTED_RMAX)
DEFAULT_RECIPE: Mapping[str, Any] = {"n_instances": 1000, "total_timesteps": 30_000, "seed": 0}
# Files that this process has learned or named: a study of a hundred trials says so once, and learns once.
_SEEN: set[Path] = set()


def check_source(source: Any) -> None:
    """
    Check that a source can be found, without reading or learning it.

    :param source: what :func:`find_source` takes, or a list of such
    :raises FileNotFoundError: if there is neither a file nor a task of that name
    :raises ValueError: if it is something else
    """
    if isinstance(source, SourceInstances):
        return
    if isinstance(source, str | os.PathLike):
        if not _file_of(source) and task_spec(str(source)) is None:
            raise _nothing_there(source)
    elif isinstance(source, Mapping) and source:
        _check_recipe(source)
    elif isinstance(source, Sequence) and len(source) > 0:
        for each in source:
            check_source(each)
    else:
        raise ValueError(
            "source must be SourceInstances, a path to them, or a list of these; or a task to learn them from, the id of an "
            f"environment or a recipe such as {{'env': 'MountainCar-v0'}}, got {source!r}"
        )


def find_source(source: Any) -> SourceInstances:
    """
    Read source instances from a file, or learn a task for them.

    :param source: source instances; the path of a file of them; the id of an environment, learnt with
        :data:`DEFAULT_RECIPE`; or a recipe: a dict with ``env``, the id, and arguments of
        :meth:`~sb3_combrel.SourceInstances.from_q_learning`, or, with ``learner: fitted_rmax``, of
        :meth:`~sb3_combrel.SourceInstances.from_fitted_rmax`
    :raises FileNotFoundError: if there is neither a file nor a task of that name
    :raises ValueError: if it is none of these
    """
    if isinstance(source, SourceInstances):
        return source
    if isinstance(source, Mapping):
        _check_recipe(source)
        default = {**DEFAULT_RECIPE, "total_timesteps": None} if source.get("learner") == FITTED_RMAX else DEFAULT_RECIPE
        return learn_or_read({name: value for name, value in {**default, **source}.items() if value is not None})
    if not isinstance(source, str | os.PathLike):
        raise ValueError(f"source must be a file, the id of an environment or a recipe, got {source!r}")
    file = _file_of(source)
    if file is not None:
        return SourceInstances.load(file)
    if task_spec(str(source)) is not None:
        return learn_or_read({**DEFAULT_RECIPE, "env": str(source)})
    raise _nothing_there(source)


def learn_or_read(recipe: Mapping[str, Any]) -> SourceInstances:
    """
    Learn a task by Q-learning or Fitted R-Max and return instances of it; read them from a file if that was done before.

    A file is of a recipe and of what the environment was: with another class or other arguments, the task is learned again.
    So it is with ``renew: true`` in the recipe, or SB3_COMBREL_RENEW=1 among the environment variables, once in a process.
    What is used, and from when, is printed.

    Processes that start at the same time each learn the task, with the same seed and so with the same result; files are
    written completely or not at all.

    :param recipe: see :func:`find_source`
    :raises ValueError: if the task cannot be learnt so, or ``renew`` is neither True nor False
    """
    arguments = dict(recipe)
    renew = arguments.pop(RENEW, False)
    if not isinstance(renew, bool):
        raise ValueError(f"{RENEW} must be true or false, got {renew!r}")
    file = cache_file(recipe)
    wanted_anew = (renew or os.environ.get(RENEW_VARIABLE, "0") not in ("", "0")) and file not in _SEEN
    env_id = arguments.pop("env")
    learner = arguments.pop("learner", "q_learning")
    if file.is_file() and not wanted_anew:
        source = SourceInstances.load(file)
        if file not in _SEEN:
            _SEEN.add(file)
            print(
                f"Source task {env_id}: {len(source):,} instances learned by {learner} on {_time_of(file)}, from {file} "
                f"({RENEW}: true in the recipe, or {RENEW_VARIABLE}=1, learns them again)"
            )
        return source
    print(f"Learning the source task {env_id} by {learner}{_reason(file)}; kept in {file}")
    try:
        by_model = learner == FITTED_RMAX
        source = (SourceInstances.from_fitted_rmax if by_model else SourceInstances.from_q_learning)(env_id, **arguments)
    except (TypeError, gym.error.Error) as error:
        raise ValueError(f"the source task cannot be learnt by the recipe {dict(recipe)}: {error}") from error
    source.save(file)
    _SEEN.add(file)
    return source


def _time_of(file: Path) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(file.stat().st_mtime))


def _reason(file: Path) -> str:
    """Say why a task is learned although it was learned before; "" if it was not."""
    if file.is_file():
        return f" again, in place of what was learned on {_time_of(file)}"
    recipe = file.stem.rpartition("-")[0]
    before = sorted(file.parent.glob(f"{recipe}-*.npz"), key=lambda each: each.stat().st_mtime)
    if not before:
        return ""
    return f" again: its class or its arguments have changed since {_time_of(before[-1])}"


def fingerprint(env_id: str) -> str:
    """
    Return a text that changes with an environment: with its specification and the source files of its class.

    All base classes count, but for Gymnasium's own, and all modules of the same package that these use, such as one of the
    dynamics.

    :param env_id: id of an environment
    """
    spec = task_spec(env_id)
    if spec is None:
        return ""
    parts = [f"{spec.entry_point}", repr(sorted(spec.kwargs.items(), key=str)), f"{spec.max_episode_steps}"]
    parts.append(repr(spec.additional_wrappers))
    try:
        made = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    except (ImportError, AttributeError):
        return _digest(parts)
    classes = inspect.getmro(made) if inspect.isclass(made) else (made,)
    modules = {each.__module__ for each in classes} - {"builtins", "typing", "abc", "gymnasium.core"}
    package = str(getattr(made, "__module__", "")).partition(".")[0]
    parts += [_text_of(name) for name in sorted(modules | _imported(modules, package))]
    return _digest(parts)


def _imported(modules: set[str], package: str) -> set[str]:
    """Modules of the same package that the given ones use, directly or not."""
    found: set[str] = set()
    open_ = {name for name in modules if name.partition(".")[0] == package and package != "gymnasium"}
    while open_:
        module = sys.modules.get(open_.pop())
        for value in list(vars(module).values()) if module is not None else []:
            name = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None)
            if isinstance(name, str) and name.partition(".")[0] == package and name not in found | modules:
                found.add(name)
                open_.add(name)
    return found


def _text_of(module: str) -> str:
    file = getattr(sys.modules.get(module), "__file__", None)
    try:
        return Path(file).read_text() if file else module
    except (OSError, UnicodeDecodeError):
        return module


def _digest(parts: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def cache_file(recipe: Mapping[str, Any]) -> Path:
    """
    Return the file for the instances of a recipe, in the folder SB3_COMBREL_CACHE (a variable), or ~/.cache/sb3_combrel.

    :param recipe: see :func:`learn_or_read`
    """
    folder = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "sb3_combrel")
    text = json.dumps({key: value for key, value in recipe.items() if key != RENEW}, sort_keys=True, default=str)
    name = re.sub(r"\W+", "-", str(recipe["env"]))
    return folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}-{fingerprint(str(recipe['env']))}.npz"


def _check_recipe(recipe: Mapping[str, Any]) -> None:
    if not isinstance(recipe.get("env"), str):
        raise ValueError(f"the recipe of a source needs 'env', the id of its task, got {dict(recipe)!r}")
    learner = recipe.get("learner", LEARNERS[0])
    if learner not in LEARNERS:
        raise ValueError(f"the recipe's learner must be {' or '.join(LEARNERS)}, got {learner!r}")


def _file_of(source: str | os.PathLike[str]) -> Path | None:
    path = Path(source)
    with_suffix = path.with_name(path.name + ".npz") if path.name else path
    return next((file for file in (path, with_suffix) if file.is_file()), None)


def _nothing_there(source: object) -> FileNotFoundError:
    file = Path(str(source) or "source").with_suffix(".npz")
    return FileNotFoundError(
        f"there is no source file {source}, looked for in {Path.cwd()}, and no environment of that name; write one with "
        f"SourceInstances.record(...).save({str(file)!r}), or: sb3-combrel record combrel/MountainCar2D-v0 --output {file}"
    )


def task_spec(name: str) -> EnvSpec | None:
    """
    Find the environment of an id; a module before a colon is imported first, as by ``gymnasium.make``.

    :param name: the id; those of this project need no import of ``combrel_envs``
    :return: None if there is none
    """
    module, _, env_id = f"combrel_envs:{name}".rpartition(":") if name.startswith("combrel/") else name.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        return gym.spec(env_id)
    except (gym.error.Error, ImportError, ValueError):
        return None
