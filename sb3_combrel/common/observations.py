"""Observations of an environment as states in unit coordinates."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_combrel.common.compiled import entry_point
from sb3_combrel.common.scaling import StateScaling

# Excess over the bounds, in unit coordinates, that rounding can explain.
ROUNDING = 1e-6


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
