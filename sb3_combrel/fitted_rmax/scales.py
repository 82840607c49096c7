"""Scales of the state variables, found from what has been observed where nobody has given them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_combrel.common.constants import BEYOND, TOO_WIDE
from sb3_combrel.common.observations import ROUNDING, scale_into_box, wider_bounds
from sb3_combrel.common.periodic import check_periods, periodic_flags
from sb3_combrel.common.scaling import LARGEST_BOUND, Bounds, StateScaling, around_zero, without_bounds
from sb3_combrel.common.user_warnings import warn_user

# Share of observations outside the user's bounds that is worth a warning.
MANY_OUTSIDE = 0.01
# With so many instances an observation that makes a scale wider by more than this is a surprise.
MANY_INSTANCES, MANY_RANGES = 100, 20


class FoundScales:
    """Observations as states in unit coordinates: the bounds between which each state variable is scaled to [0, 1].

    Those that the user gives stay as they are, and what lies outside is moved to the boundary, with one warning. Otherwise it
    begins with the observation space's, where these are finite; a variable without bounds, or one that uses less than half of
    them by the end of an episode, is scaled by the range of its observations, and again when one lies beyond. There is no
    margin: nobody has been there, and it would draw the agent. Periodic variables keep their bounds, and are wrapped: any
    angle is the same as one between them. Once instances are transferred, all variables that have bounds keep them: where
    everything has a model, nothing draws the agent beyond the range of its observations.

    :param space: observation space
    :param bounds: of the user; None: to be found
    :param periodic: one bool for each state variable; None: none is periodic
    :raises ValueError: if the space is not a one-dimensional Box of floating-point numbers, the bounds or ``periodic`` do not
        fit it, or a periodic variable has no bounds
    """

    def __init__(self, space: spaces.Space[Any], bounds: Bounds | None, periodic: Sequence[bool] | None):
        self.fixed = bounds is not None
        low, high = StateScaling.limits_of(space, bounds)
        self._periodic = np.array(periodic_flags(periodic, len(low)))
        self._found = ~self._periodic & (bounds is None)
        unbounded = without_bounds(low, high)
        check_periods(self._periodic & unbounded)
        if bounds is not None:
            _warn_of_parts_of_periods(space, high - low, self._periodic)
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
        # What has been warned of.
        self._told: set[str] = set()

    @property
    def scaling(self) -> StateScaling:
        """Raw <-> unit coordinates."""
        return self._scaling

    @scaling.setter
    def scaling(self, scaling: StateScaling) -> None:
        self._scaling = scaling
        # Compiled code takes arrays that can be written to, and those of the scaling cannot.
        self._low, self._range = scaling.low.copy(), scaling.high - scaling.low
        #: Whether anything was outside the bounds.
        self.went_beyond = False
        # How many of the noted observations were outside, by variable; and, at the end, how many were noted.
        self._n_outside = np.zeros(scaling.n_variables + 1)

    def to_unit(self, observations: np.ndarray, note: bool = False) -> np.ndarray:
        """Observations as states in unit coordinates, in [0, 1] if the user has given the bounds.

        :param observations: raw units, shape (..., n_variables)
        :param note: whether they are of learning: :meth:`renewed` follows these
        :raises ValueError: if an observation is not finite
        """
        raw = np.ascontiguousarray(observations, dtype=np.float64)
        units, flat = np.empty_like(raw), (-1, len(self._low))
        scales, noted = (self._low, self._range, self._periodic, self.fixed), self.observed if note else self.observed[:0]
        if scale_into_box.call(raw.reshape(flat), *scales, noted, self._n_outside, units.reshape(flat)):
            self._check_outside(observations, units)
        return units

    def _check_outside(self, observations: np.ndarray, units: np.ndarray) -> None:
        """Refuse what is not finite, warn once of what is outside the user's bounds by more than rounding."""
        excess = np.abs(self.scaling.to_unit(observations) - np.clip(units, 0.0, 1.0)).reshape(-1, len(self._low))
        with np.errstate(invalid="ignore"):
            # Whole periods are no excess; what is not finite stays so.
            excess[:, self._periodic] *= 0.0
        if not np.isfinite(excess).all():
            raise ValueError(f"an observation must be finite, got {observations}")
        self.went_beyond = True
        if self.fixed and excess.max() > ROUNDING:
            observation = np.reshape(observations, excess.shape)[excess.max(axis=1).argmax()]
            self._warn_once(
                f"the observation {observation} is outside the bounds low={self.scaling.low}, high={self.scaling.high} "
                "and counts as the nearest state inside; if this happens often, pass wider bounds=(low, high)",
                "outside",
            )

    def warn_of_share(self, names: Sequence[str]) -> None:
        """Warn of the user's bounds if more than a hundredth of the noted observations were outside, and propose others.

        :param names: of the state variables
        """
        n_noted = self._n_outside[-1]
        share = self._n_outside[:-1] / max(1.0, n_noted)
        many = np.flatnonzero(share > MANY_OUTSIDE)
        if not self.fixed or len(many) == 0:
            return
        low, high = wider_bounds(self.scaling, self.observed)
        shares = ", ".join(f"{names[k]} in {100 * share[k]:.0f} %" for k in many.tolist())
        warn_user(
            f"observations were outside the bounds and counted as the nearest state inside: {shares} of {n_noted:.0f} "
            f"observations; all are inside bounds=({low}, {high}), or leave bounds out, and they are found"
        )

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

    def warn_of_surprises(self, before: StateScaling, names: Sequence[str], n_instances: int) -> None:
        """Warn once of observations outside the observation space, and once of one far from all before.

        :param before: the scaling until then; ``names``: of the state variables; ``n_instances``: that have been observed
        """
        least, most = self.observed
        if outside := np.flatnonzero(self.beyond_space()).tolist():
            seen = ", ".join(f"{names[k]} from {least[k]:.4g} to {most[k]:.4g}" for k in outside)
            space = ", ".join(f"from {self.low[k]:.4g} to {self.high[k]:.4g}" for k in outside)
            self._warn_once(
                f"observations are outside the observation space: {seen}, but the space says {space}; they are taken as they "
                "are",
                "space",
            )
        wider = np.where(self._by_use, (self.scaling.high - self.scaling.low) / (before.high - before.low), 0.0)
        k = int(wider.argmax())
        if n_instances >= MANY_INSTANCES and wider[k] > MANY_RANGES:
            value = least[k] if before.low[k] - least[k] > most[k] - before.high[k] else most[k]
            self._warn_once(
                f"{names[k]}={value:.4g} is far from all observations before, from {before.low[k]:.4g} to "
                f"{before.high[k]:.4g}, and variables without bounds are scaled by the range of what is observed: if it is an "
                "error of a sensor, mend it in the environment, or pass bounds=(low, high)",
                "far",
            )

    def _warn_once(self, message: str, of: str) -> None:
        if of not in self._told:
            self._told.add(of)
            warn_user(message)

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


def _warn_of_parts_of_periods(space: spaces.Space[Any], given: np.ndarray, periodic: np.ndarray) -> None:
    """Warn of bounds of the user's between which the observation space's range of a periodic variable does not go round."""
    low, high = StateScaling.limits_of(space)
    turns = np.where(periodic & ~without_bounds(low, high), (high - low) / given, 1.0)
    for k in np.flatnonzero(np.abs(turns - np.maximum(1.0, np.round(turns))) > 0.001 * turns).tolist():
        warn_user(
            f"bounds of the periodic variable {k} are {given[k]:.4g} apart, which counts as its period, but the observation "
            f"space has it from {low[k]:.4g} to {high[k]:.4g}: states a period apart are one state; leave out such bounds"
        )
