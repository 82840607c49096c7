"""Vectorised environments, VecNormalize, Monitor, set_env."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from helpers.walk import METHODS, Recorder, Walk, small, stored
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.workload import workload
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.planning.grid import StateGrid


@pytest.mark.parametrize("vec_env", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.long)])
def test_several_environments_feed_one_model(vec_env):
    runs, recorder = [], Recorder()
    for each in (DummyVecEnv, vec_env):
        env = make_vec_env(Walk, n_envs=3, vec_env_cls=each)
        try:
            model = small(env, transfer=METHODS["COMBREL"](), seed=5).learn(61, callback=recorder)
        finally:
            env.close()
        runs.append(stored(model))
    np.testing.assert_array_equal(*runs)
    assert model.num_timesteps == 63 and model.agent.model.n_instances == 63
    assert recorder.shown[0]["new_obs"].shape == (3, 2)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_true_last_observation_is_stored_and_a_time_limit_is_not_terminal(n_envs):
    model = small(DummyVecEnv([lambda: Walk(limit=7)] * n_envs)).learn(300)
    rows = stored(model)
    # Every step moves by 0.15 or stays at the left end; the reset states that follow an episode are farther away.
    assert ((np.abs(np.abs(rows[:, 2] - rows[:, 0]) - 0.15) < 1e-6) | (np.abs(np.abs(rows[:, 2]) - 1.0) < 1e-6)).all()
    np.testing.assert_array_equal(rows[:, 5] > 0, rows[:, 2] > 0.9 - 1e-6)
    assert rows[:, 5].any(), "some episodes reached the goal"
    assert model._episode_num > rows[:, 5].sum(), "and some ran into the limit"


def test_normalized_observations_are_refused_by_constructor_set_env_and_load(tmp_path):
    normalized = VecNormalize(DummyVecEnv([Walk]))
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=False\)"):
        small(normalized)
    model = small()
    with pytest.raises(ValueError, match="norm_obs"):
        model.set_env(normalized)
    assert model.get_env() is not normalized, "refused before anything was changed"
    model.learn(5)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="norm_obs"):
        FittedRMax.load(tmp_path / "model", env=normalized)


def test_observations_normalized_by_running_means_are_refused_in_an_environment_as_well():
    normalized = gym.wrappers.NormalizeObservation(Walk())
    with pytest.raises(ValueError, match="no NormalizeObservation"):
        small(normalized)
    model = small()
    with pytest.raises(ValueError, match="no NormalizeObservation"):
        model.set_env(normalized)
    normalized.update_running_mean = False
    small(normalized)


def test_rewards_normalized_by_running_means_are_refused_where_they_cannot_be_undone():
    normalized = gym.wrappers.NormalizeReward(Walk())
    with pytest.raises(ValueError, match="no NormalizeReward"):
        small(normalized)
    normalized.update_running_mean = False
    small(normalized)


def test_of_normalized_rewards_the_original_ones_are_stored(tmp_path):
    env = VecNormalize(VecMonitor(DummyVecEnv([Walk])), norm_obs=False, norm_reward=True)
    recorder = Recorder()
    model = small(env).learn(50, callback=recorder)
    assert (stored(model)[:, 4] == -1.0).all()
    assert any(shown["rewards"][0] != -1.0 for shown in recorder.shown), "the environment did normalize"
    model.save(tmp_path / "model")
    goes_on = FittedRMax.load(tmp_path / "model", env=VecNormalize(DummyVecEnv([Walk]), norm_obs=False)).learn(20)
    assert (stored(goes_on)[:, 4] == -1.0).all()
    model = small()
    model.set_env(VecNormalize(DummyVecEnv([Walk]), norm_obs=False))
    assert (stored(model.learn(50))[:, 4] == -1.0).all()


def test_set_env_goes_on_with_what_was_learned():
    model, other = small().learn(20), DummyVecEnv([Walk])
    model.set_env(other)
    assert model.get_env() is other
    model.learn(10)
    assert model.agent.model.n_instances == 30
    with pytest.raises(AssertionError):
        model.set_env(DummyVecEnv([Walk, Walk]))


# Grids that take long are announced before the work begins.
class Still(gym.Env):
    """Nothing happens, in so many state variables."""

    def __init__(self, d, n_actions):
        self.observation_space = gym.spaces.Box(0.0, 1.0, (d,))
        self.action_space = gym.spaces.Discrete(n_actions)

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
