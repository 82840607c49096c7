"""A task that is another one in disguise: variables in another order, some mirrored, actions renamed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.tasks.cart_pole import permuted


class RenamedActions(gym.ActionWrapper):
    """Gives the actions of an environment, counted from 0, other numbers: ``order`` has for each new action the old one."""

    def __init__(self, env: gym.Env, order: Sequence[int]):
        super().__init__(env)
        assert isinstance(env.action_space, spaces.Discrete)
        if sorted(order) != list(range(int(env.action_space.n))):
            raise ValueError(f"order must hold each of 0 to {env.action_space.n - 1} once, got {order!r}")
        self._order = tuple(order)

    def action(self, action: Any) -> int:
        """Return the old action."""
        return self._order[int(action)]


def mirrored(env: gym.Env, variables: Sequence[bool]) -> gym.Env:
    """Mirror some variables of an environment's observations in their finite ranges: what was lowest is highest."""
    box = env.observation_space
    assert isinstance(box, spaces.Box)
    flags = np.array(variables, dtype=np.bool_)
    if flags.shape != box.shape:
        raise ValueError(f"variables must hold one bool for each of the {box.shape[0]} variables, got {variables!r}")
    low, high = box.low[flags], box.high[flags]
    if not np.isfinite([low, high]).all():
        raise ValueError(f"variables can be mirrored where bounds are finite, got {variables!r} with {box}")

    def observe(observation: np.ndarray) -> np.ndarray:
        found = observation.copy()
        # Rounding must not leave the box.
        found[flags] = np.clip(low + high - observation[flags], low, high)
        return found

    return gym.wrappers.TransformObservation(env, observe, box)


def disguised(env: gym.Env, order: Sequence[int], signs: Sequence[int], actions: Sequence[int]) -> gym.Env:
    """Make an environment with new orders, signs and actions, renamed; :func:`disguise` is the mapping back."""
    return RenamedActions(mirrored(permuted(env, order), [sign < 0 for sign in signs]), actions)


def disguise(order: Sequence[int], signs: Sequence[int], actions: Sequence[int]) -> InterTaskMapping:
    """Return the mapping of what :func:`disguised` makes to the environment that it is made of; the same arguments."""
    return InterTaskMapping(state=tuple(order), action=tuple(actions), sign=tuple(signs))
