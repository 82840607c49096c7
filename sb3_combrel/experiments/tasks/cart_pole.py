"""From CartPole-v1 to a cart with a pole of twice the length, whose variables stand in another order.

Transfer gives a good first episode here; what is asked is whether the policy after learning is still as good as without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_combrel import InterTaskMapping, SourceInstances
from sb3_combrel.runs.job import chosen_on_purpose, make_env

SOURCE_ID = "CartPole-v1"
N_INSTANCES = 1000
#: Enough that most of the experience is of balancing the pole.
N_SOURCE_EPISODES = 50
#: The kernel average falls in more places than the local linear model before it balances the pole. Without the falls nothing
#: tells the target which states to avoid, and there is no jumpstart that could be paid for later.
SOURCE_DEGREE = 0

#: As in zoo_configs/fitted_rmax.yml. The velocities of the pole and the cart have no bounds of their own.
LEARNER: dict[str, Any] = {"gamma": 0.99, "max_value": 100.0, "bounds": ([-4.8, -3.0, -0.23, -3.2], [4.8, 3.0, 0.23, 3.2])}

#: Half the length of the pole, as Gymnasium counts it: 0.5 in CartPole-v1.
LONG = 1.0
#: The target's variables, as indices of CartPole-v1's: angle, position, angular velocity, velocity. None keeps its place.
ORDER = (2, 0, 3, 1)
#: :data:`LEARNER` for the target.
LONG_LEARNER: dict[str, Any] = {**LEARNER, "bounds": tuple([side[i] for i in ORDER] for side in LEARNER["bounds"])}


def make_cart_pole(half_length: float | None = None, order: Sequence[int] | None = None) -> gym.Env:
    """Make CartPole-v1, with another pole and its variables in another order if asked for.

    :param half_length: half the length of the pole, in metres; None for CartPole-v1's, 0.5
    :param order: for each variable of the observation the index of CartPole-v1's; None for CartPole-v1's own order
    :raises ValueError: if ``half_length`` is not a positive finite number, or ``order`` is no permutation of the variables
    """
    env = make_env(SOURCE_ID, disable_env_checker=True)
    if half_length is not None:
        if not (np.isfinite(half_length) and half_length > 0.0):
            raise ValueError(f"half_length must be a positive finite number, got {half_length!r}")
        env.unwrapped.length = half_length
        env.unwrapped.polemass_length = env.unwrapped.masspole * half_length
    return env if order is None else permuted(env, order)


def permuted(env: gym.Env, order: Sequence[int]) -> gym.Env:
    """Put the variables of an environment's observations and bounds in another order: for each new one the old one's index."""
    box = env.observation_space
    assert isinstance(box, spaces.Box)
    (n_variables,) = box.shape
    if sorted(order) != list(range(n_variables)):
        raise ValueError(f"order must hold each of 0 to {n_variables - 1} once, got {order!r}")
    rows = np.array(order, dtype=np.int64)
    low, high = box.low[rows], box.high[rows]
    return gym.wrappers.TransformObservation(
        env, lambda observation: observation[rows], spaces.Box(low, high, dtype=box.dtype.type)
    )


def right_mapping() -> InterTaskMapping:
    """Return the mapping of the target's variables to CartPole-v1's, with each action as it is."""
    return InterTaskMapping(state=ORDER, action=(0, 1))


def learn_source(seed: int = 0) -> SourceInstances:
    """Learn CartPole-v1 by Fitted R-Max and keep 1000 instances that cover the visited states, falls included."""
    with closing(make_cart_pole()) as env, chosen_on_purpose():
        return SourceInstances.from_fitted_rmax(
            env, N_INSTANCES, seed, n_episodes=N_SOURCE_EPISODES, degree=SOURCE_DEGREE, **LEARNER
        )
