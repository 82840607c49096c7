"""Warnings where it is not told by where one arrives whether an episode ends, and what that pays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.common.periodic import differences
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.models.base import Model

# So many ends are looked at; their arrivals and outcomes tell something if the one is by so much better than the other.
ENOUGH, BETTER = 10, 0.25
# Last steps as long as this many of the longest others lead nowhere near.
FARTHER = 2.0
REMEDY = (
    "the local linear model, degree=1, takes an end and what it pays as a function of where one arrives, whatever led there: "
    "pass degree=0"
)


class EndsCheck:
    """Looks at the experience after learning, and warns once of each of two things.

    - Last observations that are none, such as zeros: last steps are longer than all others.
    - Ends that the action decides, such as one that stops or chooses: of arrivals at the same place those of the same action
      had the same outcome, and those of another one had not.

    :param periodic: which state variables are periodic, one bool for each
    """

    def __init__(self, periodic: Sequence[bool]):
        self._periodic = np.asarray(periodic, dtype=np.bool_)
        self._warned: set[str] = set()
        self._due = 1.0

    def look(self, model: Model) -> None:
        """Look at all experience of a model, unless it looked at most of it before."""
        if model.n_instances < self._due:
            return
        self._due = 1.5 * model.n_instances
        state, action, reward, after, terminated = map(np.array, zip(*model.transitions(), strict=True))
        if terminated.sum() < ENOUGH:
            return
        length = np.linalg.norm(differences(after, state, self._periodic), axis=1)
        if not terminated.all() and np.median(length[terminated]) > FARTHER * length[~terminated].max():
            self._warn("far", f"last steps of episodes are longer than all others: are their last observations true? {REMEDY}")
        by_action, by_place = mean_errors(action, reward, after, terminated)
        if by_place - by_action > BETTER and by_action < 0.5 * by_place:
            self._warn("action", f"which action is taken decides how episodes end, not where it leads. {REMEDY}")

    def _warn(self, of: str, message: str) -> None:
        if of not in self._warned:
            self._warned.add(of)
            warn_user(message)


def mean_errors(action: np.ndarray, reward: np.ndarray, after: np.ndarray, terminated: np.ndarray) -> tuple[float, float]:
    """How wrong the nearest arrival of the same action is about an end, and one of another action that is no farther; 0 to 1.

    :return: both means are over the ends beside which there is one; 0 if these are fewer than ``ENOUGH``
    """
    # Takes half a second to import, which is not due before there is something to look at.
    from scipy.spatial import cKDTree

    scale = max(float(np.ptp(reward)), 1e-300)
    found = []
    for one in np.unique(action[terminated]).tolist():
        own, others = np.flatnonzero(action == one), np.flatnonzero(action != one)
        ends = np.flatnonzero((action == one) & terminated)
        if len(own) < 2 or len(others) == 0:
            continue
        # Of its own action the nearest arrival is the end itself, or one at the very same place.
        apart, nearest = cKDTree(after[own]).query(after[ends], k=2)
        second = (own[nearest[:, 0]] == ends).astype(int)
        same, to_same = own[nearest[np.arange(len(ends)), second]], apart[:, 1]
        to_other, nearest = cKDTree(after[others]).query(after[ends])
        beside = to_other <= to_same
        for near in (same, others[nearest]):
            wrong = np.minimum(np.abs(reward[ends] - reward[near]) / scale, 1.0)
            found.append(np.where(terminated[near], wrong, 1.0)[beside])
    by_action, by_place = (np.concatenate([*found[k::2], np.empty(0)]) for k in (0, 1))
    return (float(by_action.mean()), float(by_place.mean())) if len(by_action) >= ENOUGH else (0.0, 0.0)
