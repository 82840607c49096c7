"""Observations of an environment as states in unit coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_combrel.common.compiled import entry_point
from sb3_combrel.common.periodic import flag_array
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.user_warnings import warn_user

# Excess over the bounds, in unit coordinates, that rounding can explain.
ROUNDING = 1e-6
# Share of observations outside the bounds that is worth a warning.
MANY_OUTSIDE = 0.01


def with_own_arrays(env: Any) -> Any:
    """An environment whose observations are copies: some return one array, and change it at the next step or reset.

    A vectorised one stays as it is, and one whose observations are no arrays.
    """
    if not isinstance(env, gym.Env) or not isinstance(env.observation_space, spaces.Box):
        return env
    return gym.wrappers.TransformObservation(env, np.array, env.observation_space)


@entry_point
def scale_into_box(states, low, ranges, periodic, fixed, observed, n_outside, units):
    """``StateScaling.to_unit``; what is outside fixed bounds is moved to the boundary, and periodic variables are wrapped.

    :param states: float64, raw units, shape (n, n_variables); ``units`` receives the unit coordinates
    :param observed: float64, shape (2, n_variables) or (0, n_variables): receives the least and the largest observations
    :param n_outside: float64, shape (n_variables + 1,): counts these by variable where they are outside by more than rounding
        explains; and all, at the end
    :return: whether anything is outside, or is no number
    """
    outside = False
    noted = len(observed) > 0
    for i in range(len(states)):
        n_outside[len(low)] += noted
        for k in range(len(low)):
            unit = (states[i, k] - low[k]) / ranges[k]
            if periodic[k]:
                # Not a number if the observation is infinite.
                unit -= np.floor(unit)
            if noted and np.isfinite(states[i, k]):
                observed[0, k] = min(observed[0, k], states[i, k])
                observed[1, k] = max(observed[1, k], states[i, k])
            inside = min(max(unit, 0.0), 1.0)
            units[i, k] = inside if fixed or periodic[k] else unit
            if inside != unit:
                outside = True
                n_outside[k] += noted and ROUNDING < abs(unit - inside) < np.inf
    return outside


def wider_bounds(scaling: StateScaling, observed: np.ndarray) -> tuple[list[float], list[float]]:
    """Bounds that observations are inside of: those of ``scaling``, or beyond these with three digits of the range.

    :param observed: the least and the largest, raw units, shape (2, n_variables)
    """
    low, high = scaling.low.tolist(), scaling.high.tolist()
    for k, (least, most) in enumerate(observed.T.tolist()):
        width = max(high[k], most) - min(low[k], least)
        digit = Decimal(1).scaleb(math.floor(math.log10(width)) - 2)
        if least < low[k]:
            low[k] = float(Decimal(least + ROUNDING * width).quantize(digit, ROUND_FLOOR))
        if most > high[k]:
            high[k] = float(Decimal(most - ROUNDING * width).quantize(digit, ROUND_CEILING))
    return low, high


class ObservationScaler:
    """Scales observations to unit coordinates; what lies outside the bounds is moved to the boundary, with one warning.

    Periodic variables are wrapped instead: any angle is the same as one between the bounds. Nothing is moved where the bounds
    are not fixed: they will be wider soon.

    :param scaling: raw <-> unit coordinates
    :param periodic: one bool for each state variable; None: none is periodic
    :param fixed: whether the bounds are the user's
    """

    def __init__(self, scaling: StateScaling, periodic: Sequence[bool] | None = None, fixed: bool = True):
        self.scaling, self._fixed = scaling, fixed
        self._periodic = flag_array(periodic, scaling.n_variables)
        # Compiled code takes arrays that can be written to, and those of the scaling cannot.
        self._low, self._range = scaling.low.copy(), scaling.high - scaling.low
        self._warned = False
        #: Whether anything was outside the bounds.
        self.went_beyond = False
        #: How many of the noted observations were outside, by variable; and, at the end, how many were noted.
        self.n_outside = np.zeros(scaling.n_variables + 1)
        self._unnoted = np.empty((0, scaling.n_variables))

    def __call__(self, observations: np.ndarray, observed: np.ndarray | None = None) -> np.ndarray:
        """:param observations: raw units, shape (..., n_variables)
        :param observed: least and largest observations, raw units, shape (2, n_variables): brought up to date
        :return: unit coordinates, in [0, 1] if the bounds are fixed, same shape
        :raises ValueError: if an observation is not finite
        """
        raw = np.ascontiguousarray(observations, dtype=np.float64)
        inside = np.empty_like(raw)
        flat = (-1, self.scaling.n_variables)
        scales, noted = (self._low, self._range, self._periodic, self._fixed), self._unnoted if observed is None else observed
        if scale_into_box.call(raw.reshape(flat), *scales, noted, self.n_outside, inside.reshape(flat)):
            excess = self.scaling.to_unit(raw) - np.clip(inside, 0.0, 1.0)
            with np.errstate(invalid="ignore"):
                # Whole periods are no excess; what is not finite stays so.
                excess[..., self._periodic] *= 0.0
            self._check_outside(observations, excess)
        return inside

    def _check_outside(self, observations: np.ndarray, excess: np.ndarray) -> None:
        """Refuse what is not finite, warn once of what is outside the bounds by more than rounding."""
        if not np.isfinite(excess).all():
            raise ValueError(f"an observation must be finite, got {observations}")
        self.went_beyond = True
        if self._fixed and not self._warned and np.abs(excess).max() > ROUNDING:
            self._warned = True
            observation = observations.reshape(-1, self.scaling.n_variables)[np.abs(excess).max(axis=-1).argmax()]
            warn_user(
                f"the observation {observation} is outside the bounds low={self.scaling.low}, high={self.scaling.high} "
                "and counts as the nearest state inside; if this happens often, pass wider bounds=(low, high)"
            )

    def warn_of_share(self, observed: np.ndarray, names: Sequence[str]) -> None:
        """Warn of fixed bounds outside which more than a hundredth of the noted observations were, and propose others.

        :param observed: least and largest of them, raw units, shape (2, n_variables)
        """
        share = self.n_outside[:-1] / max(1.0, self.n_outside[-1])
        many = np.flatnonzero(share > MANY_OUTSIDE)
        if not self._fixed or len(many) == 0:
            return
        low, high = wider_bounds(self.scaling, observed)
        shares = ", ".join(f"{names[k]} in {100 * share[k]:.0f} %" for k in many.tolist())
        warn_user(
            f"observations were outside the bounds and counted as the nearest state inside: {shares} of "
            f"{self.n_outside[-1]:.0f} observations; all are inside bounds=({low}, {high}), or leave bounds out, and they are "
            "found"
        )
