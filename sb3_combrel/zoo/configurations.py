"""The configuration files that come with this package, ``zoo_configs/`` of the repository, for who names no other."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from sb3_combrel.zoo.registration import ALGORITHMS

# With an exponent, but without a point or the exponent's sign, which YAML takes for text.
NUMBER = re.compile(r"[+-]?\d+(\.\d*)?[eE][+-]?\d+")
HERE = Path(__file__).resolve().parent
#: In an installed package beside this file, in the repository at its top.
FOLDER = HERE / "configs" if (HERE / "configs").is_dir() else HERE.parents[1] / "zoo_configs"


def with_configuration(args: Sequence[str]) -> list[str]:
    """The arguments of ``train``, with ``--conf-file`` where there is none and this package has a file that fits.

    For an algorithm of RL-Zoo's own that is only so if the file has an entry for the very task.
    """
    # With abbreviations, such as --conf, as RL-Zoo's own parser takes them.
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    given, _ = parser.parse_known_args(list(args))
    if given.conf_file is not None:
        if Path(given.conf_file).is_file():
            check_configuration(Path(given.conf_file))
        return list(args)
    file = FOLDER / f"{given.algo}.yml"
    if not file.is_file():
        return list(args)
    if given.algo not in ALGORITHMS:
        import yaml

        if given.env not in yaml.safe_load(file.read_text()):
            return list(args)
    # Before the others: of an option that is given twice the last counts, so the user's file does, however it is spelt.
    return ["--conf-file", str(file), *args]


def check_configuration(file: Path) -> None:
    """:raises ValueError: if a YAML file has no settings by name for each task, or numbers that YAML takes for text"""
    import yaml

    if file.suffix not in (".yml", ".yaml"):
        return
    found = yaml.safe_load(file.read_text())
    if not isinstance(found, dict):
        raise ValueError(f"{file} must have an entry for each task, such as CartPole-v1: {{n_timesteps: 5000}}, got {found!r}")
    for task, settings in found.items():
        if not isinstance(settings, dict):
            raise ValueError(f"{file}: {task} must have settings by name, such as n_timesteps: 5000, got {settings!r}")
        for name, value in settings.items():
            if isinstance(value, str) and NUMBER.fullmatch(value):
                right = "YAML wants a point and a sign, such as 1.0e-3 or 1.0e+3"
                raise ValueError(f"{file}: {task}: {name} must be a number, got {value!r}, which is text: {right}")
