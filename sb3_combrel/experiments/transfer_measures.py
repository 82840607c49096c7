"""
Measures of transfer: what learning with transfer gains over learning without it.

The five of Taylor & Stone, "Transfer Learning for Reinforcement Learning Domains: A Survey", JMLR 10, 2009: jumpstart,
asymptotic performance, total reward, transfer ratio, time to threshold. Performance is the undiscounted return of an episode
of learning, exploration included; time is environment steps, of all environments of a run together. Steps spent on learning
source tasks do not count.

From Monitor logs of Stable-Baselines3, one file a run::

    measures = compare_learning(read_monitor_logs("logs/combrel"), read_monitor_logs("logs/no_transfer"), threshold=-200)
    print(measures.jumpstart.effect, measures.time_to_threshold.p_value)
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite
from sb3_combrel.experiments.bootstrap import Difference, bootstrap_difference, bootstrap_relative_difference
from sb3_combrel.experiments.effect_sizes import cliffs_delta, hedges_g
from sb3_combrel.experiments.statistics import area_under_curve, episodes_to_reach, p_value_of_difference

#: Monitor logs of Stable-Baselines3 end in this.
MONITOR_SUFFIX = "monitor.csv"


@dataclass(frozen=True, eq=False)
class LearningCurves:
    """
    The episodes of several runs of one method, from the first on.

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
        """
        Make them of runs that may have different numbers of episodes.

        :param returns: for each run, the return of each episode
        :param steps: for each run, the environment steps of each episode
        :raises ValueError: if the numbers of runs or of episodes differ, a run has no episode, or values are not allowed
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
        """
        The first episodes of each run.

        :param n: their number; None: as many as the shortest run has
        :raises ValueError: if a run has fewer
        """
        n = _episodes_of_all("n", n, self)
        return LearningCurves(self.returns[:, :n], self.steps[:, :n])


class LearningMeasures(NamedTuple):
    """
    What is measured of each run of one method, each of shape (n_runs,).

    :param initial_return: see :func:`initial_return`; higher is better
    :param asymptotic_return: see :func:`asymptotic_return`; higher is better
    :param total_reward: see :func:`total_reward`; higher is better
    :param total_reward_by_steps: see :func:`total_reward_by_steps`; higher is better
    :param time_to_threshold: see :func:`time_to_threshold`; lower is better; None without a threshold
    """

    initial_return: np.ndarray
    asymptotic_return: np.ndarray
    total_reward: np.ndarray
    total_reward_by_steps: np.ndarray
    time_to_threshold: np.ndarray | None


class Comparison(NamedTuple):
    """
    A measure of runs with transfer against runs without.

    :param with_transfer: the measure of each run with transfer, shape (n_with,)
    :param without: of each run without, shape (n_without,)
    :param effect: what transfer adds: below 0 if it lowers the measure
    :param low: lower bound of the effect's 95% bootstrap interval; NaN where there is none
    :param high: upper bound
    :param p_value: two-sided; NaN with fewer than two runs of either
    :param hedges_g: see :func:`~sb3_combrel.experiments.effect_sizes.hedges_g`; above 0 if the measure is higher with transfer
    :param cliffs_delta: see :func:`~sb3_combrel.experiments.effect_sizes.cliffs_delta`; likewise
    :param higher_is_better: whether an effect above 0 is a gain
    """

    with_transfer: np.ndarray
    without: np.ndarray
    effect: float
    low: float
    high: float
    p_value: float
    hedges_g: float
    cliffs_delta: float
    higher_is_better: bool = True


class TransferMeasures(NamedTuple):
    """
    Taylor & Stone's measures of transfer, see :func:`compare_learning`.

    :param jumpstart: difference of the mean returns at the start, in units of return
    :param asymptotic_performance: difference of the mean returns at the end, in units of return
    :param total_reward: difference of the mean areas under the returns of episodes, in units of return
    :param total_reward_by_steps: difference of the mean areas under returns over environment steps, in return times steps
    :param transfer_ratio: ``total_reward`` as a fraction of the mean area without transfer, above the floor
    :param transfer_ratio_by_steps: the same of ``total_reward_by_steps``
    :param time_to_threshold: difference of the median environment steps until the threshold; below 0 is a gain; None without a
        threshold
    :param floor: the return above which the areas of the ratios were measured
    """

    jumpstart: Comparison
    asymptotic_performance: Comparison
    total_reward: Comparison
    total_reward_by_steps: Comparison
    transfer_ratio: Comparison
    transfer_ratio_by_steps: Comparison
    time_to_threshold: Comparison | None
    floor: float


def initial_return(curves: LearningCurves, n_first: int = 5) -> np.ndarray:
    """
    Compute the mean return of the first episodes of each run: with transfer minus without it is the jumpstart.

    :param n_first: number of episodes; the fewer, the less of learning is in it, and the more of chance
    :return: shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_first = _episodes_of_all("n_first", n_first, curves)
    return curves.returns[:, :n_first].mean(axis=1)


