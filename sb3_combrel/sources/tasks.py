"""What is read of a source task: its environment by id, its names, and where transitions come from."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv


def make_env(env: str | gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """
    The environment of an id, or the one given.

    :param env: an environment or its id; ids of this project's environments need no import of ``combrel_envs``
    """
    if not isinstance(env, str):
        return env
    return gym.make(f"combrel_envs:{env}" if env.startswith("combrel/") else env)


def task_names(env: VecEnv | gym.Env[Any, Any]) -> dict[str, tuple[Any, ...]]:
    """``state_names`` and ``action_names`` of a task, and which of its states are ``periodic``, as far as it says so."""
    names = {}
    for attribute in ("state_names", "action_names"):
        value = _attribute(env, attribute)
        if value is not None:
            names[attribute] = tuple(value)
    periodic = _attribute(env, "periodic")
    is_list = isinstance(periodic, Sequence | np.ndarray) and len(periodic) == (env.observation_space.shape or (0,))[0]
    if is_list and all(isinstance(flag, bool | np.bool_) for flag in periodic):
        names["periodic"] = tuple(map(bool, periodic))
    return names


def _attribute(env: VecEnv | gym.Env[Any, Any], name: str) -> Any:
    """Return an attribute of an environment or of one of its wrappers, None if there is none."""
    if isinstance(env, VecEnv):
        return env.get_attr(name, 0)[0] if env.has_attr(name) else None
    try:
        return env.get_wrapper_attr(name)
    except AttributeError:
        return None


def describe_origin(env: VecEnv | gym.Env[Any, Any], recorder: str, seed: int | None) -> dict[str, Any]:
    """
    Where instances come from: id of the environment, recorder, seed and version of this package.

    :param env: the environment
    :param recorder: what acted in it
    :param seed: its seed
    """
    if isinstance(env, VecEnv):
        spec = env.get_attr("spec", 0)[0] if env.has_attr("spec") else None
    else:
        spec = env.spec
    return {
        "env": None if spec is None else spec.id,
        "recorder": recorder,
        "seed": seed,
        "package": f"sb3-combrel {metadata.version('sb3-combrel')}",
    }
