"""Ends that are not told by where one arrives are noticed, and others give no warning."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from helpers.walk import Walk
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.ends_check import ENOUGH, mean_errors


class Choice(gym.Env):
    """One step, from one of many places; ``pays`` says what an action is worth there."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,))

    def __init__(self, n_actions, pays, first=lambda rng: rng.uniform()):
        self.action_space, self.pays, self.first = gym.spaces.Discrete(n_actions), pays, first

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.float32([self.first(self.np_random)])
        return self.at, {}

    def step(self, action):
        return self.at, float(self.pays(self.at[0], action)), True, False, {}


class Selling(gym.Env):
    """A price goes up and down; selling ends the episode."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.price, self.n = 0.5, 0
        return np.float32([self.price]), {}

    def step(self, action):
        self.price = float(np.clip(self.price + self.np_random.normal(0.0, 0.05), 0.0, 1.0))
        self.n += 1
        return np.float32([self.price]), self.price if action else 0.0, bool(action), self.n >= 50, {}


class Zeros(Walk):
    """The walk, whose last observation is none."""

    def step(self, action):
        state, reward, terminated, truncated, info = super().step(action)
        return (np.full_like(state, -1.0) if terminated else state), reward, terminated, truncated, info


BANDIT = Choice(3, lambda x, a: a, first=lambda rng: 0.5)
CONTEXT = Choice(2, lambda x, a: x if a else 1.0 - x)


def warnings_of(env, steps, **arguments):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = FittedRMax(env, seed=0, **arguments).learn(steps)
    return model, [str(each.message) for each in caught if "degree=0" in str(each.message)]


@pytest.mark.parametrize("env", [BANDIT, CONTEXT, Selling()], ids=["bandit", "context", "selling"])
def test_ends_that_the_action_decides_are_noticed_and_the_remedy_helps(env):
    _, messages = warnings_of(env, 300)
    assert len(messages) == 1 and messages[0].startswith("which action is taken decides how episodes end")
    model, messages = warnings_of(env, 300, degree=0)
    assert not messages
    if env in (BANDIT, CONTEXT):
        assert evaluate_policy(model, Monitor(env), n_eval_episodes=50)[0] >= (2.0 if env is BANDIT else 0.65)


def test_last_observations_that_are_none_are_noticed():
    _, messages = warnings_of(Zeros(), 600, degree=1)
    assert any(message.startswith("last steps of episodes are longer than all others") for message in messages)


@pytest.mark.parametrize(
    ("env", "steps"), [(Walk(), 500), ("MountainCar-v0", 1500), ("CartPole-v1", 1000)], ids=["walk", "car", "pole"]
)
def test_ends_by_where_one_arrives_give_no_warning(env, steps):
    model, messages = warnings_of(env, steps, degree=1)
    assert model.agent.rewards.n_ended > 0 and not messages
    assert not warnings_of(env, 60, degree=1)[1]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 3))
def test_errors_are_those_of_the_nearest_arrivals(seed, n_actions):
    rng = np.random.default_rng(seed)
    n = 120
    action, reward, after = rng.integers(0, n_actions, n), rng.normal(size=n), rng.random((n, 2))
    terminated = rng.random(n) < 0.5
    own, other = [], []
    for i in np.flatnonzero(terminated):
        apart = np.linalg.norm(after - after[i], axis=1)
        apart[i] = np.inf
        same, others = np.where(action == action[i], apart, np.inf), np.where(action != action[i], apart, np.inf)
        if others.min() <= same.min() < np.inf:
            for errors, near in ((own, same.argmin()), (other, others.argmin())):
                wrong = min(1.0, abs(reward[i] - reward[near]) / np.ptp(reward))
                errors.append(wrong if terminated[near] else 1.0)
    wanted = (np.mean(own), np.mean(other)) if len(own) >= ENOUGH else (0.0, 0.0)
    np.testing.assert_allclose(mean_errors(action, reward, after, terminated), wanted, atol=1e-12)
