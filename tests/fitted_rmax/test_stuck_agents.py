"""Exploration ends: where interpolated values are too high and the agent makes no progress, they are corrected."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

import sb3_combrel.fitted_rmax.agent as agent
from sb3_combrel import FittedRMax

STEP_LIMIT = 100


class TwoJoints(gym.Env):
    """Two joints, each action moves one of them a little; a block that they can't enter stands between start and goal.

    The shortest plan around it has 34 steps. With resolution 3 a cell is wider than the kernel's reach at breadth 0.04: grid
    points inside the block stay optimistic for ever, and the states before it are interpolated as if they led through.
    """

    observation_space = spaces.Box(0.0, 1.0, (2,), dtype=np.float64)
    action_space = spaces.Discrete(4)

    def __init__(self, step=0.05):
        self.step_length = step

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joints = np.zeros(2)
        return self.joints.copy(), {}

    def step(self, action):
        to = self.joints.copy()
        to[action // 2] += self.step_length if action % 2 else -self.step_length
        to = np.clip(to, 0.0, 1.0)
        if not (0.4 < to[0] < 0.6 and to[1] < 0.75):
            self.joints = to
        return self.joints.copy(), -1.0, bool((np.abs(self.joints - 0.9) <= 0.06).all()), False, {}


def lengths_of_episodes(seed, n_episodes, degree, step=0.05):
    env = gym.wrappers.TimeLimit(TwoJoints(step), STEP_LIMIT)
    with pytest.warns(UserWarning, match="coarse"):
        model = FittedRMax(env, model_breadth=0.04, resolution=3, min_fraction=0.1, degree=degree, seed=seed)
    monitor = model.get_env().envs[0]
    model.learn(n_episodes * STEP_LIMIT, callback=StopTrainingOnMaxEpisodes(n_episodes))
    return np.array(monitor.get_episode_lengths())


def test_with_corrections_the_agent_is_not_stuck_where_it_would_be_without(monkeypatch):
    assert (lengths_of_episodes(0, 80, 0)[-20:] < STEP_LIMIT).all()
    monkeypatch.setattr(agent, "MAX_VISITS", 10**9)
    assert (lengths_of_episodes(0, 25, 0)[-15:] == STEP_LIMIT).all()


@pytest.mark.long
@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("step", [0.05, 1 / 24, 0.043])
def test_with_corrections_the_agent_is_never_stuck_whatever_the_step_length(step, degree):
    """Also where steps and cells are commensurate, so that states lie on the cells' edges."""
    for seed in range(3):
        lengths = lengths_of_episodes(seed, 120, degree, step)
        assert (lengths[-20:] < STEP_LIMIT).all(), (seed, lengths)
