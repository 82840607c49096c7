"""Mountain Car as a Gymnasium environment: episodes, starts, seeds, spaces and conventions."""

import math
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from helpers.mountain_cars import BOTTOM, ID_2D, ID_4D, IDS, PLAN_2D, actions_of, env_in, possible_states
from hypothesis import given
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from combrel_envs import mountain_car_dynamics as dynamics


class TestEpisodes:
    @pytest.mark.parametrize("env_id", IDS)
    def test_4000_steps_truncate_and_dont_terminate(self, env_id):
        env = gymnasium.make(env_id)
        assert env.spec.max_episode_steps == 4000
        env.reset(seed=0)
        ends = [env.step(0)[2:4] for _ in range(4000)]
        assert ends == [(False, False)] * 3999 + [(False, True)]

    def test_make_can_set_another_step_limit(self):
        env = gymnasium.make(ID_4D, max_episode_steps=7)
        env.reset(seed=0)
        assert env.spec.max_episode_steps == 7
        assert [env.step(0)[3] for _ in range(7)] == [False] * 6 + [True]

    def test_reaching_the_goal_on_the_last_step_terminates(self):
        env = gymnasium.make(ID_2D, start="fixed", max_episode_steps=103)
        env.reset()
        assert [env.step(action)[2] for action in actions_of(PLAN_2D, env)][-1]

    @pytest.mark.parametrize("env_id", IDS)
    def test_stepping_before_the_first_reset_is_an_error(self, env_id):
        with pytest.raises(ResetNeeded):
            gymnasium.make(env_id).unwrapped.step(0)

    @pytest.mark.parametrize("action", [-1, 5, 1.0, "East", None, np.array([1])])
    def test_impossible_actions_are_errors(self, action):
        env = gymnasium.make(ID_4D)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action must be an integer from 0 to 4"):
            env.step(action)

    def test_all_kinds_of_integers_are_actions(self):
        for action in (2, np.int64(2), np.array(2), np.uint8(2)):
            env = env_in(ID_4D, [-0.5, -0.5, 0.0, 0.0])
            env.step(action)
            assert env.unwrapped.state[2] > env.unwrapped.state[3]


