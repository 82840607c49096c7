"""The configuration files that come with this package, ``zoo_configs/`` of the repository, for who names no other."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_combrel.zoo.registration import ALGORITHMS

HERE = Path(__file__).resolve().parent
#: In an installed package beside this file, in the repository at its top.
FOLDER = HERE / "configs" if (HERE / "configs").is_dir() else HERE.parents[1] / "zoo_configs"


def with_configuration(args: Sequence[str]) -> list[str]:
    """The arguments of ``train``, with ``--conf-file`` where there is none and this package has a file that fits.

    For an algorithm of RL-Zoo's own that is only so if the file has an entry for the very task.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-conf", "--conf-file")
    given, _ = parser.parse_known_args(list(args))
    file = FOLDER / f"{given.algo}.yml"
    if given.conf_file is not None or not file.is_file():
        return list(args)
    if given.algo not in ALGORITHMS:
        import yaml

        if given.env not in yaml.safe_load(file.read_text()):
            return list(args)
    return [*args, "--conf-file", str(file)]
