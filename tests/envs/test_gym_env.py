"""The adapter for dm_control environments, on the tasks at hand."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import combrel_envs
from combrel_envs.gym_env import DmControlEnv, register_envs

LOW, HIGH = np.array([-1.2, -1.2, -0.07, -0.07]), np.array([0.6, 0.6, 0.07, 0.07])
# In 2D: less than one step before the goal.
NEARLY = (0.45,), (0.06,)


def adapted(task="climb_4d", low=LOW, high=HIGH, task_kwargs=None, **kwargs):
    return DmControlEnv(combrel_envs.load("mountain_car", task, task_kwargs), low, high, **kwargs)


def put(env, state):
    physics = env.environment.physics
    with physics.reset_context():
        physics.set_car(*state)


def test_the_adapter_gives_the_same_episodes_as_the_fast_environment():
    env = adapted(task_kwargs={"start": "fixed"})
    fast = gymnasium.make("combrel/MountainCar4D-v0", start="fixed")
    np.testing.assert_array_equal(env.reset(seed=0)[0], fast.reset(seed=0)[0])
    assert env.observation_space == fast.observation_space
    assert env.action_space == fast.action_space
    for action in np.random.default_rng(0).integers(5, size=300):
        ours, theirs = env.step(action), fast.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]


def test_sb3s_checker_finds_no_fault_in_an_adapted_environment():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3_env(adapted())


def test_observation_bounds_default_to_those_of_the_spec():
    env = adapted(low=None, high=None)
    assert env.observation_space.shape == (4,)
    assert np.all(np.isinf(env.observation_space.low))


def test_a_seed_determines_the_starts_of_an_adapted_environment():
    env, other = adapted(), adapted()
    first = [env.reset(seed=5)[0], env.reset()[0]]
    assert np.array_equal(first, [other.reset(seed=5)[0], other.reset()[0]])
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], env.reset(seed=6)[0])


@pytest.mark.parametrize(("state", "end"), [(NEARLY, (True, False)), (((-0.5,), (0.0,)), (False, True))])
def test_the_last_step_of_the_time_limit_truncates_unless_the_task_ends_on_it(state, end):
    env = adapted("climb_2d", LOW[::2], HIGH[::2], {"time_limit": 1})
    env.reset(seed=0)
    put(env, state)
    _, _, terminated, truncated, info = env.step(2)
    assert (terminated, truncated) == end
    assert info["is_success"] == terminated


def test_steps_outside_an_episode_are_errors():
    env = adapted("climb_2d", LOW[::2], HIGH[::2], {"time_limit": 1})
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(ResetNeeded):
        env.step(0)


def test_unknown_reset_options_are_errors():
    with pytest.raises(ValueError, match="options of reset must be empty"):
        adapted().reset(options={"start": "fixed"})


def test_continuous_actions_are_errors():
    from dm_control import suite

    with pytest.raises(ValueError, match="discrete actions"):
        DmControlEnv(suite.load("cartpole", "balance"))


@pytest.mark.integration
def test_an_adapted_environment_draws_and_can_be_closed_twice():
    env = adapted(render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    assert env.render().shape == (48, 64, 3)
    env.close()
    env.close()


def test_registering_the_environments_again_changes_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_envs()
