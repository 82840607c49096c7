"""Pendulums and a car that are driven by a few forces: tasks of Gymnasium and of dm_control's suite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import TimeLimit, TransformAction

from sb3_combrel.runs.job import make_env
from sb3_combrel.wrappers import AngleObservation

#: dm_control's episodes: so many decisions, each of so many of its control steps.
N_DECISIONS, STEPS_A_DECISION = 500, 2
#: Bounds of the positions of dm_control's cart, metres, and of speeds, per second, far beyond what is reached.
FAR, FAST = 10.0, 60.0


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


class _DmControl(gym.Env):
    """A task of dm_control's suite with a Box action of one number, seen by its positions, angle and speeds.

    :param high: upper bounds of these; the lower ones are as far
    """

    def __init__(self, domain: str, task: str, high: Sequence[float]):
        # Only who makes one needs MuJoCo.
        from dm_control import suite

        self._environment = suite.load(domain, task, task_kwargs={"time_limit": np.inf})
        #: The angle is, between the positions and as many speeds.
        self.periodic = [k == len(high) // 2 - 1 for k in range(len(high))]
        self.observation_space = Box(-np.array(high), np.array(high), dtype=np.float64)
        self.action_space = Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self._environment.task.random.seed(int(self.np_random.integers(2**32)))
        return self._state(self._environment.reset().observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        steps = [self._environment.step(action) for _ in range(STEPS_A_DECISION)]
        reward = float(np.mean([step.reward for step in steps]))
        return self._state(steps[-1].observation), reward, False, False, {}

    def _state(self, observation: Any) -> np.ndarray:
        """The positions, with the angle in place of cosine and sine at their end, and the speeds."""
        given = observation["position" if "position" in observation else "orientation"]
        *positions, cosine, sine = given.tolist()
        return np.array([*positions, np.arctan2(sine, cosine), *observation["velocity"]])


def make_dm_pendulum() -> gym.Env:
    """Make dm_control's pendulum, to be swung up, with five torques; its angle is 0 when it stands."""
    env = _DmControl("pendulum", "swingup", (np.pi, FAST))
    return with_forces(TimeLimit(env, N_DECISIONS), np.linspace(-1.0, 1.0, 5).tolist())


def make_dm_cart_pole() -> gym.Env:
    """Make dm_control's cart with a pole, to be balanced, with three forces."""
    env = _DmControl("cartpole", "balance", (FAR, np.pi, FAST, FAST))
    return with_forces(TimeLimit(env, N_DECISIONS), (-1.0, 0.0, 1.0))
