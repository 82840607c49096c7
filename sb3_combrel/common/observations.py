"""Observations of an environment as states in unit coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_combrel.common.compiled import entry_point
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.user_warnings import warn_user

# Excess over the bounds, in unit coordinates, that rounding can explain.
ROUNDING = 1e-6


def with_own_arrays(env: Any) -> Any:
    """An environment in :class:`OwnArrays`, or with those that it holds in them, if their observations are arrays."""
    if isinstance(env, gym.Env):
        needs_it = isinstance(env.observation_space, spaces.Box) and not isinstance(env, OwnArrays)
        return OwnArrays(env) if needs_it else env
    # A vectorised one; those of a ``SubprocVecEnv`` are out of reach.
    envs = getattr(getattr(env, "unwrapped", None), "envs", [])
    envs[:] = map(with_own_arrays, envs)
    return env


class OwnArrays(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose observations are copies: some return one array, and change it at the next step or reset.

    It refuses what Stable-Baselines3 would take for something else without a word: an observation of another shape, which is
    repeated until it fits, and text, which counts as true.
    """

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """:raises ValueError: if the observation has another shape than its space"""
        observation, info = self.env.reset(**options)
        return self._own(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """:raises ValueError: the same; or if reward, terminated or truncated is text"""
        observation, reward, terminated, truncated, info = self.env.step(action)
        for name, value in (("reward", reward), ("terminated", terminated), ("truncated", truncated)):
            if isinstance(value, str):
                wanted = "a number" if name == "reward" else "True or False"
                raise ValueError(f"step must return {name} as {wanted}, not as text, got {value!r}")
        return self._own(observation), reward, terminated, truncated, info

    def __setattr__(self, name: str, value: Any) -> None:
        # What ``VecEnv.set_attr`` sets is the environment's, as it would be without this.
        if name.startswith("_") or "env" not in vars(self) or hasattr(type(self), name):
            super().__setattr__(name, value)
        else:
            setattr(self.env, name, value)

    def _own(self, observation: Any) -> np.ndarray:
        copied = np.array(observation)
        if copied.shape != self.observation_space.shape:
            wanted = f"the shape {self.observation_space.shape} of env.observation_space"
            raise ValueError(f"an observation must have {wanted}, got {observation!r}")
        return copied


def last_observation(info: Mapping[str, Any], first: Any) -> Any:
    """What an episode has ended with, before its environment was reset to ``first``; a warning if it is the same."""
    last = info["terminal_observation"]
    if np.array_equal(last, first):
        warn_user(
            "the last observation of an episode equals the first of the next: if that is not so in your task, the "
            "environment returns one array each time and changes it; let it return observation.copy()"
        )
    return last


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