def asymptotic_return(curves: LearningCurves, n_last: int = 10) -> np.ndarray:
    """
    Compute the mean return of the last episodes of each run, each run's own: the asymptote if learning has ended by then.

    :param n_last: number of episodes
    :return: shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_last = _episodes_of_all("n_last", n_last, curves)
    last = curves.n_episodes[:, None] - np.arange(n_last, 0, -1)
    return np.take_along_axis(curves.returns, last, axis=1).mean(axis=1)


def total_reward(curves: LearningCurves, n_episodes: int | None = None) -> np.ndarray:
    """
    Compute the reward that each run collects, the area under its returns with every episode of width 1.

    :param n_episodes: count so many episodes; None: as many as the shortest run has
    :return: in units of return, shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_episodes = _episodes_of_all("n_episodes", n_episodes, curves)
    return area_under_curve(curves.returns[:, :n_episodes])


def total_reward_by_steps(curves: LearningCurves, n_steps: int | None = None) -> np.ndarray:
    """
    Compute the area under each run's returns over environment steps: every episode is as wide as it has steps.

    To prefer where episodes differ in length, for it compares runs after the same experience. It is not the reward collected
    in so many steps: where each step costs 1, that is the same for all methods.

    :param n_steps: environment steps from the start; an episode that lies across them counts in part; None: as many as the
        shortest run has
    :return: in units of return times steps, shape (n_runs,); divided by ``n_steps`` it is the mean return over time
    :raises ValueError: if a run has fewer steps
    """
    fewest = int(curves.n_steps.min())
    n_steps = fewest if n_steps is None else n_steps
    check_count("n_steps", n_steps, max=fewest, why_max="as many as the shortest run has")
    steps = np.nan_to_num(curves.steps)
    starts = np.cumsum(steps, axis=1) - steps
    return area_under_curve(np.nan_to_num(curves.returns), np.clip(n_steps - starts, 0.0, steps))


def time_to_threshold(curves: LearningCurves, threshold: float, window: int = 5) -> np.ndarray:
    """
    Count the environment steps of each run until the median return of its last ``window`` episodes is at least ``threshold``.

    A run that never reaches it is right-censored: its time is inf, and says no more than that it needs longer than the run
    lasted. So runs should last equally long, or all until well after the threshold.

    :param threshold: a return
    :param window: number of episodes
    :return: shape (n_runs,)
    :raises ValueError: if the threshold is not finite, or the window has no episode
    """
    check_finite("threshold", threshold)
    check_count("window", window)
    times = np.full(len(curves.returns), np.inf)
    for run, n_played in enumerate(curves.n_episodes):
        # Returns that are high enough are, with the other sign, low enough.
        n_needed = episodes_to_reach(-curves.returns[run : run + 1, :n_played], -threshold, window)[0]
        if np.isfinite(n_needed):
            times[run] = curves.steps[run, : int(n_needed)].sum()
    return times


