"""Vectorised environments, VecNormalize, Monitor, set_env."""

import numpy as np
import pytest
from helpers.walk import METHODS, Recorder, Walk, small, stored
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_combrel import FittedRMax


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
    assert model.num_timesteps == 63
    assert model.agent.model.n_instances == 63
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


def test_monitors_episodes_are_those_of_the_model(tmp_path):
    model = small(Monitor(Walk(), str(tmp_path / "monitor"))).learn(100)
    lengths = [int(line.split(",")[1]) for line in (tmp_path / "monitor.monitor.csv").read_text().splitlines()[2:]]
    assert sum(lengths) <= 100 < sum(lengths) + 30
    assert [info["l"] for info in model.ep_info_buffer] == lengths and len(lengths) == model._episode_num


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


def test_get_vec_normalize_env_returns_the_normalizing_environment(tmp_path):
    env = VecNormalize(DummyVecEnv([Walk]), norm_obs=False)
    model = small(env).learn(10)
    assert model.get_vec_normalize_env() is env
    model.save(tmp_path / "model")
    assert FittedRMax.load(tmp_path / "model").get_vec_normalize_env() is None
    assert FittedRMax.load(tmp_path / "model", env=env).get_vec_normalize_env() is env
    model.set_env(DummyVecEnv([Walk]))
    assert model.get_vec_normalize_env() is None


def test_set_env_goes_on_with_what_was_learned():
    model = small().learn(20)
    other = DummyVecEnv([Walk])
    model.set_env(other)
    assert model.get_env() is other
    model.learn(10)
    assert model.agent.model.n_instances == 30
    with pytest.raises(AssertionError):
        model.set_env(DummyVecEnv([Walk, Walk]))
