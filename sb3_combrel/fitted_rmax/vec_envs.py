"""What environments return and define beside observations and rewards."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_combrel.common.observations import last_observation
from sb3_combrel.common.user_warnings import warn_user


def joined_names(saved: dict[str, Any], of_env: dict[str, Any]) -> dict[str, Any]:
    """The names of a saved model, if any, and of its new environment; a ValueError if both have some, and they differ."""
    for key, names in of_env.items():
        if names != saved.get(key, names):
            raise ValueError(f"env must have the {key} of the model, {saved[key]}, got {names}")
    return {**saved, **of_env}


def warn_of_shared(env: VecEnv, callback: BaseCallback) -> None:
    """Warn if a callback evaluates in the environment that is learned in: its episodes would be mixed up with the others."""
    parts = [getattr(callback, "callback", None), *getattr(callback, "callbacks", ())]
    for part in parts:
        if isinstance(part, BaseCallback):
            warn_of_shared(env, part)
    own, evaluated = (
        {id(each.unwrapped) for each in getattr(getattr(which, "unwrapped", None), "envs", ())}
        for which in (env, getattr(callback, "eval_env", None))
    )
    if own & evaluated:
        warn_user(
            f"{type(callback).__name__} evaluates in the environment that the model learns in: after each evaluation it "
            "takes a state of that for the one that its own action has led to; give it an environment of its own"
        )


def refuse_running_means(env: VecEnv) -> None:
    """:raises ValueError: if observations, or rewards but by ``VecNormalize``, are normalized by means that run"""
    normalizer = unwrap_vec_normalize(env)
    run = env.has_attr("update_running_mean") and any(env.get_attr("update_running_mean"))
    wrappers = gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward
    if (normalizer is not None and normalizer.norm_obs) or (run and any(any(env.env_is_wrapped(each)) for each in wrappers)):
        raise ValueError(
            "FittedRMax needs VecNormalize(norm_obs=False), whose rewards it undoes, and no NormalizeObservation and no "
            "NormalizeReward whose update_running_mean is True: it scales observations itself, takes rewards of any size, and "
            "means that run would move both under a model that has learned"
        )


def true_outcomes(new_obs: Any, infos: list[dict[str, Any]], ended: list[int]) -> tuple[np.ndarray, list[bool]]:
    """Where each step led before environments reset themselves, and whether that was terminal, which a time limit is not.

    :param ended: the environments whose episode has ended
    """
    next_obs, terminated = np.array(new_obs), [False] * len(infos)
    for e in ended:
        next_obs[e] = last_observation(infos[e], new_obs[e])
        terminated[e] = not infos[e].get("TimeLimit.truncated", False)
    return next_obs, terminated