def measure_learning(
    curves: LearningCurves,
    *,
    threshold: float | None = None,
    n_first: int = 5,
    n_last: int = 10,
    window: int = 5,
    n_episodes: int | None = None,
    n_steps: int | None = None,
) -> LearningMeasures:
    """
    Compute all measures of each run of one method.

    :param threshold: see :func:`time_to_threshold`; None: do not compute it
    :param n_first: see :func:`initial_return`
    :param n_last: see :func:`asymptotic_return`
    :param window: see :func:`time_to_threshold`
    :param n_episodes: see :func:`total_reward`
    :param n_steps: see :func:`total_reward_by_steps`
    :raises ValueError: if a run is shorter than these ask for
    """
    return LearningMeasures(
        initial_return(curves, n_first),
        asymptotic_return(curves, n_last),
        total_reward(curves, n_episodes),
        total_reward_by_steps(curves, n_steps),
        None if threshold is None else time_to_threshold(curves, threshold, window),
    )


def compare_learning(
    with_transfer: LearningCurves,
    without: LearningCurves,
    *,
    threshold: float | None = None,
    n_first: int = 5,
    n_last: int = 10,
    window: int = 5,
    floor: float | None = None,
    n_steps: int | None = None,
    n_resamples: int = 2000,
    seed: int = 0,
) -> TransferMeasures:
    """
    Compute Taylor & Stone's measures of transfer, with 95% bootstrap intervals, p-values and effect sizes.

    Each is with transfer minus without. Areas end where the shortest run of both does, in episodes or in environment steps;
    the asymptotic performance and the time to threshold use all episodes of every run. Effects are differences of means,
    tested by permutation; only that on the time to threshold is a difference of medians, for times may be infinite, with the
    test by Mann and Whitney, whose question is whether the times of one method tend to be lower.

    The transfer ratio is (area with transfer - area without) / area without. For areas that may be negative that has no
    meaning, so areas are measured above ``floor``. The ratio depends on it (a floor further down makes ratios smaller), so
    compare only ratios of one floor: if the lowest return that the task allows is known, give that. The ratio has the p-value
    of the total reward, for they are 0 together. The interval takes the floor as given, also where it comes from the runs.

    :param with_transfer: the runs with transfer
    :param without: the runs without, independent of them
    :param threshold: see :func:`time_to_threshold`; None: do not compute it
    :param n_first: see :func:`initial_return`
    :param n_last: see :func:`asymptotic_return`
    :param window: see :func:`time_to_threshold`
    :param floor: a return that no counted episode is below; None: the lowest return of any run of both, or 0 if none is
        negative, which is Taylor & Stone's definition
    :param n_steps: environment steps that areas over steps are measured on; None: as many as the shortest run of both has
    :param n_resamples: draws of the bootstrap
    :param seed: of the bootstrap and of the permutation tests
    :raises ValueError: if a run is shorter than these ask for, or a return is below the floor
    """
    both = (with_transfer, without)
    n_episodes = min(int(curves.n_episodes.min()) for curves in both)
    n_steps = min(int(curves.n_steps.min()) for curves in both) if n_steps is None else n_steps
    floor = _checked_floor(floor, min(float(np.nanmin(curves.returns)) for curves in both))
    of_with, of_without = (
        measure_learning(
            curves,
            threshold=threshold,
            n_first=n_first,
            n_last=n_last,
            window=window,
            n_episodes=n_episodes,
            n_steps=n_steps,
        )
        for curves in both
    )

    def compare(
        first: np.ndarray, second: np.ndarray, difference: Callable[..., Difference] = bootstrap_difference
    ) -> Comparison:
        p_value = p_value_of_difference(first, second, "permutation", seed)
        estimate = difference(first, second, n_resamples=n_resamples, seed=seed)
        return Comparison(first, second, *estimate, p_value, hedges_g(first, second), cliffs_delta(first, second))

    def ratio(first: np.ndarray, second: np.ndarray, width: int) -> Comparison:
        # Rounding may leave a run that never rose above the floor just below it.
        above = [np.maximum(area - floor * width, 0.0) for area in (first, second)]
        return compare(above[0], above[1], bootstrap_relative_difference)

    return TransferMeasures(
        jumpstart=compare(of_with.initial_return, of_without.initial_return),
        asymptotic_performance=compare(of_with.asymptotic_return, of_without.asymptotic_return),
        total_reward=compare(of_with.total_reward, of_without.total_reward),
        total_reward_by_steps=compare(of_with.total_reward_by_steps, of_without.total_reward_by_steps),
        transfer_ratio=ratio(of_with.total_reward, of_without.total_reward, n_episodes),
        transfer_ratio_by_steps=ratio(of_with.total_reward_by_steps, of_without.total_reward_by_steps, n_steps),
        time_to_threshold=_compare_times(of_with.time_to_threshold, of_without.time_to_threshold, n_resamples, seed),
        floor=floor,
    )


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
    rows = []
    for files in runs:
        episodes = [episode for file in files for episode in _read_monitor_file(file)]
        if len(files) > 1:
            # Not within one file: if learning was resumed into it, its times have started again.
            episodes.sort(key=lambda episode: episode[2])
        if not episodes:
            raise ValueError(f"{files[0]} has no episode: paths must name runs of at least one")
        rows.append(episodes)
    return LearningCurves.from_rows(*([[episode[column] for episode in run] for run in rows] for column in (0, 1)))


