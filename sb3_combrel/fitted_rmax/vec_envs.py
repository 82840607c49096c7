"""What environments return and define beside observations and rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


def names_of(env: VecEnv | None) -> dict[str, Any]:
    """Return names of state variables and actions, where the environment has as many of them as it must have."""
    if env is None:
        return {}
    found = {}
    counts = {"state_names": (env.observation_space.shape or (0,))[0], "action_names": getattr(env.action_space, "n", 0)}
    for name, n in counts.items():
        # Asking a SubprocVecEnv for an attribute that is not there would end its worker.
        if not env.has_attr(name):
            continue
        value = env.get_attr(name, 0)[0]
        if isinstance(value, Sequence) and len(value) == n and all(isinstance(each, str) for each in value):
            found[name] = list(value)
    return found


def periodic_of(env: VecEnv | None) -> list[bool] | None:
    """Return which state variables are periodic, where the environment says so in its attribute ``periodic``."""
    n = 0 if env is None else (env.observation_space.shape or (0,))[0]
    if env is None or n == 0 or not env.has_attr("periodic"):
        return None
    value = env.get_attr("periodic", 0)[0]
    is_list = isinstance(value, Sequence | np.ndarray) and len(value) == n
    return [bool(flag) for flag in value] if is_list and all(isinstance(flag, bool | np.bool_) for flag in value) else None


def refuse_normalized_observations(env: VecEnv) -> None:
    """
    :raises ValueError: if a ``VecNormalize`` normalizes the observations
    """
    normalizer = unwrap_vec_normalize(env)
    if normalizer is not None and normalizer.norm_obs:
        raise ValueError(
            "FittedRMax needs VecNormalize(norm_obs=False), for it scales observations by their bounds itself: the statistics "
            "of norm_obs=True drift, and the model's grid is fixed"
        )


def true_outcomes(
    new_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]], ended: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """
    Find out where each step led before environments reset themselves, and whether that was a terminal state.

    :param new_obs: observations after the step, those of the next episode where one is done
    :param dones: bool, shape (n_envs,)
    :param infos: of each environment
    :param ended: the environments that are done
    :return: observations, and bool, shape (n_envs,); a time limit is no terminal state
    """
    if not ended:
        return np.asarray(new_obs), dones
    next_obs = np.array(new_obs)
    terminated = np.array(dones, dtype=bool)
    for e in ended:
        next_obs[e] = infos[e]["terminal_observation"]
        terminated[e] = not infos[e].get("TimeLimit.truncated", False)
    return next_obs, terminated
