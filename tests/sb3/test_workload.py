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


@pytest.mark.parametrize(
    ("d", "n_actions", "resolution", "n_points", "n_pairs"),
    [(2, 3, 10, "1,054,729", "3,164,187"), (4, 5, 5, "1,185,921", "5,929,605")],
)
def test_a_grid_that_takes_long_is_announced_before_the_agent_is_made(
    d, n_actions, resolution, n_points, n_pairs, monkeypatch
):
    class Begins(Exception):
        pass

    def begin(self):
        raise Begins

    monkeypatch.setattr(FittedRMaxAgent, "_build", begin)
    with pytest.warns(UserWarning, match=f"{n_points} grid points and {n_pairs} state-action pairs: .*seconds") as caught:
        with pytest.raises(Begins):
            FittedRMax(Still(d, n_actions), resolution=resolution)
    assert f"resolution={[resolution] * d}" in str(caught[0].message)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("settings", [{}, dict(resolution=6), dict(resolution=[7, 3])])
def test_a_grid_that_takes_no_time_is_not_announced(name, settings):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not small(transfer=METHODS[name](), **settings).agent.workload.is_long


def test_with_verbose_the_size_of_the_grid_is_printed(capsys):
    model = small(verbose=1)
    n_points = model.agent.grid.n_points
    assert f"{n_points:,} grid points and {2 * n_points:,} state-action pairs" in capsys.readouterr().out
    small()
    assert "grid points" not in capsys.readouterr().out


def test_the_points_that_an_instance_reaches_are_those_within_the_kernels_reach():
    """The estimated time of a step is in proportion to the grid points that a count finds."""
    settings = ModelSettings(model_breadth=0.1, min_weight=0.01, min_fraction=0.1, exploration_threshold=1.0)
    for d, resolution in ((1, 9), (2, 7), (3, 5)):
        grid = StateGrid(d, resolution)
        distance = np.linalg.norm(grid.points() - 0.5, axis=1)
        counted = np.sum(np.exp(-((distance / 0.1) ** 2)) >= 0.01)
        found = workload(grid, 2, settings, transfers=False)
        whole = workload(grid, 2, ModelSettings(10.0, 0.01, 0.1, 1.0), transfers=False)
        assert found.step_seconds / whole.step_seconds * grid.n_points == pytest.approx(counted, rel=0.15)
        assert whole.step_seconds == workload(grid, 5, ModelSettings(10.0, 0.01, 0.1, 1.0), transfers=False).step_seconds


def test_finer_grids_and_transfer_take_longer():
    settings = ModelSettings(model_breadth=0.1, min_weight=0.01, min_fraction=0.1, exploration_threshold=1.0)
    times = [workload(StateGrid(2, n), 3, settings, transfers=transfers) for transfers in (False, True) for n in (5, 8)]
    for shorter, longer in ((times[0], times[1]), (times[2], times[3]), (times[0], times[2]), (times[1], times[3])):
        assert shorter.setup_seconds < longer.setup_seconds and shorter.step_seconds < longer.step_seconds
