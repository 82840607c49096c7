"""The experiment of Section 5.2: the iCub's torso is the source of its arm, both striking a ball."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_combrel import SourceInstances
from sb3_combrel.runs.job import make_env

SOURCE_ID = "combrel/ICubTorsoStrike-v0"
TARGET_ID = "combrel/ICubArmStrike-v0"
N_INSTANCES = 1000
MAX_EPISODE_STEPS = 400

#: Defaults but for the bound of the return: a hit by the first command returns 99.
LEARNER: dict[str, Any] = {"max_value": 100.0}


def learn_source(seed: int = 0) -> SourceInstances:
    """Learn the source task by Fitted R-Max and keep 1000 instances that cover the visited states, hits included."""
    return SourceInstances.from_fitted_rmax(SOURCE_ID, N_INSTANCES, seed, **LEARNER)


class FreePostures(gym.Wrapper[np.ndarray, int, np.ndarray, int]):
    """Begins each episode of the iCub in a posture drawn uniformly, clear of the table, and ends it after a step."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a posture; see ``gymnasium.Env.reset``."""
        self.env.reset(seed=seed)
        space = self.env.observation_space
        assert isinstance(space, gym.spaces.Box)
        while True:
            posture = self.unwrapped.np_random.uniform(space.low, space.high)
            try:
                return self.env.reset(options={"start": tuple(posture)})
            except ValueError:  # the hand would be in the table
                continue

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take the only step of the episode."""
        state, reward, terminated, _, info = self.env.step(action)
        return state, float(reward), terminated, not terminated, info


def record_dynamics(seed: int = 0, n: int = 2 * N_INSTANCES) -> SourceInstances:
    """Record how the arm itself moves, everywhere, and nothing of the ball: no instance is a hit."""
    source = SourceInstances.record(None, FreePostures(make_env(TARGET_ID)), n, seed)
    missed = np.full(n, source.rewards.min())
    return replace(source, rewards=missed, terminated=np.zeros(n, dtype=np.bool_))
