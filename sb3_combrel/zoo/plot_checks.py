"""What RL-Zoo's plots would leave out without a word, or show as zeros."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path


def with_evaluations(args: Sequence[str]) -> list[str]:
    """Take algorithms without evaluations, shown as zeros, out of ``all_plots``, and say so; a ValueError if none has any."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for names in (("-a", "--algos"), ("-e", "--env"), ("-f", "--exp-folders")):
        parser.add_argument(*names, nargs="+", default=[])
    given, others = parser.parse_known_args(list(args))
    if not (given.algos and given.env and given.exp_folders):
        return list(args)
    kept = []
    # RL-Zoo has a curve, and a number in its table, for each of them.
    shown = list(itertools.product(given.exp_folders, given.env))
    for algo in given.algos:
        missing = [(folder, env) for folder, env in shown if not _has_evaluations(folder, algo, env)]
        kept += [algo] if len(missing) < len(shown) else []
        becomes = "it is 0.0 in the table" if algo in kept else "it is left out"
        for folder, env in missing:
            _say(f"{algo} has no evaluations of {env} in {folder}: train it first, with --eval-freq; {becomes}")
    if not kept:
        raise ValueError("there is nothing to plot: none of the algorithms has evaluations; names take a hyphen, not a slash")
    return ["-a", *kept, "-e", *given.env, "-f", *given.exp_folders, *others]


def _has_evaluations(folder: str, algo: str, env: str) -> bool:
    return any(env in file.parent.name for file in Path(folder, algo.lower()).glob("*/evaluations.npz"))


def check_window(args: Sequence[str]) -> list[str]:
    """Say which runs ``plot_train`` leaves out, with fewer episodes than its window; a ValueError if all; return ``args``."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-a", "--algo", default="")
    parser.add_argument("-e", "--env", nargs="+", default=[])
    parser.add_argument("-f", "--exp-folder", default="")
    parser.add_argument("-w", "--episode-window", type=int, default=100)
    given, _ = parser.parse_known_args(list(args))
    folders = sorted(Path(given.exp_folder, given.algo).glob("*"))
    n_episodes = {run: _count_episodes(run) for env in given.env for run in folders if env in run.name and run.is_dir()}
    short = {run: n for run, n in n_episodes.items() if n < given.episode_window}
    for run, n in short.items():
        _say(
            f"{run} has {n} episodes, fewer than the window of {given.episode_window}: it is left out; "
            f"-w {max(1, n // 4)} would show it"
        )
    if short and len(short) == len(n_episodes):
        raise ValueError(f"there is nothing to plot: no run has the {given.episode_window} episodes of the window, see -w")
    return list(args)


def _count_episodes(run: Path) -> int:
    # The first two lines are settings and names of columns.
    return sum(max(0, len(file.read_text().splitlines()) - 2) for file in run.glob("*monitor.csv"))


def _say(sentence: str) -> None:
    print(f"sb3_combrel.zoo: {sentence}", file=sys.stderr)
