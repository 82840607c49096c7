"""Measures of learning, and of transfer: what learning with transfer gains over learning without it.

The five of Taylor & Stone, "Transfer Learning for Reinforcement Learning Domains: A Survey", JMLR 10, 2009: jumpstart,
asymptotic performance, total reward, transfer ratio, time to threshold. Performance is the undiscounted return of an episode
of learning, exploration included; time is environment steps, of all environments of a run together. Steps spent on learning
source tasks do not count.

From Monitor logs of Stable-Baselines3, one file a run::

    measures = compare_learning(read_monitor_logs("logs/combrel"), read_monitor_logs("logs/no_transfer"), threshold=-200)
    print(measures.jumpstart.effect, measures.time_to_threshold.p_value)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite
from sb3_combrel.comparison.curves import LearningCurves, episodes_of_all
from sb3_combrel.comparison.statistics import bootstrap_difference, bootstrap_relative_difference, p_value_of_difference

#: Episodes of the initial and of the asymptotic return, and of the median that must reach a threshold.
N_FIRST, N_LAST, WINDOW = 5, 10, 5


def initial_return(curves: LearningCurves, n_first: int = N_FIRST) -> np.ndarray:
    """Compute the mean return of each run's first ``n_first`` episodes, (n_runs,): jumpstart is with minus without transfer.

    :raises ValueError: if a run has fewer episodes
    """
    n_first = episodes_of_all("n_first", n_first, curves)
    return curves.returns[:, :n_first].mean(axis=1)


def asymptotic_return(curves: LearningCurves, n_last: int = N_LAST) -> np.ndarray:
    """Compute the mean return of each run's own last ``n_last`` episodes, (n_runs,): the asymptote if learning has ended.

    :raises ValueError: if a run has fewer episodes
    """
    n_last = episodes_of_all("n_last", n_last, curves)
    last = curves.n_episodes[:, None] - np.arange(n_last, 0, -1)
    return np.take_along_axis(curves.returns, last, axis=1).mean(axis=1)


def total_reward(curves: LearningCurves, n_episodes: int | None = None) -> np.ndarray:
    """Compute the reward that each run collects, in units of return, (n_runs,): the area with every episode of width 1.

    :param n_episodes: count so many episodes; None: as many as the shortest run has
    :raises ValueError: if a run has fewer episodes
    """
    n_episodes = episodes_of_all("n_episodes", n_episodes, curves)
    return curves.returns[:, :n_episodes].sum(axis=1)


def total_reward_by_steps(curves: LearningCurves, n_steps: int | None = None) -> np.ndarray:
    """Compute the area under each run's returns over environment steps: every episode is as wide as it has steps.

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
    return (np.nan_to_num(curves.returns) * np.clip(n_steps - starts, 0.0, steps)).sum(axis=1)


def time_to_threshold(curves: LearningCurves, threshold: float, window: int = WINDOW) -> np.ndarray:
    """Count each run's steps, (n_runs,), until the median return of its last ``window`` episodes is at least ``threshold``.

    A run that never reaches it is right-censored: its time is inf. So runs should last equally long, or well beyond it.

    :raises ValueError: if the threshold is not finite, or the window has no episode
    """
    check_finite("threshold", threshold)
    check_count("window", window)
    # Returns that are high enough are, with the other sign, low enough.
    return _steps_of(curves.steps, episodes_to_reach(-curves.returns, -threshold, window))


def counts_within(n_episodes: int) -> dict[str, int]:
    """Return ``n_first`` and ``n_last`` of :func:`compare_learning` where the shortest run has so many episodes."""
    return {"n_first": min(N_FIRST, n_episodes), "n_last": min(N_LAST, n_episodes)}


def episodes_to_reach(steps: np.ndarray, threshold: float, window: int) -> np.ndarray:
    """Count episodes until the median steps of the last ``window`` (NaN after a run) are at most ``threshold``, or inf."""
    if steps.shape[1] < window:
        return np.full(len(steps), np.inf)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(steps, window, axis=1), axis=-1)
    good = medians <= threshold
    return np.where(good.any(axis=1), good.argmax(axis=1) + float(window), np.inf)


