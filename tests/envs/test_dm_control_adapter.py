"""The adapter for dm_control environments."""

import importlib

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from helpers.environments import CAR_4D, replay
from stable_baselines3.common.env_checker import check_env

import combrel_envs
from combrel_envs.gym_env import DmControlEnv

LOW, HIGH = np.array([-1.2, -1.2, -0.07, -0.07]), np.array([0.6, 0.6, 0.07, 0.07])
# In 2D: less than one step before the goal.
NEARLY = (0.45,), (0.06,)


def adapted(task="climb_4d", low=LOW, high=HIGH, task_kwargs=None, **kwargs):
    return DmControlEnv(combrel_envs.load("mountain_car", task, task_kwargs), low, high, **kwargs)


@pytest.mark.filterwarnings("error")
def test_it_gives_the_same_episodes_as_the_fast_environment():
    env, actions = adapted(task_kwargs={"start": "fixed"}), np.random.default_rng(0).integers(5, size=300)
    ours = [(env.reset(seed=0)[0],)] + [env.step(action) for action in actions]
    theirs = replay(CAR_4D, actions, start="fixed")
    assert [step[0].tolist() for step in ours] == [step[0].tolist() for step in theirs]
    assert [step[1:] for step in ours[1:]] == [step[1:] for step in theirs[1:]]
    check_env(adapted())
    unbounded = adapted(low=None, high=None).observation_space
    assert unbounded.shape == (4,) and np.all(np.isinf(unbounded.low))


def test_a_seed_determines_the_starts():
    env, other = adapted(), adapted()
    first = [env.reset(seed=5)[0], env.reset()[0]]
    assert np.array_equal(first, [other.reset(seed=5)[0], other.reset()[0]]) and not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], env.reset(seed=6)[0])


@pytest.mark.parametrize(("state", "end"), [(NEARLY, (True, False)), (((-0.5,), (0.0,)), (False, True))])
def test_the_last_step_of_the_time_limit_truncates_unless_the_task_ends_on_it(state, end):
    env = adapted("climb_2d", LOW[::2], HIGH[::2], {"time_limit": 1})
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    with env.environment.physics.reset_context():
        env.environment.physics.set_car(*state)
    _, _, terminated, truncated, info = env.step(2)
    assert (terminated, truncated) == end and info["is_success"] == terminated
    with pytest.raises(ResetNeeded):
        env.step(0)


def test_unknown_reset_options_and_continuous_actions_are_errors():
    with pytest.raises(ValueError, match="options of reset must be empty"):
        adapted().reset(options={"start": "fixed"})
    with pytest.raises(ValueError, match="discrete actions"):
        DmControlEnv(importlib.import_module("dm_control.suite").load("cartpole", "balance"))
