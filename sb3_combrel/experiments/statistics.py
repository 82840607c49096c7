"""
Means of several runs with confidence intervals, the steps that a method saves, and tests of differences.

Bootstrap intervals are in :mod:`~sb3_combrel.experiments.bootstrap`, effect sizes in
:mod:`~sb3_combrel.experiments.effect_sizes`.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
#: Level of a test, after Holm's correction over the rows of a table.
ALPHA = 0.05
TESTS = ("welch", "mann-whitney", "permutation")
#: A permutation test draws so many regroupings at random, or takes each one once if there are at most so many.
N_PERMUTATIONS = 10_000


class Estimate(NamedTuple):
    """A mean and its 95% confidence interval; the interval is NaN where there are too few runs for one."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Saving(NamedTuple):
    """
    Steps that a method saves over another.

    :param steps: difference of the means
    :param low: lower bound of its 95% confidence interval, NaN with fewer than two runs of each
    :param high: upper bound
    :param share: the difference as a fraction of the other's mean
    :param p_value: of Welch's t-test that both need equally many steps
    """

    steps: float
    low: float
    high: float
    share: float
    p_value: float


def mean_of_runs(samples: np.ndarray) -> Estimate:
    """
    Compute the mean over runs, with the interval of Student's t.

    :param samples: one run a row, shape (n_runs, ...)
    """
    samples = np.asarray(samples, dtype=np.float64)
    mean = samples.mean(axis=0)
    if len(samples) < 2:
        return Estimate(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, len(samples) - 1) * stats.sem(samples, axis=0)
    return Estimate(mean, mean - half, mean + half)


def saving(without: np.ndarray, with_transfer: np.ndarray) -> Saving:
    """
    Compute what transfer saves, by Welch's t-test: the runs are independent and their variances differ.

    :param without: steps of each run without transfer, shape (n_runs,)
    :param with_transfer: steps of each run with transfer, shape (n_runs,)
    """
    without, with_transfer = (np.asarray(steps, dtype=np.float64) for steps in (without, with_transfer))
    steps = float(without.mean() - with_transfer.mean())
    share = steps / float(without.mean())
    no_spread = min(len(without), len(with_transfer)) < 2 or (np.ptp(without) == 0.0 and np.ptp(with_transfer) == 0.0)
    if no_spread:
        return Saving(steps, np.nan, np.nan, share, np.nan)
    test = stats.ttest_ind(without, with_transfer, equal_var=False)
    interval = test.confidence_interval(CONFIDENCE)
    return Saving(steps, float(interval.low), float(interval.high), share, float(test.pvalue))


def episodes_to_reach(steps: np.ndarray, threshold: float, window: int) -> np.ndarray:
    """
    Count the episodes of each run until the median of its last ``window`` episodes is at most ``threshold``; inf if never.

    :param steps: steps of each episode, or NaN after the last of a run, shape (n_runs, n_episodes)
    """
    if steps.shape[1] < window:
        return np.full(len(steps), np.inf)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(steps, window, axis=1), axis=-1)
    good = medians <= threshold
    return np.where(good.any(axis=1), good.argmax(axis=1) + float(window), np.inf)


def steps_to_reach(steps: np.ndarray, threshold: float, window: int) -> np.ndarray:
    """
    Count the steps of each run until the median of its last ``window`` episodes is at most ``threshold``; inf if never.

    :param steps: steps of each episode, shape (n_runs, n_episodes)
    """
    return steps_of_first_episodes(steps, episodes_to_reach(steps, threshold, window))


def steps_of_first_episodes(steps: np.ndarray, n_episodes: np.ndarray) -> np.ndarray:
    """
    Add up the steps of the first episodes of each run.

    :param steps: steps of each episode, shape (n_runs, n_episodes)
    :param n_episodes: for each run how many episodes, or inf, shape (n_runs,)
    :return: inf where the number of episodes is, shape (n_runs,)
    """
    return np.array([each[: int(n)].sum() if np.isfinite(n) else np.inf for each, n in zip(steps, n_episodes, strict=True)])


def interquartile_mean(samples: np.ndarray, axis: int = 0) -> np.ndarray:
    """
    Compute the mean without the lowest and the highest quarter of the runs.

    From each end, a quarter of their number is left out, rounded down: with fewer than four runs this is the mean.

    :param samples: one run a row, shape (n_runs, ...)
    :param axis: the axis of the runs
    """
    return stats.trim_mean(np.asarray(samples, dtype=np.float64), 0.25, axis=axis)


def area_under_curve(samples: np.ndarray, widths: np.ndarray | None = None) -> np.ndarray:
    """
    Compute the area between each run's curve and zero, each point a rectangle.

    Of the returns of episodes this is their sum, the total reward. Two methods are compared by their whole curves with
    ``p_value_of_difference(area_under_curve(first), area_under_curve(second), "permutation")``.

    :param samples: one run a row, shape (n_runs, n_points)
    :param widths: width of each point, such as the steps of an episode, shape (n_runs, n_points) or (n_points,); None: 1
    :return: shape (n_runs,)
    :raises ValueError: unless samples has two dimensions
    """
    samples = np.asarray(samples, dtype=np.float64)
    if samples.ndim != 2:
        raise ValueError(f"samples must have shape (n_runs, n_points), got {samples.shape}")
    return (samples if widths is None else samples * widths).sum(axis=1)


