"""How optimistic to be: ``max_value`` and ``gamma`` found from rewards; and what places are worth until something is found."""

from __future__ import annotations

import numpy as np

from sb3_combrel.fitted_rmax.settings import DEFAULT_GAMMA

LARGEST = float(np.finfo(np.float64).max)


class RewardRange:
    """The rewards seen so far, and the ``gamma`` and ``max_value`` that follow from them.

    - ``gamma``: a discount is needed where something may be collected for ever, so where a step that did not end the episode
      paid 0 or more, and where no episode ends but by its time limit; otherwise every step costs, and it is 1.
    - ``max_value``: the most that one may hope for is to end with the largest reward that an end has paid, or to collect the
      largest of all others for ever, or 0. Where the most seen is 0, which costs nothing, it is what the worst costs for ever.

    :param gamma: given by the user; None: found. ``max_value``: the same
    """

    def __init__(self, gamma: float | None, max_value: float | None):
        self._gamma, self._max_value = gamma, max_value
        # Finite, as what is saved must be.
        self.largest, self.largest_end, self.lowest = -LARGEST, -LARGEST, LARGEST
        self.n_ended = self.n_truncated = 0

    def note(self, reward: float, terminated: bool) -> None:
        """Take in the reward of a step."""
        self.lowest = min(self.lowest, reward)
        if terminated:
            self.n_ended += 1
            self.largest_end = max(self.largest_end, reward)
        else:
            self.largest = max(self.largest, reward)

    @property
    def differ(self) -> bool:
        """Whether an outcome has told states apart: an episode has ended, or a reward was another one."""
        return self.n_ended > 0 or self.lowest < self.largest

    @property
    def for_ever(self) -> bool:
        """Whether what there is to collect is collected for ever, as far as one knows: rewards differ, and nothing ends."""
        return self.n_ended == 0 and self.lowest < self.largest

    @property
    def gamma(self) -> float:
        """The discount factor."""
        if self._gamma is not None:
            return float(self._gamma)
        never_ends = self.n_ended == 0 and self.n_truncated > 0
        return DEFAULT_GAMMA if self.largest >= 0.0 or never_ends else 1.0

    @property
    def finds_max_value(self) -> bool:
        """Whether ``max_value`` is found, as the user has not given it."""
        return self._max_value is None

    @property
    def max_value(self) -> float:
        """The largest return that is possible, as far as one knows."""
        if self._max_value is not None:
            return float(self._max_value)
        if self.largest == 0.0 and self.largest_end <= 0.0:
            # What costs nothing would keep the agent from what is unknown: nothing that it can pay is too much for that.
            discount = self.gamma if self.gamma < 1.0 else DEFAULT_GAMMA
            # As long as all rewards were 0, any value above that is the same.
            return -self.lowest / (1.0 - discount) if self.lowest < 0.0 else 1.0
        for_ever = self.largest / (1.0 - self.gamma) if self.largest > 0.0 and self.gamma < 1.0 else 0.0
        return max(0.0, self.largest_end, for_ever)

    def get_state(self) -> np.ndarray:
        """What has been seen, float64, shape (5,), for :meth:`set_state`."""
        return np.array([self.largest, self.largest_end, self.lowest, self.n_ended, self.n_truncated], dtype=np.float64)

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        self.largest, self.largest_end, self.lowest = state[:3].tolist()
        self.n_ended, self.n_truncated = map(int, state[3:])


def worth_after_visits(worth: np.ndarray, visits: np.ndarray, reward: float, gamma: float) -> np.ndarray:
    """What places are still worth: as if each lay one step further away for each visit to it.

    Until an episode ends or a reward is another one, nothing tells states apart but how often one has been there: R-Max would
    try each action at each of them, and then do the same for ever, however small the place is that is looked for. With this
    the agent goes where it has hardly been, tries what may lead there, and goes on searching. Where instances are
    transferred to the model, these tell states apart, and nothing is worth less.

    :param worth: what they are worth before the first visit, shape (n,)
    :param visits: the weight of the instances there, of all actions, shape (n,); of each no more than a fit is made to
    :param reward: of every step so far
    """
    if gamma == 1.0:
        return worth + reward * visits
    for_ever = reward / (1.0 - gamma)
    return np.asarray(for_ever + gamma**visits * (worth - for_ever))
