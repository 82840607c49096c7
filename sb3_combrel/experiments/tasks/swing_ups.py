"""Pendulums and a car that are driven by a few forces: tasks of Gymnasium and of dm_control's suite."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.wrappers import TransformAction

from sb3_combrel.experiments.tasks.dm_suite import make_dm_control
from sb3_combrel.runs.job import make_env
from sb3_combrel.wrappers import AngleObservation


def with_forces(env: gym.Env, forces: Sequence[float]) -> gym.Env:
    """Let Discrete actions choose among some values of a Box action of one number."""
    values = np.array(forces, dtype=np.float32)
    return TransformAction(env, lambda action: values[[int(action)]], Discrete(len(values)))


def make_torques() -> gym.Env:
    """Make Gymnasium's pendulum with five torques, from the least to the largest."""
    return with_forces(make_env("Pendulum-v1", disable_env_checker=True), np.linspace(-2.0, 2.0, 5).tolist())


def make_pendulum() -> gym.Env:
    """Make it with its angle as a state variable."""
    return AngleObservation(make_torques())


def make_car() -> gym.Env:
    """Make Gymnasium's continuous mountain car with three forces."""
    return with_forces(make_env("MountainCarContinuous-v0", disable_env_checker=True), (-1.0, 0.0, 1.0))


def make_dm_pendulum() -> gym.Env:
    """Make dm_control's pendulum, to be swung up, with five torques; its angle is 0 when it stands."""
    return with_forces(make_dm_control("pendulum", "swingup"), np.linspace(-1.0, 1.0, 5).tolist())


def make_dm_cart_pole() -> gym.Env:
    """Make dm_control's cart with a pole, to be balanced, with three forces."""
    return with_forces(make_dm_control("cartpole", "balance"), (-1.0, 0.0, 1.0))