class TestStarts:
    @pytest.mark.parametrize("env_id", IDS)
    def test_a_fixed_start_is_at_the_bottom(self, env_id):
        env = gymnasium.make(env_id, start="fixed")
        env.reset(seed=3)
        positions, velocities = np.split(env.unwrapped.state, 2)
        assert np.all(positions == BOTTOM) and np.all(velocities == 0)

    @pytest.mark.parametrize("env_id", IDS)
    def test_an_offset_start_is_the_default_and_the_same_on_every_axis(self, env_id):
        env = gymnasium.make(env_id)
        env.reset(seed=0)
        offsets = []
        for _ in range(200):
            env.reset()
            positions, velocities = np.split(env.unwrapped.state, 2)
            assert np.all(positions == positions[0]) and np.all(velocities == 0)
            offsets.append(positions[0] - BOTTOM)
        assert -0.005 <= min(offsets) < -0.004 and 0.004 < max(offsets) <= 0.005

    @pytest.mark.parametrize("env_id", IDS)
    def test_random_starts_cover_the_space_but_the_goal(self, env_id):
        env = gymnasium.make(env_id, start="random")
        env.reset(seed=0)
        starts = []
        for _ in range(1500):
            env.reset()
            starts.append(env.unwrapped.state)
        starts = np.array(starts)
        low, high = env.observation_space.low, env.observation_space.high
        assert np.all(starts.min(axis=0) < low + 0.02 * (high - low))
        if env_id != ID_2D:
            assert np.all(starts.max(axis=0) > high - 0.02 * (high - low))
        assert not np.any(np.all(starts[:, : starts.shape[1] // 2] >= 0.5, axis=1))

    @pytest.mark.parametrize("env_id", IDS)
    @pytest.mark.parametrize("start", ["offset", "random"])
    def test_a_seed_decides_the_starts(self, env_id, start):
        env, other = gymnasium.make(env_id, start=start), gymnasium.make(env_id, start=start)
        first = [env.reset(seed=7)[0], env.reset()[0]]
        again = [other.reset(seed=7)[0], other.reset()[0]]
        assert np.array_equal(first, again)
        assert not np.array_equal(first[0], first[1])
        assert not np.array_equal(first[0], env.reset(seed=8)[0])

    def test_reset_options_override_the_start_for_one_episode(self):
        env = gymnasium.make(ID_4D, start="fixed")
        env.reset(seed=0, options={"start": "random"})
        assert env.unwrapped.state[2] != 0
        env.reset()
        assert env.unwrapped.state.tolist() == [BOTTOM, BOTTOM, 0, 0]

    @given(state=possible_states(2))
    def test_any_observation_can_be_given_back_as_a_state(self, state):
        env = gymnasium.make(ID_4D)
        observation, _ = env.reset(options={"state": np.float32(state)})
        np.testing.assert_array_equal(observation, np.float32(state))
        assert np.all(np.abs(env.unwrapped.state) <= [1.2, 1.2, 0.07, 0.07])

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"start": "top"}, "start must be one of 'offset', 'fixed', 'random', got 'top'"),
            ({"state": [0.0, 0.0]}, r"4 entries \(x, y, vx, vy\)"),
            ({"state": [0.0, 0.0, 0.0, 0.1]}, "must lie between"),
            ({"state": [0.0, math.nan, 0.0, 0.0]}, "must lie between"),
            ({"state": "here"}, "must be numbers"),
            ({"begin": "fixed"}, "'start' or 'state'"),
            ({"state": [0.0, 0.0, 0.0, 0.0], "start": "fixed"}, "'start' or 'state'"),
        ],
    )
    def test_wrong_reset_options_are_errors(self, options, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(ID_4D).reset(options=options)

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"start": "top"}, "start must be one of"),
            ({"width": 0}, "width must be"),
            ({"camera": "front"}, "camera must be one of 'perspective', 'top', 'close', got 'front'"),
        ],
    )
    def test_wrong_arguments_are_errors(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(ID_4D, **kwargs)


class TestConventions:
    @pytest.mark.integration
    @pytest.mark.parametrize("env_id", IDS)
    def test_gymnasiums_checker_finds_no_fault(self, env_id):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_gymnasium_env(gymnasium.make(env_id, render_mode="rgb_array", width=64, height=48).unwrapped)

    @pytest.mark.parametrize("env_id", IDS)
    @pytest.mark.parametrize("start", dynamics.STARTS)
    def test_sb3s_checker_finds_no_fault(self, env_id, start):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_sb3_env(gymnasium.make(env_id, start=start))

    def test_the_spaces_have_the_true_bounds(self):
        env = gymnasium.make(ID_4D)
        np.testing.assert_array_equal(env.observation_space.high, np.float32([0.6, 0.6, 0.07, 0.07]))
        np.testing.assert_array_equal(env.observation_space.low, np.float32([-1.2, -1.2, -0.07, -0.07]))
        assert env.action_space == gymnasium.spaces.Discrete(5)
        assert env.observation_space.dtype == np.float32

    @pytest.mark.parametrize("env_id", IDS)
    def test_the_names_fit_the_spaces(self, env_id):
        env = gymnasium.make(env_id).unwrapped
        assert len(env.state_names) == env.observation_space.shape[0]
        assert len(env.action_names) == env.action_space.n

    @pytest.mark.integration
    def test_stepping_without_pictures_imports_neither_mujoco_nor_dm_control(self):
        code = (
            "import sys, gymnasium, combrel_envs; env = gymnasium.make('combrel/MountainCar4D-v0'); env.reset(); env.step(0);"
            "sys.exit(any(name in sys.modules for name in ('mujoco', 'dm_control', 'PIL')))"
        )
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
