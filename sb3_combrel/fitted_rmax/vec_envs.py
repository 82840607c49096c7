"""What environments return and define beside observations and rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_combrel.common.user_warnings import warn_user


def names_of(env: VecEnv) -> dict[str, Any]:
    """Return names of state variables and actions, where the environment has as many of them as it must have."""
    found = {name: _list_of(env, name, str) for name in ("state_names", "action_names")}
    return {name: names for name, names in found.items() if names}


def joined_names(saved: dict[str, Any], of_env: dict[str, Any]) -> dict[str, Any]:
    """The names of a saved model, if any, and of its new environment; a ValueError if both have some, and they differ."""
    for key, names in of_env.items():
        if names != saved.get(key, names):
            raise ValueError(f"env must have the {key} of the model, {saved[key]}, got {names}")
    return {**saved, **of_env}


def periodic_of(env: VecEnv) -> list[bool] | None:
    """Return which state variables are periodic, where the environment says so in its attribute ``periodic``."""
    flags = _list_of(env, "periodic", bool, np.bool_)
    return None if flags is None else [bool(flag) for flag in flags]


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


def _list_of(env: VecEnv, name: str, *types: type) -> list[Any] | None:
    """An attribute of the first environment, if it is a value for each variable, or action; a warning if it is not."""
    what = "action" if name == "action_names" else "variable"
    n = int(getattr(env.action_space, "n", 0) if what == "action" else (env.observation_space.shape or (0,))[0])
    # Asking a SubprocVecEnv for an attribute that is not there would end its worker.
    if n == 0 or not env.has_attr(name):
        return None
    value = env.get_attr(name, 0)[0]
    is_list = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
    if is_list and len(value) == n and all(isinstance(each, types) for each in value):
        return list(value)
    if not (types == (str,) and (value is None or (is_list and len(value) == 0))):
        warn_user(
            f"the environment's {name}={value!r} is not one {types[0].__name__} for each of the {n} {what}s, and is ignored: "
            f"{'pass FittedRMax(env, periodic=[...])' if name == 'periodic' else 'an environment may leave it out'}"
        )
    return None


def has_time_limit(env: VecEnv) -> bool:
    """Whether Gymnasium's wrapper limits the length of episodes."""
    return any(env.env_is_wrapped(gym.wrappers.TimeLimit))


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
        next_obs[e] = infos[e]["terminal_observation"]
        terminated[e] = not infos[e].get("TimeLimit.truncated", False)
    return next_obs, terminated
