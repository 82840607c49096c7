"""Grids that take long are announced before the work begins."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from helpers.walk import METHODS, small

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.workload import workload
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.planning.grid import StateGrid


class Still(gym.Env):
    """Nothing happens, in so many state variables."""

    def __init__(self, d, n_actions):
        self.observation_space = spaces.Box(0.0, 1.0, (d,))
        self.action_space = spaces.Discrete(n_actions)

    def reset(self, *, seed=None, options=None):
        return np.full(self.observation_space.shape, 0.5, dtype=np.float32), {}

    def step(self, action):
        return self.reset()[0], -1.0, False, False, {}


def test_a_grid_that_takes_long_is_announced_before_the_agent_is_made(monkeypatch):
    class Begins(Exception):
        pass

    def begin(self):
        raise Begins

    monkeypatch.setattr(FittedRMaxAgent, "_build", begin)
    with pytest.warns(UserWarning, match="1,185,921 grid points and 5,929,605 state-action pairs: .*seconds") as caught:
        with pytest.raises(Begins):
            FittedRMax(Still(4, 5), resolution=5)
    assert "resolution=[5, 5, 5, 5]" in str(caught[0].message)


@pytest.mark.parametrize("name", METHODS)
def test_a_grid_that_takes_no_time_is_not_announced(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small(transfer=METHODS[name](), resolution=[7, 3])


def test_with_verbose_the_size_of_the_grid_is_printed(capsys):
    n_points = small(verbose=1).agent.grid.n_points
    assert f"{n_points:,} grid points and {2 * n_points:,} state-action pairs" in capsys.readouterr().out
    small()
    assert "grid points" not in capsys.readouterr().out


def test_the_points_that_an_instance_reaches_are_those_within_the_kernels_reach():
    """The estimated time of a step is in proportion to the grid points that a count finds."""
    settings = ModelSettings(model_breadth=0.1, min_weight=0.01, min_fraction=0.1, exploration_threshold=1.0)
    for d, resolution in ((1, 9), (2, 7), (3, 5)):
        grid = StateGrid(d, resolution)
        counted = np.sum(np.exp(-((np.linalg.norm(grid.points() - 0.5, axis=1) / 0.1) ** 2)) >= 0.01)
        found = workload(grid, 2, settings, transfers=False)
        whole = workload(grid, 2, ModelSettings(10.0, 0.01, 0.1, 1.0), transfers=False)
        assert found.step_seconds / whole.step_seconds * grid.n_points == pytest.approx(counted, rel=0.15)
        assert whole.step_seconds == workload(grid, 5, ModelSettings(10.0, 0.01, 0.1, 1.0), transfers=False).step_seconds
        transferring = workload(grid, 2, settings, transfers=True)
        assert transferring.setup_seconds > found.setup_seconds and transferring.step_seconds > found.step_seconds