def as_sample(name: str, values: np.ndarray) -> np.ndarray:
    """
    Return the values of several runs as an array of floats.

    :param name: name of the argument
    :param values: one for each run, shape (n_runs,)
    :raises ValueError: if the shape is another, there are none, or some are NaN
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or not len(sample):
        raise ValueError(f"{name} must have one value for each run, shape (n_runs,), got shape {sample.shape}")
    if np.isnan(sample).any():
        raise ValueError(f"{name} must have no NaN, got {np.isnan(sample).sum()} of {len(sample)}: leave out runs on purpose")
    return sample


def p_value_of_difference(first: np.ndarray, second: np.ndarray, test: str = "welch", seed: int = 0) -> float:
    """
    Compute the two-sided p-value that two samples have the same mean, or the same distribution.

    :param first: one sample, shape (n,); inf is allowed
    :param second: the other
    :param test: ``"welch"``, Welch's t-test, ``"permutation"``, the permutation test of the difference of means, which
        assumes no distribution, or ``"mann-whitney"``, the test by Mann and Whitney, which is also used where a value is
        infinite and means do not exist
    :param seed: of the permutation test, where there are more than :data:`N_PERMUTATIONS` regroupings
    :return: NaN with fewer than two values in one sample, or a NaN in them; 1 if all values are equal
    :raises ValueError: if the test is unknown
    """
    if test not in TESTS:
        raise ValueError(f"test must be one of {', '.join(TESTS)}, got {test!r}")
    first, second = (np.asarray(sample, dtype=np.float64) for sample in (first, second))
    together = np.concatenate([first, second])
    if min(len(first), len(second)) < 2 or np.isnan(together).any():
        return np.nan
    if (together == together[0]).all():
        return 1.0
    no_spread = test == "welch" and (first == first[0]).all() and (second == second[0]).all()
    if test == "mann-whitney" or no_spread or not np.isfinite(together).all():
        return float(stats.mannwhitneyu(first, second).pvalue)
    if test == "permutation":
        return _p_value_by_permutation(first, second, seed)
    with warnings.catch_warnings():
        # Of loss of precision, where the values of a sample are nearly equal.
        warnings.simplefilter("ignore", RuntimeWarning)
        return float(stats.ttest_ind(first, second, equal_var=False).pvalue)


def holm(p_values: np.ndarray) -> np.ndarray:
    """
    Correct p-values for their number by Holm's method (Holm, "A simple sequentially rejective multiple test procedure", 1979).

    :param p_values: shape (n,); NaN stays NaN and does not count
    """
    p_values = np.asarray(p_values, dtype=np.float64)
    corrected = np.full(p_values.shape, np.nan)
    tested = np.flatnonzero(~np.isnan(p_values))
    order = tested[np.argsort(p_values[tested])]
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p_values[order]))
    return corrected


def holm_by_name(p_values: Mapping[str, float]) -> dict[str, float]:
    """
    Correct p-values by Holm's method, see :func:`holm`.

    :param p_values: by name
    """
    return dict(zip(p_values, holm(np.array(list(p_values.values()))).tolist(), strict=True))


def smallest_p_value(n_first: int, n_second: int, n_methods: int) -> float:
    """
    Compute the smallest p-value that a permutation test of so many runs can have, after Holm's correction; 1 for one run.

    :param n_first: runs of a method; ``n_second``: of the other
    :param n_methods: number of tests
    """
    if min(n_first, n_second) < 2:
        return 1.0
    # The two extreme groupings are equally far apart if the groups are equally large.
    extreme = 2 if n_first == n_second else 1
    return min(1.0, n_methods * extreme / math.comb(n_first + n_second, n_first))


def fewest_runs(n_methods: int) -> int:
    """
    Compute how many runs of each method a permutation test needs for a p-value below :data:`ALPHA`, after Holm's correction.

    :param n_methods: number of tests
    """
    return next(n for n in itertools.count(2) if smallest_p_value(n, n, n_methods) < ALPHA)


def _p_value_by_permutation(first: np.ndarray, second: np.ndarray, seed: int) -> float:
    """
    Compute the share of regroupings of all values whose means differ at least as much as those of the samples.

    Random regroupings count the samples' own as one more (Phipson & Smyth, "Permutation p-values should never be zero", 2010).
    """
    together = np.concatenate([first, second])
    mean = together.mean()
    largest = np.abs(together - mean).sum()

    def difference(one: np.ndarray, other: np.ndarray, axis: int) -> np.ndarray:
        # All values sum to 0, so the difference of the means is proportional to the sum over one group. Sums of the same
        # values in another order differ by rounding: SciPy allows for less of it than there is where the sum is near 0.
        return np.round(np.abs(one.sum(axis=axis)) / largest, 9)

    samples, rng = (first - mean, second - mean), np.random.default_rng(seed)
    found = stats.permutation_test(
        samples, difference, n_resamples=N_PERMUTATIONS, alternative="greater", vectorized=True, random_state=rng
    )
    return float(found.pvalue)
