"""Learning curves from what Stable-Baselines3's Monitor has written."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_combrel.experiments.learning_curves import LearningCurves

#: Monitor logs of Stable-Baselines3 end in this.
MONITOR_SUFFIX = "monitor.csv"


def read_monitor_logs(paths: str | Path | Sequence[str | Path]) -> LearningCurves:
    """
    Read what Stable-Baselines3's Monitor has written, without pandas.

    :param paths: a folder: each ``*monitor.csv`` in it is a run, in order of their names. Or a list, each entry a run: a
        Monitor file, or a folder whose Monitor files belong to the parallel environments of one run, so their episodes are
        merged in order of time as by :func:`stable_baselines3.common.monitor.load_results`
    :return: runs with all their episodes; ``.first_episodes()`` cuts them to the shortest
    :raises FileNotFoundError: if there is no such file, or no Monitor file in a folder
    :raises ValueError: if a file is not a Monitor log or ends in the middle of a line, or a run has no episode
    """
    if isinstance(paths, str | Path):
        runs = [[file] for file in _monitor_files(Path(paths))]
    else:
        runs = [_monitor_files(Path(path)) for path in paths]
    if not runs:
        raise ValueError(f"paths must be a folder or a list of at least one Monitor file or folder, got {paths!r}")
    episodes = [_episodes_of_run(files) for files in runs]
    return LearningCurves.from_rows(
        [[episode.total for episode in run] for run in episodes], [[episode.steps for episode in run] for run in episodes]
    )


class _Episode(NamedTuple):
    """Return, environment steps, and time of the end in seconds since 1970."""

    total: float
    steps: float
    end: float


def _episodes_of_run(files: Sequence[Path]) -> list[_Episode]:
    """
    Return the episodes of a run in order of time.

    :param files: the Monitor files of its parallel environments
    """
    episodes = [episode for file in files for episode in _read_monitor_file(file)]
    if len(files) > 1:
        # Not within one file: if learning was resumed into it, its times have started again.
        episodes.sort(key=lambda episode: episode.end)
    if not episodes:
        raise ValueError(f"{files[0]} has no episode: paths must name runs of at least one")
    return episodes


def _monitor_files(path: Path) -> list[Path]:
    """Return the Monitor files of a folder by name, or the file itself."""
    if path.is_file():
        return [path]
    files = sorted(path.glob(f"*{MONITOR_SUFFIX}"))
    if not files:
        what = f"has no file *{MONITOR_SUFFIX}" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {what}: paths must name Monitor logs or folders that have them")
    return files


def _read_monitor_file(file: Path) -> list[_Episode]:
    episodes: list[_Episode] = []
    try:
        header, _, rows = file.read_text().partition("\n")
        start = float(json.loads(header.removeprefix("#"))["t_start"])
        for row in csv.DictReader(io.StringIO(rows)):
            episode = _Episode(float(row["r"]), float(row["l"]), start + float(row["t"]))
            if not np.isfinite(episode).all():
                raise ValueError(f"not finite: {tuple(episode)}")
            episodes.append(episode)
        if rows and not rows.endswith("\n"):
            raise ValueError("the last line has no end")
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        what = f"got {error!r} after {len(episodes)} episodes"
        raise ValueError(f"{file} must be a Monitor log: a line of JSON, then columns r, l, t; {what}") from error
    return episodes
