"""What is read of a source task: its environment by id, its names, and where transitions come from."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv


def make_env(env: str | gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """
    The environment of an id, or the one given.

    :param env: an environment or its id; ids of this project's environments need no import of ``combrel_envs``
    """
    if not isinstance(env, str):
        return env
    return gym.make(f"combrel_envs:{env}" if env.startswith("combrel/") else env)


def task_names(env: VecEnv | gym.Env[Any, Any]) -> dict[str, tuple[str, ...]]:
    """``state_names`` and ``action_names`` of a task, as far as it has them."""
    names = {}
    for attribute in ("state_names", "action_names"):
        if isinstance(env, VecEnv):
            value = env.get_attr(attribute, 0)[0] if env.has_attr(attribute) else None
        else:
            value = getattr(env.unwrapped, attribute, None)
        if value is not None:
            names[attribute] = tuple(value)
    return names


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