def _compare_times(first: np.ndarray | None, second: np.ndarray | None, n_resamples: int, seed: int) -> Comparison | None:
    if first is None or second is None:
        return None
    difference = bootstrap_difference(first, second, "median", n_resamples, seed)
    p_value = p_value_of_difference(first, second, "mann-whitney")
    return Comparison(first, second, *difference, p_value, hedges_g(first, second), cliffs_delta(first, second), False)


def _checked_floor(floor: float | None, lowest: float) -> float:
    if floor is None:
        return min(0.0, lowest)
    check_finite("floor", floor)
    if floor > lowest:
        raise ValueError(f"floor must be at most the lowest return of all runs, {lowest:g}, got {floor:g}")
    return float(floor)


def _episodes_of_all(name: str, n: int | None, curves: LearningCurves) -> int:
    shortest = int(curves.n_episodes.min())
    if n is None:
        return shortest
    check_count(name, n, max=shortest, why_max="as many as the shortest run has")
    return n


def _refuse(name: str, values: np.ndarray, wrong: np.ndarray, right: str) -> None:
    """Raise an error that names the first value that is wrong."""
    if wrong.any():
        run, episode = np.argwhere(wrong)[0]
        raise ValueError(f"{name} must be {right}, got {values[run, episode]} in run {run}, episode {episode}")


def _monitor_files(path: Path) -> list[Path]:
    """Return the Monitor files of a folder by name, or the file itself."""
    if path.is_file():
        return [path]
    files = sorted(path.glob(f"*{MONITOR_SUFFIX}"))
    if not files:
        what = f"has no file *{MONITOR_SUFFIX}" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {what}: paths must name Monitor logs or folders that have them")
    return files


def _read_monitor_file(file: Path) -> list[tuple[float, float, float]]:
    """Return (return, steps, time of the end in seconds since 1970) of each episode."""
    header, *lines = file.read_text().splitlines(keepends=True) or [""]
    episodes: list[tuple[float, float, float]] = []
    try:
        start = float(json.loads(header.removeprefix("#"))["t_start"])
        for row in csv.DictReader(lines):
            values = (float(row["r"]), float(row["l"]), start + float(row["t"]))
            if not np.isfinite(values).all():
                raise ValueError(f"not finite: {values}")
            episodes.append(values)
        if lines and not lines[-1].endswith("\n"):
            raise ValueError("the last line has no end")
    except (ValueError, KeyError, TypeError) as error:
        what = f"got {error!r} after {len(episodes)} episodes"
        raise ValueError(f"{file} must be a Monitor log: a line of JSON, then columns r, l, t; {what}") from error
    return episodes
