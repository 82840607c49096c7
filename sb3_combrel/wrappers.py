"""Wrappers for Gymnasium environments: observations in the variables that a model of the dynamics needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import AcrobotEnv, PendulumEnv
from numpy.typing import NDArray

from sb3_combrel.common.attributes import list_of
from sb3_combrel.common.checks import check_count

# What a cosine or a sine may exceed 1 by: bounds are often float32.
_ROUNDING = 1e-3
# By so much the squares of a cosine and a sine may differ from 1, for noisy sensors.
_NO_ANGLE = 0.2

# Pairs of the environments whose layout is known, and the names of the variables that result.
_KNOWN: tuple[tuple[type[gym.Env[Any, Any]], int, tuple[tuple[int, int], ...], tuple[str, ...]], ...] = (
    (AcrobotEnv, 6, ((0, 1), (2, 3)), ("theta1", "theta2", "theta1_dot", "theta2_dot")),
    (PendulumEnv, 3, ((0, 1),), ("theta", "theta_dot")),
)


class AngleObservation(
    gym.ObservationWrapper[NDArray[Any], Any, NDArray[Any]],  # type: ignore[misc]
    gym.utils.RecordConstructorArgs,
):
    """Turns pairs of observations (cos, sin) into one observation each: the angle, from -pi to pi.

    The state of Acrobot or Pendulum is one of angles and velocities; with a cosine and a sine in place of each angle it lies
    on a curved surface in a space of more variables, most of which no state has. An angle stands where its cosine was, the
    other variables stay in their order: Acrobot's six variables become (theta1, theta2, theta1_dot, theta2_dot).

    The attributes ``periodic`` (which variables are angles, one bool for each) and ``state_names`` tell
    :class:`~sb3_combrel.FittedRMax` all that it needs: ``FittedRMax(AngleObservation(gymnasium.make("Acrobot-v1")))``. In
    RL-Zoo's YAML files: ``env_wrapper: sb3_combrel.wrappers.AngleObservation``.

    :param env: an environment whose observations are a one-dimensional Box of floating-point numbers
    :param pairs: (index of the cosine, index of the sine) for each angle; None: those of Acrobot and Pendulum
    :raises ValueError: if the observation space is no such Box, if ``pairs`` is None and the environment another, or if
        ``pairs`` are not pairs of different indices of variables between -1 and 1; from ``reset`` and ``step``, if the squares
        of a pair do not add up to 1
    """

    def __init__(self, env: gym.Env[Any, Any], pairs: Sequence[Sequence[int]] | None = None):
        gym.utils.RecordConstructorArgs.__init__(self, pairs=pairs)
        gym.ObservationWrapper.__init__(self, env)
        box = env.observation_space
        if not isinstance(box, spaces.Box) or len(box.shape) != 1 or not np.issubdtype(box.dtype, np.floating):
            raise ValueError(f"env must have observations in a one-dimensional Box of floating-point numbers, got {box}")
        known, names = _known_layout(env, box.shape[0])
        self._cos, self._sin = _checked_pairs(known if pairs is None else pairs, box)
        self._kept = np.setdiff1d(np.arange(box.shape[0]), self._sin)
        self._angles = np.isin(self._kept, self._cos)
        # In the order in which the angles stand.
        self._sin = self._sin[np.argsort(self._cos)]
        self._cos = np.sort(self._cos)
        low, high = box.low[self._kept], box.high[self._kept]
        low[self._angles], high[self._angles] = -np.pi, np.pi
        self.observation_space = spaces.Box(low, high, dtype=box.dtype.type)
        inner = list_of(env, "periodic", bool, np.bool_) or [False] * box.shape[0]
        #: Which variables are periodic: the angles, and what the wrapped environment says of the others.
        self.periodic = tuple(bool(angle or inner[k]) for angle, k in zip(self._angles, self._kept, strict=True))
        is_known = known is not None and np.array_equal(np.sort(known, axis=0), np.stack([self._cos, self._sin], axis=1))
        #: The names of the variables.
        self.state_names = names if is_known else self._names(list_of(env, "state_names", str))

    def _names(self, given: Sequence[str] | None) -> tuple[str, ...]:
        """Name the variables: as the wrapped environment does, or s with the index; an angle by its cosine."""
        of_all = [f"s{k}" for k in range(self.env.observation_space.shape[0])] if given is None else given  # type: ignore[index]
        return tuple(f"angle_{of_all[k]}" if angle else of_all[k] for angle, k in zip(self._angles, self._kept, strict=True))

    def observation(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Replace the pairs of one observation by angles.

        :param observation: of the wrapped environment, shape (n,)
        :return: of the wrapper, shape (n - n_pairs,), same type
        """
        whole = np.asarray(observation, dtype=self.env.observation_space.dtype)
        found, cos, sin = whole[self._kept], whole[self._cos], whole[self._sin]
        squares = cos * cos + sin * sin
        if np.abs(squares - 1.0).max() > _NO_ANGLE:
            pairs = list(zip(self._cos.tolist(), self._sin.tolist(), strict=True))
            raise ValueError(
                f"the squares of a cosine and a sine must add up to 1, got {squares.tolist()} for pairs={pairs}: wrap the "
                "environment before its observations are rescaled or normalised, or pass other pairs"
            )
        found[self._angles] = np.arctan2(sin, cos)
        return found


def _known_layout(env: gym.Env[Any, Any], n: int) -> tuple[tuple[tuple[int, int], ...] | None, tuple[str, ...]]:
    for kind, n_variables, pairs, names in _KNOWN:
        if isinstance(env.unwrapped, kind) and n == n_variables and env.observation_space == env.unwrapped.observation_space:
            return pairs, names
    return None, ()


def _checked_pairs(pairs: Any, box: spaces.Box) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the cosines and of the sines.

    :raises ValueError: see :class:`AngleObservation`
    """
    n = box.shape[0]
    right = f"pairs must be (index of the cosine, index of the sine) for each angle, out of {n} variables, each index once"
    if pairs is None:
        raise ValueError(f"{right}; for this environment they are not known: pass them, such as pairs=[(0, 1)]; got None")
    is_list = isinstance(pairs, Sequence | np.ndarray) and not isinstance(pairs, str) and len(pairs) > 0
    if not is_list or not all(isinstance(p, Sequence | np.ndarray) and not isinstance(p, str) and len(p) == 2 for p in pairs):
        raise ValueError(f"{right}, got {pairs!r}")
    indices = [index for pair in pairs for index in pair]
    for index in indices:
        check_count("pairs: each index", index, min=0, max=n - 1)
    if len(set(indices)) < len(indices):
        raise ValueError(f"{right}, got {pairs!r}")
    for index in indices:
        if np.isfinite([box.low[index], box.high[index]]).all() and max(-box.low[index], box.high[index]) > 1 + _ROUNDING:
            raise ValueError(
                f"pairs must name cosines and sines, which are from -1 to 1; got {pairs!r}, and variable {index} is from "
                f"{box.low[index]:g} to {box.high[index]:g}"
            )
    return np.array(indices[::2], dtype=np.int64), np.array(indices[1::2], dtype=np.int64)
