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

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_finite
from sb3_combrel.experiments.bootstrap import Difference, bootstrap_difference, bootstrap_relative_difference
from sb3_combrel.experiments.effect_sizes import cliffs_delta, hedges_g
from sb3_combrel.experiments.learning_curves import LearningCurves
from sb3_combrel.experiments.learning_measures import (
    N_FIRST,
    N_LAST,
    WINDOW,
    LearningMeasures,
    asymptotic_return,
    initial_return,
    measure_learning,
    time_to_threshold,
    total_reward,
    total_reward_by_steps,
)
from sb3_combrel.experiments.monitor_logs import MONITOR_SUFFIX, read_monitor_logs
from sb3_combrel.experiments.statistics import p_value_of_difference

__all__ = [
    "MONITOR_SUFFIX",
    "Comparison",
    "LearningCurves",
    "LearningMeasures",
    "TransferMeasures",
    "asymptotic_return",
    "compare_learning",
    "initial_return",
    "measure_learning",
    "read_monitor_logs",
    "time_to_threshold",
    "total_reward",
    "total_reward_by_steps",
]


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
        estimate = difference(first, second, n_resamples=n_resamples, seed=seed)
        return _comparison(first, second, estimate, p_value_of_difference(first, second, "permutation", seed))

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


def _compare_times(first: np.ndarray | None, second: np.ndarray | None, n_resamples: int, seed: int) -> Comparison | None:
    if first is None or second is None:
        return None
    estimate = bootstrap_difference(first, second, "median", n_resamples, seed)
    p_value = p_value_of_difference(first, second, "mann-whitney")
    return _comparison(first, second, estimate, p_value, higher_is_better=False)


def _comparison(
    first: np.ndarray, second: np.ndarray, estimate: Difference, p_value: float, higher_is_better: bool = True
) -> Comparison:
    sizes = hedges_g(first, second), cliffs_delta(first, second)
    return Comparison(first, second, *estimate, p_value, *sizes, higher_is_better)


def _checked_floor(floor: float | None, lowest: float) -> float:
    if floor is None:
        return min(0.0, lowest)
    check_finite("floor", floor)
    if floor > lowest:
        raise ValueError(f"floor must be at most the lowest return of all runs, {lowest:g}, got {floor:g}")
    return float(floor)
