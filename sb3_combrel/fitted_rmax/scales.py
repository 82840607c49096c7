"""Scales of the state variables, found from what has been observed where nobody has given them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_combrel.common.constants import BEYOND, TOO_WIDE
from sb3_combrel.common.periodic import check_periods, periodic_flags
from sb3_combrel.common.scaling import LARGEST_BOUND, Bounds, StateScaling, around_zero, without_bounds


class FoundScales:
    """The bounds between which each state variable is scaled to [0, 1].

    Those that the user gives stay as they are. Otherwise it begins with the observation space's, where these are finite; a
    variable without bounds, or one that uses less than half of them by the end of an episode, is scaled by the range of its
    observations, and again when one lies beyond. There is no margin: nobody has been there, and it would draw the agent.
    Periodic variables keep their bounds; once instances are transferred, all that have some do: where everything has a model,
    nothing draws the agent beyond the range of its observations.

    :param space: observation space
    :param bounds: of the user; None: to be found
    :param periodic: one bool for each state variable; None: none is periodic
    :raises ValueError: if the space is not a one-dimensional Box of floating-point numbers, the bounds or ``periodic`` do not
        fit it, or a periodic variable has no bounds
    """

    def __init__(self, space: spaces.Space[Any], bounds: Bounds | None, periodic: Sequence[bool] | None):
        self.fixed = bounds is not None
        low, high = StateScaling.limits_of(space, bounds)
        flags = np.array(periodic_flags(periodic, len(low)))
        self._found = ~flags & (bounds is None)
        unbounded = without_bounds(low, high)
        check_periods(flags & unbounded)
        #: What the space allows, raw units.
        self.low = np.where((low > -LARGEST_BOUND) & (low < high), low, -np.inf)
        self.high = np.where((high < LARGEST_BOUND) & (low < high), high, np.inf)
        #: The least and the largest observation of each variable, raw units, shape (2, n_variables).
        self.observed = np.stack([np.full(len(low), np.inf), np.full(len(low), -np.inf)])
        # Variables that correspond to others by the bounds in use, as they have none of their own.
        self._by_use = unbounded.copy()
        self.scaling = StateScaling(np.where(unbounded, -1.0, low), np.where(unbounded, 1.0, high))
        # Whether instances have been transferred.
        self._whole = False

    @property
    def are_given(self) -> bool:
        """Whether each state variable has bounds, the user's or the space's."""
        return not self._by_use.any()

    @property
    def bounds(self) -> StateScaling:
        """The user's or the space's bounds, and for a variable without any those in use."""
        in_use = self.scaling
        return StateScaling(np.where(self._by_use, in_use.low, self.low), np.where(self._by_use, in_use.high, self.high))

    def renewed(self, episode_ended: bool, transfers: bool = False) -> StateScaling | None:
        """Return other scales if the observations ask for them, and None otherwise.

        :param episode_ended: only then is a variable scaled more finely
        :param transfers: whether instances are transferred
        """
        self._whole = self._whole or transfers
        least, most = self.observed
        low, high = self.scaling.low, self.scaling.high
        used, given = most - least, high - low
        tolerated = BEYOND * given
        beyond = (least < low - tolerated) | (most > high + tolerated)
        # A variable that never changes has no scale.
        too_wide = (given > TOO_WIDE * used) & (used > 0.0) if episode_ended else np.zeros(len(low), dtype=np.bool_)
        whole = self._found & ~self._by_use & self._whole
        renewed = np.where(whole, (low > self.low) | (high < self.high), self._found & (beyond | too_wide))
        if not renewed.any():
            return None
        # A single observation has no range.
        around = np.where(used > 0.0, 0.0, 0.5 * given)
        wanted_low, wanted_high = around_zero(least - around, most + around)
        # No farther than the space allows, unless an observation lies beyond that.
        low = np.where(renewed, np.maximum(wanted_low, np.minimum(self.low, least)), low)
        high = np.where(renewed, np.minimum(wanted_high, np.maximum(self.high, most)), high)
        low, high = np.where(whole, self.low, low), np.where(whole, self.high, high)
        self.scaling = StateScaling(low, high)
        return self.scaling

    def beyond_space(self) -> np.ndarray:
        """Which variables have been observed outside the observation space, bool, shape (n_variables,)."""
        least, most = self.observed
        # Of a variable without a lower or an upper bound the range in use.
        width = np.where(np.isfinite(self.high - self.low), self.high - self.low, self.scaling.high - self.scaling.low)
        beyond: np.ndarray = (least < self.low - BEYOND * width) | (most > self.high + BEYOND * width)
        return self._found & beyond

    def widened(self, before: StateScaling) -> np.ndarray:
        """By how much wider than before each variable without bounds is scaled, shape (n_variables,); 0 for the others."""
        wider: np.ndarray = (self.scaling.high - self.scaling.low) / (before.high - before.low)
        return np.where(self._by_use, wider, 0.0)

    def get_state(self) -> np.ndarray:
        """What :meth:`set_state` takes: bounds in use, range of the observations, and whether instances have been transferred.

        :return: float64, shape (4 * n_variables + 1,)
        """
        rows = np.vstack([self.scaling.low, self.scaling.high, self.observed])
        limit = np.finfo(np.float64).max
        return np.append(np.nan_to_num(rows, posinf=limit, neginf=-limit).ravel(), float(self._whole))

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        self._whole = bool(state[-1] > 0.5)
        low, high, *observed = state[:-1].reshape(4, -1)
        limit = np.finfo(np.float64).max
        self.observed = np.where(np.abs(observed) == limit, np.copysign(np.inf, observed), observed)
        # Whatever a file says.
        least, most = np.minimum(low, high), np.maximum(low, high)
        self.scaling = StateScaling(least, np.where(most > least, most, least + 1.0))
