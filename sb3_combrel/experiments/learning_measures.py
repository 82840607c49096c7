"""
What is measured of each run by itself: the terms of Taylor & Stone's measures of transfer.

Performance is the undiscounted return of an episode of learning, exploration included; time is environment steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite
from sb3_combrel.experiments.learning_curves import LearningCurves, episodes_of_all
from sb3_combrel.experiments.statistics import area_under_curve, episodes_to_reach, steps_of_first_episodes

#: Episodes of the initial and of the asymptotic return, and of the median that must reach a threshold.
N_FIRST, N_LAST, WINDOW = 5, 10, 5


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


def initial_return(curves: LearningCurves, n_first: int = N_FIRST) -> np.ndarray:
    """
    Compute the mean return of the first episodes of each run: with transfer minus without it is the jumpstart.

    :param n_first: number of episodes; the fewer, the less of learning is in it, and the more of chance
    :return: shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_first = episodes_of_all("n_first", n_first, curves)
    return curves.returns[:, :n_first].mean(axis=1)


def asymptotic_return(curves: LearningCurves, n_last: int = N_LAST) -> np.ndarray:
    """
    Compute the mean return of the last episodes of each run, each run's own: the asymptote if learning has ended by then.

    :param n_last: number of episodes
    :return: shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_last = episodes_of_all("n_last", n_last, curves)
    last = curves.n_episodes[:, None] - np.arange(n_last, 0, -1)
    return np.take_along_axis(curves.returns, last, axis=1).mean(axis=1)


def total_reward(curves: LearningCurves, n_episodes: int | None = None) -> np.ndarray:
    """
    Compute the reward that each run collects, the area under its returns with every episode of width 1.

    :param n_episodes: count so many episodes; None: as many as the shortest run has
    :return: in units of return, shape (n_runs,)
    :raises ValueError: if a run has fewer episodes
    """
    n_episodes = episodes_of_all("n_episodes", n_episodes, curves)
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


def time_to_threshold(curves: LearningCurves, threshold: float, window: int = WINDOW) -> np.ndarray:
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
    # Returns that are high enough are, with the other sign, low enough.
    return steps_of_first_episodes(curves.steps, episodes_to_reach(-curves.returns, -threshold, window))


def measure_learning(
    curves: LearningCurves,
    *,
    threshold: float | None = None,
    n_first: int = N_FIRST,
    n_last: int = N_LAST,
    window: int = WINDOW,
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


def counts_within(n_episodes: int) -> dict[str, int]:
    """
    Return ``n_first`` and ``n_last`` of :func:`measure_learning`: the usual ones, or all episodes where there are fewer.

    :param n_episodes: episodes of the shortest run
    """
    return {"n_first": min(N_FIRST, n_episodes), "n_last": min(N_LAST, n_episodes)}
