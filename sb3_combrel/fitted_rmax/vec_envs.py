"""What environments return and define beside observations and rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


def names_of(env: VecEnv) -> dict[str, Any]:
    """Return names of state variables and actions, where the environment has as many of them as it must have."""
    lengths = {"state_names": (env.observation_space.shape or (0,))[0], "action_names": getattr(env.action_space, "n", 0)}
    found = {name: _list_of(env, name, n, (str,)) for name, n in lengths.items()}
    return {name: names for name, names in found.items() if names is not None}


def periodic_of(env: VecEnv) -> list[bool] | None:
    """Return which state variables are periodic, where the environment says so in its attribute ``periodic``."""
    flags = _list_of(env, "periodic", (env.observation_space.shape or (0,))[0], (bool, np.bool_))
    return None if flags is None else [bool(flag) for flag in flags]


def _list_of(env: VecEnv, name: str, n: int, types: tuple[type, ...]) -> list[Any] | None:
    """Return an attribute of the first environment, if it is ``n`` values of some types."""
    # Asking a SubprocVecEnv for an attribute that is not there would end its worker.
    value = env.get_attr(name, 0)[0] if n > 0 and env.has_attr(name) else None
    if not isinstance(value, Sequence | np.ndarray) or len(value) != n or not all(isinstance(each, types) for each in value):
        return None
    return list(value)


def refuse_normalized_observations(env: VecEnv) -> None:
    """:raises ValueError: if a ``VecNormalize`` normalizes the observations"""
    normalizer = unwrap_vec_normalize(env)
    if normalizer is not None and normalizer.norm_obs:
        raise ValueError(
            "FittedRMax needs VecNormalize(norm_obs=False), for it scales observations by their bounds itself: the statistics "
            "of norm_obs=True drift, and the model's grid is fixed"
        )


def true_outcomes(new_obs: Any, infos: list[dict[str, Any]], ended: list[int]) -> tuple[np.ndarray, list[bool]]:
    """Where each step led before environments reset themselves, and whether that was terminal, which a time limit is not.

    :param ended: the environments whose episode has ended
    """
    next_obs, terminated = np.array(new_obs), [False] * len(infos)
    for e in ended:
        next_obs[e] = infos[e]["terminal_observation"]
        terminated[e] = not infos[e].get("TimeLimit.truncated", False)
    return next_obs, terminated
