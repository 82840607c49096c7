"""What environments say beside observations and rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


def names_of(env: VecEnv | None) -> dict[str, Any]:
    """Names of state variables and actions, where the environment has them."""
    if env is None:
        return {}
    found = {}
    for name in ("state_names", "action_names"):
        # Asking a SubprocVecEnv for an attribute that is not there would end its worker.
        if not env.has_attr(name):
            continue
        value = env.get_attr(name, 0)[0]
        if isinstance(value, Sequence) and not isinstance(value, str):
            found[name] = value
    return found


def refuse_normalized_observations(env: VecEnv) -> None:
    """Raise a ValueError if a ``VecNormalize`` normalizes the observations."""
    normalizer = unwrap_vec_normalize(env)
    if normalizer is not None and normalizer.norm_obs:
        raise ValueError(
            "FittedRMax needs VecNormalize(norm_obs=False), for it scales observations by their bounds itself: the statistics "
            "of norm_obs=True drift, and the model's grid is fixed"
        )


def true_outcomes(
    new_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]], ended: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where each step led, before an environment reset itself, and whether that was a terminal state.

    :param ended: the environments that are done
    """
    if not ended:
        return np.asarray(new_obs), dones
    next_obs = np.array(new_obs)
    terminated = np.array(dones, dtype=bool)
    for e in ended:
        next_obs[e] = infos[e]["terminal_observation"]
        terminated[e] = not infos[e].get("TimeLimit.truncated", False)
    return next_obs, terminated