def steps_to_reach(steps: np.ndarray, threshold: float, window: int) -> np.ndarray:
    """Count the steps of each run until the median of its last ``window`` episodes is at most ``threshold``; inf if never."""
    return _steps_of(steps, episodes_to_reach(steps, threshold, window))


def _steps_of(steps: np.ndarray, n_episodes: np.ndarray) -> np.ndarray:
    """Steps of the first episodes of each run, whose number may be inf."""
    return np.array([each[: int(n)].sum() if np.isfinite(n) else np.inf for each, n in zip(steps, n_episodes, strict=True)])


class Comparison(NamedTuple):
    """A measure of runs with transfer against runs without.

    :param with_transfer: the measure of each run with transfer, shape (n_with,); ``without``: likewise, shape (n_without,)
    :param effect: what transfer adds: below 0 if it lowers the measure
    :param low: lower bound of the effect's 95% bootstrap interval, NaN where there is none; ``high``: upper bound
    :param p_value: two-sided; NaN with fewer than two runs of either
    :param higher_is_better: whether an effect above 0 is a gain
    """

    with_transfer: np.ndarray
    without: np.ndarray
    effect: float
    low: float
    high: float
    p_value: float
    higher_is_better: bool = True


class TransferMeasures(NamedTuple):
    """Taylor & Stone's measures of transfer, see :func:`compare_learning`.

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


def compare_learning(
    with_transfer: LearningCurves,
    without: LearningCurves,
    *,
    threshold: float | None = None,
    n_first: int = N_FIRST,
    n_last: int = N_LAST,
    window: int = WINDOW,
    floor: float | None = None,
    n_steps: int | None = None,
    n_resamples: int = 2000,
    seed: int = 0,
) -> TransferMeasures:
    """Compute Taylor & Stone's measures of transfer, with 95% bootstrap intervals and p-values.

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

    def compare(measure: Callable[[LearningCurves], np.ndarray], difference: Any = bootstrap_difference) -> Comparison:
        first, second = (measure(curves) for curves in both)
        effect, low, high = difference(first, second, n_resamples=n_resamples, seed=seed)
        return Comparison(first, second, effect, low, high, p_value_of_difference(first, second, "permutation", seed))

    def ratio(area: Callable[[LearningCurves], np.ndarray], width: int) -> Comparison:
        # Rounding may leave a run that never rose above the floor just below it.
        return compare(lambda curves: np.maximum(area(curves) - floor * width, 0.0), bootstrap_relative_difference)

    def by_episodes(curves: LearningCurves) -> np.ndarray:
        return total_reward(curves, n_episodes)

    def by_steps(curves: LearningCurves) -> np.ndarray:
        return total_reward_by_steps(curves, n_steps)

    times = None
    if threshold is not None:
        first, second = (time_to_threshold(curves, threshold, window) for curves in both)
        effect, low, high = bootstrap_difference(first, second, "median", n_resamples, seed)
        p_value = p_value_of_difference(first, second, "mann-whitney", seed)
        times = Comparison(first, second, effect, low, high, p_value, higher_is_better=False)
    return TransferMeasures(
        jumpstart=compare(lambda curves: initial_return(curves, n_first)),
        asymptotic_performance=compare(lambda curves: asymptotic_return(curves, n_last)),
        total_reward=compare(by_episodes),
        total_reward_by_steps=compare(by_steps),
        transfer_ratio=ratio(by_episodes, n_episodes),
        transfer_ratio_by_steps=ratio(by_steps, n_steps),
        time_to_threshold=times,
        floor=floor,
    )


def _checked_floor(floor: float | None, lowest: float) -> float:
    if floor is None:
        return min(0.0, lowest)
    check_finite("floor", floor)
    if floor > lowest:
        raise ValueError(f"floor must be at most the lowest return of all runs, {lowest:g}, got {floor:g}")
    return float(floor)
