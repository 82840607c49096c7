"""How far two samples of runs are apart, in units that do not depend on the task."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from sb3_combrel.experiments.statistics import as_sample


def hedges_g(first: np.ndarray, second: np.ndarray) -> float:
    """
    Compute the difference of the means in units of the pooled standard deviation, corrected for small samples.

    That is Cohen's d times the factor that makes it unbiased for normal samples (Hedges, "Distribution theory for Glass's
    estimator of effect size and related estimators", 1981).

    :param first: one value for each run, shape (n_first,)
    :param second: those of the other method, shape (n_second,)
    :return: above 0 if the first mean is higher; 0 if all values are equal, infinite if only the means differ; NaN with fewer
        than two runs of each or an infinite value: take :func:`cliffs_delta` then
    :raises ValueError: if a sample has another shape, is empty or has NaN
    """
    first, second = as_sample("first", first), as_sample("second", second)
    if min(len(first), len(second)) < 2 or not np.isfinite(np.concatenate([first, second])).all():
        return np.nan
    if (first == first[0]).all() and (second == second[0]).all():
        # The standard deviation is 0 but for rounding.
        return 0.0 if first[0] == second[0] else float(np.copysign(np.inf, first[0] - second[0]))
    freedom = len(first) + len(second) - 2
    pooled = np.sqrt((len(first) * first.var() + len(second) * second.var()) / freedom)
    unbiased = np.exp(gammaln(freedom / 2) - gammaln((freedom - 1) / 2)) / np.sqrt(freedom / 2)
    return float(unbiased * (first.mean() - second.mean()) / pooled)


def cliffs_delta(first: np.ndarray, second: np.ndarray) -> float:
    """
    Compute how much more often a run of the first sample is above one of the second than below it (Cliff, 1993).

    It needs the order of the values only, so they may be infinite, such as the steps of runs that never reached a threshold.
    Two infinite values of one sign are equal.

    :param first: one value for each run, shape (n_first,)
    :param second: those of the other method, shape (n_second,)
    :return: from -1, every value of the first is lower, to 1, every one is higher
    :raises ValueError: if a sample has another shape, is empty or has NaN
    """
    first, second = as_sample("first", first), as_sample("second", second)
    return float((first[:, None] > second).mean() - (first[:, None] < second).mean())
