"""Environments that return what no source instance can have: errors name what was returned and when."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_combrel import SourceInstances
from sb3_combrel.sources.q_learning import QLearning
from sb3_combrel.sources.source_recorder import SourceRecorder

NAN, INF = float("nan"), float("inf")


class Faulty(gym.Env):
    """A random walk on the unit square that, from its ``good_steps`` on, returns something wrong."""

    observation_space = spaces.Box(0.0, 1.0, (2,), np.float64)
    action_space = spaces.Discrete(2)

    def __init__(self, good_steps, observation=None, reward=-1.0):
        self.good_steps = good_steps
        self.observation = observation
        self.reward = reward
        self.n_steps = 0

    def _observe(self):
        if self.n_steps >= self.good_steps and self.observation is not None:
            return np.array([0.5, self.observation])
        return self.np_random.random(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        self.n_steps += 1
        return self._observe(), self.reward if self.n_steps >= self.good_steps else -1.0, False, False, {}


def record(env):
    return SourceInstances.record(None, env, 20, seed=0)


def from_q_learning(env):
    return SourceInstances.from_q_learning(env, 10, seed=0, total_timesteps=20)


def from_fitted_rmax(env):
    limited = gym.wrappers.TimeLimit(env, 10)
    return SourceInstances.from_fitted_rmax(limited, 10, seed=0, n_episodes=2, max_value=0.0, resolution=2, model_breadth=0.2)


def learn_by_q_learning(env):
    return QLearning(env, seed=0).learn(20)


LEARNERS = [record, from_q_learning, from_fitted_rmax, learn_by_q_learning]


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("good_steps", [0, 1, 4])
@pytest.mark.parametrize("observation", [NAN, INF, -INF])
def test_an_observation_that_is_not_finite_is_named(learner, good_steps, observation):
    with pytest.raises(ValueError, match=rf"the environment returned an observation that is not finite.*{observation}"):
        learner(Faulty(good_steps, observation=observation))


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("reward", [NAN, INF, -INF])
def test_a_reward_that_is_not_finite_is_named(learner, reward):
    with pytest.raises(ValueError, match=rf"the environment returned a reward that is not .*finite.*{reward}"):
        learner(Faulty(3, reward=reward))


@pytest.mark.parametrize("reward", [None, "much", [1.0, 2.0]])
def test_q_learning_names_a_reward_that_is_no_number(reward):
    with pytest.raises(
        ValueError, match=r"the environment returned a reward that is not a finite number, in step 3 of episode 1"
    ):
        learn_by_q_learning(Faulty(3, reward=reward))


def test_q_learning_names_rewards_that_its_values_cannot_represent():
    with (
        np.errstate(over="ignore"),
        pytest.raises(ValueError, match=r"the Q-values overflow in step .*, at the reward -1e\+308"),
    ):
        QLearning(Faulty(0, reward=-1e308), learning_rate=1.0, seed=0).learn(2000)


def test_the_recorder_names_a_reward_that_is_not_finite():
    with pytest.raises(
        ValueError, match=r"the environment returned a reward that is not a finite number, in transition 4: .*inf"
    ):
        PPO("MlpPolicy", Faulty(5, reward=INF), n_steps=8, n_epochs=1, batch_size=8, seed=0).learn(
            8, callback=SourceRecorder()
        )
