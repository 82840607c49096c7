"""The episodes of several runs of one method, as arrays."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_combrel.common.checks import check_count
from sb3_combrel.runs.job import Result

#: Monitor logs of Stable-Baselines3 end in this.
MONITOR_SUFFIX = "monitor.csv"


@dataclass(frozen=True, eq=False)
class LearningCurves:
    """The episodes of several runs of one method, from the first on.

    Runs may have different numbers of episodes: what is left of a row is NaN, in both arrays. :meth:`from_rows` fills it in.

    :param returns: undiscounted return of each episode, shape (n_runs, n_episodes)
    :param steps: environment steps of each episode, whole numbers of at least 1, shape (n_runs, n_episodes)
    :raises ValueError: if shapes or values are others, or a run has no episode
    """

    returns: np.ndarray
    steps: np.ndarray

    def __post_init__(self) -> None:
        returns, steps = (np.array(values, dtype=np.float64) for values in (self.returns, self.steps))
        if returns.ndim != 2 or not returns.size:
            raise ValueError(f"returns must have shape (n_runs, n_episodes), at least one of each, got {returns.shape}")
        if steps.shape != returns.shape:
            raise ValueError(f"steps must have the shape of returns, {returns.shape}, got {steps.shape}")
        played = ~np.isnan(returns)
        _refuse("returns", returns, ~played[:, :1], "a number for the first episode of every run")
        _refuse("returns", returns, played[:, 1:] & ~played[:, :-1], "NaN only after the last episode of a run")
        _refuse("returns", returns, np.isinf(returns), "finite")
        _refuse("steps", steps, np.isnan(steps) == played, "NaN where returns are, and nowhere else")
        _refuse("steps", steps, played & ~((steps >= 1) & (steps == np.floor(steps)) & ~np.isinf(steps)), "whole, at least 1")
        object.__setattr__(self, "returns", returns)
        object.__setattr__(self, "steps", steps)

    @classmethod
    def from_rows(cls, returns: Sequence[Sequence[float]], steps: Sequence[Sequence[float]]) -> LearningCurves:
        """Make them of runs that may have different numbers of episodes.

        :param returns: for each run, the return of each episode
        :param steps: for each run, the environment steps of each episode
        :raises ValueError: if numbers of runs or episodes differ, a run has no episode, or values are not allowed
        """
        lengths = [len(row) for row in returns]
        if lengths != [len(row) for row in steps]:
            raise ValueError(f"steps must have as many episodes as returns, {lengths}, got {[len(row) for row in steps]}")
        if 0 in lengths or not lengths:
            raise ValueError(f"returns must have runs of at least one episode, got {lengths} episodes")
        filled = np.full((2, len(lengths), max(lengths)), np.nan)
        for run, length in enumerate(lengths):
            filled[:, run, :length] = returns[run], steps[run]
        return cls(*filled)

    @property
    def n_episodes(self) -> np.ndarray:
        """Number of episodes of each run, shape (n_runs,)."""
        return (~np.isnan(self.returns)).sum(axis=1)

    @property
    def n_steps(self) -> np.ndarray:
        """Environment steps of each run, shape (n_runs,)."""
        return np.nansum(self.steps, axis=1)

    def first_episodes(self, n: int | None = None) -> LearningCurves:
        """The first episodes of each run.

        :param n: their number; None: as many as the shortest run has
        :raises ValueError: if a run has fewer
        """
        n = episodes_of_all("n", n, self)
        return LearningCurves(self.returns[:, :n], self.steps[:, :n])


def curves_of(runs: Iterable[Result]) -> LearningCurves:
    """Return the learning curves of some runs, at least one, in their order."""
    runs = list(runs)
    return LearningCurves.from_rows([run.returns for run in runs], [run.steps for run in runs])


def episodes_of_all(name: str, n: int | None, curves: LearningCurves) -> int:
    """Return a number of episodes that every run has: ``n``, or that of the shortest run."""
    shortest = int(curves.n_episodes.min())
    if n is None:
        return shortest
    check_count(name, n, max=shortest, why_max="as many as the shortest run has")
    return n


def returns_over_steps(curves: LearningCurves, at: np.ndarray) -> np.ndarray:
    """Return the return of the episode under way after ``at`` steps, fewer than the shortest run has: (n_runs, n_points)."""
    ends = np.cumsum(np.nan_to_num(curves.steps), axis=1)
    rows = zip(curves.returns, ends, curves.n_episodes, strict=True)
    return np.array([returns[np.searchsorted(end[:n], at, side="right")] for returns, end, n in rows])


def moving_average(samples: np.ndarray, window: int) -> np.ndarray:
    """Compute the mean of ``window`` successive episodes, or of all if fewer: shape (n_runs, n_episodes - window + 1)."""
    window = min(window, samples.shape[1])
    return np.lib.stride_tricks.sliding_window_view(samples.astype(np.float64), window, axis=1).mean(axis=-1)


def read_monitor_logs(paths: str | Path | Sequence[str | Path]) -> LearningCurves:
    """Read what Stable-Baselines3's Monitor has written.

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
    frames = []
    for files in runs:
        episodes = pd.concat([_read_monitor_file(file) for file in files])
        if episodes.empty:
            raise ValueError(f"{files[0]} has no episode: paths must name runs of at least one")
        # Not within one file: if learning was resumed into it, its times have started again.
        frames.append(episodes.sort_values("t", kind="stable") if len(files) > 1 else episodes)
    return LearningCurves.from_rows([frame["r"].tolist() for frame in frames], [frame["l"].tolist() for frame in frames])


def _monitor_files(path: Path) -> list[Path]:
    """The Monitor files of a folder by name, or the file itself."""
    if path.is_file():
        return [path]
    files = sorted(path.glob(f"*{MONITOR_SUFFIX}"))
    if not files:
        what = f"has no file *{MONITOR_SUFFIX}" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {what}: paths must name Monitor logs or folders that have them")
    return files


def _read_monitor_file(file: Path) -> pd.DataFrame:
    """Return, steps and time of the end in seconds since 1970 of each episode."""
    try:
        header, _, rows = file.read_text().partition("\n")
        start = float(json.loads(header.removeprefix("#"))["t_start"])
        frame = pd.read_csv(io.StringIO(rows))[["r", "l", "t"]].astype(np.float64)
        if not np.isfinite(frame).all(axis=None):
            raise ValueError("not finite")
        if not rows.endswith("\n"):
            raise ValueError("the last line has no end")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} must be a Monitor log: a line of JSON, then columns r, l, t; got {error!r}") from error
    return frame.assign(t=frame["t"] + start)


def _refuse(name: str, values: np.ndarray, wrong: np.ndarray, right: str) -> None:
    """Raise an error that names the first value that is wrong."""
    if wrong.any():
        run, episode = np.argwhere(wrong)[0]
        raise ValueError(f"{name} must be {right}, got {values[run, episode]} in run {run}, episode {episode}")
