"""Figures that take some work to read off a policy, for the logger; nothing here changes what it learns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.combrel import COMBREL

if TYPE_CHECKING:
    from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

MOST_POINTS = 500
"""Grid points that a figure is read off at most: enough for a curve, and cheap on any grid."""

MOST_PAIRS = 2000
"""The same for state-action pairs."""


def spread(n: int, most: int = MOST_POINTS) -> np.ndarray:
    """
    At most ``most`` of the numbers below ``n``, evenly spread; int64.

    Where one is a step of a regular grid apart from the next, a remainder of the division keeps them off its axes.

    :param n: how many numbers there are
    :param most: how many to take
    """
    return np.arange(n) if n <= most else (np.arange(most) * (n / most)).astype(np.int64)


def pair_values(policy: FittedRMaxPolicy, pairs: np.ndarray) -> np.ndarray:
    """
    Q of state-action pairs of the grid, from their rows and the planner's values.

    :param pairs: int64, any shape; pair ``action * n_points + point``
    :return: float64, same shape; NaN for an optimistic pair
    """
    arrays, flat = policy.model.arrays, pairs.reshape(-1)
    length = arrays.rows.length[flat].astype(np.int64)
    row = np.repeat(np.arange(len(flat)), length)
    # The entries of all rows one after the other: each row's start, and the place within the row.
    place = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    entry = arrays.rows.start[flat][row] + place
    following = arrays.rows.weight[entry] * policy.planner.values[arrays.rows.index[entry]]
    q = arrays.reward[flat] + np.bincount(row, weights=following, minlength=len(flat))
    return np.where(arrays.settled[flat], q, np.nan).reshape(pairs.shape)


def action_values(policy: FittedRMaxPolicy, points: np.ndarray) -> np.ndarray:
    """
    Q of every action at grid points; NaN for an optimistic one.

    :param points: int64, any shape
    :return: float64, one axis more, the actions in front
    """
    offsets = np.arange(policy.n_actions) * policy.model.grid.n_points
    return pair_values(policy, np.add.outer(offsets, points))


def bellman_residual(policy: FittedRMaxPolicy, most_points: int = MOST_POINTS) -> float:
    """
    By how much a backup would still change V at a grid point: the largest change among points spread over the grid.

    Points with an optimistic action have their final value and are left out; 0 if there are no others.

    :param policy: the policy whose planner is asked
    :param most_points: how many grid points to try
    """
    points = spread(policy.model.grid.n_points, most_points)
    points = points[policy.model.arrays.n_optimistic[points] == 0]
    if len(points) == 0:
        return 0.0
    backed_up = np.clip(action_values(policy, points).max(axis=0), *policy.planner.bounds)
    return float(np.abs(backed_up - policy.planner.values[points]).max())


def mean_compliance(transfer: Transfer, most_pairs: int = MOST_PAIRS) -> float | None:
    """
    Compliance of the chosen mappings (Eq. 6 of the COMBREL paper), the mean over pairs spread over the sample.

    :param transfer: a transfer method
    :param most_pairs: how many pairs to look at
    :return: None if the method measures no compliance, or has not chosen anything yet
    """
    if not isinstance(transfer, COMBREL):
        return None
    pairs = np.flatnonzero(transfer.choices() >= 0)
    if len(pairs) == 0:
        return None
    return float(transfer.chosen_compliance(pairs[spread(len(pairs), most_pairs)]).mean())
