"""What learners and recorders of source tasks refuse: environments that return nonsense, numbers that are no counts."""

import dataclasses
import re

import gymnasium as gym
import numpy as np
import pytest
from helpers.walk import Walk, walk_source

from sb3_combrel import COMBREL, SourceInstances
from sb3_combrel.sources.q_learning import QLearning
from sb3_combrel.sources.source_recorder import SourceRecorder

NAN, INF = float("nan"), float("inf")
TASK = "MountainCar-v0"
NO_COUNTS = [INF, NAN, 2.5, 1e308, 10**30, 0, -1, True, "3"]


class Faulty(gym.Env):
    """A random walk on the unit square that, from its ``good_steps`` on, returns something wrong."""

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), np.float64)
    action_space = gym.spaces.Discrete(2)

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


def learn_by_q_learning(env):
    return QLearning(env, seed=0).learn(20)


@pytest.mark.parametrize("learner", [record, learn_by_q_learning])
@pytest.mark.parametrize(("good_steps", "observation"), [(0, NAN), (1, INF), (4, -INF)])
def test_an_observation_that_is_not_finite_is_named(learner, good_steps, observation):
    with pytest.raises(ValueError, match=rf"the environment returned an observation that is not finite.*{observation}"):
        learner(Faulty(good_steps, observation=observation))


@pytest.mark.parametrize("reward", [[1.0, 2.0], INF, NAN])
def test_a_reward_that_is_no_number_is_named(reward):
    says = "the environment returned a reward that is not a finite number, in"
    with pytest.raises(ValueError, match=f"{says} step 3 of episode 1"):
        learn_by_q_learning(Faulty(3, reward=reward))
    # Vectorised environments keep rewards in an array of numbers.
    with pytest.raises(ValueError, match=f"{says} transition 2" if isinstance(reward, float) else None):
        record(Faulty(3, reward=reward))


@pytest.mark.parametrize("learner", [record, learn_by_q_learning])
def test_a_reward_that_is_text_is_named(learner):
    with pytest.raises(ValueError, match="step must return reward as a number, not as text, got 'much'"):
        learner(Faulty(3, reward="much"))


def test_q_learning_names_rewards_that_its_values_cannot_represent():
    expected = pytest.raises(ValueError, match=r"the Q-values overflow in step .*, at the reward -1e\+308")
    with np.errstate(over="ignore"), expected:
        QLearning(Faulty(0, reward=-1e308), learning_rate=1.0, seed=0).learn(2000)


@pytest.mark.parametrize("number", NO_COUNTS)
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("n_instances", lambda n: SourceInstances.record(None, TASK, n)),
        ("n_instances", lambda n: SourceInstances.from_q_learning(TASK, n)),
        ("total_timesteps", lambda n: SourceInstances.from_q_learning(TASK, 1, total_timesteps=n)),
        ("total_timesteps", lambda n: QLearning(TASK).learn(n)),
        ("n_instances", lambda n: SourceInstances.from_fitted_rmax(TASK, n, max_value=0.0)),
        ("n_episodes", lambda n: SourceInstances.from_fitted_rmax(TASK, 1, n_episodes=n, max_value=0.0)),
    ],
    ids=["record", "Q-learning", "Q-learning steps", "learn", "Fitted R-Max", "Fitted R-Max episodes"],
)
def test_learning_refuses_what_is_no_count(name, call, number):
    with pytest.raises(ValueError, match=rf"{name} must be a whole number from 1 to 1?[\d,]+.*, got "):
        call(number)


@pytest.mark.parametrize("number", [each for each in NO_COUNTS if each not in (1e308, 10**30)])
def test_subsets_and_recorders_refuse_what_is_no_count(number):
    some = SourceInstances.record(None, TASK, 8, seed=0)
    with pytest.raises(ValueError, match="n_instances must be a whole number of at least 1, got"):
        some.subset(number)
    with pytest.raises(ValueError, match="max_instances must be a whole number of at least 1, got"):
        SourceRecorder(number)


def test_whole_floats_are_counts():
    some = SourceInstances.record(None, TASK, 8.0, seed=0)
    assert (len(some), len(some.subset(3.0)), len(some.subset(10**30))) == (8, 3, 8)
    with pytest.raises(ValueError, match=r"n_instances must be a whole number from 1 to 10 \(total_timesteps\), got 11"):
        SourceInstances.from_q_learning(TASK, 11, total_timesteps=10)
    learned = SourceInstances.from_q_learning(TASK, 5.0, seed=0, total_timesteps=1e2)
    assert learned.origin["total_timesteps"] == 100
    np.testing.assert_array_equal(learned.states, SourceInstances.from_q_learning(TASK, 5, 0, total_timesteps=100).states)


class Endless(Walk):
    """The walk, whose end is a wall."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, False, truncated, info


def test_a_source_task_without_an_end_is_refused_and_one_with_few_steps_is_told(monkeypatch):
    monkeypatch.setattr("sb3_combrel.fitted_rmax.source_learner.LONGEST_EPISODE", 50)
    with pytest.raises(ValueError, match=r"none has ended for 50 steps: wrap it in gymnasium\.wrappers\.TimeLimit"):
        SourceInstances.from_fitted_rmax(Endless(limit=10**9), n_episodes=2, seed=0)
    with pytest.warns(UserWarning, match=r"2 episodes had \d+ steps, fewer than n_instances=500"):
        found = SourceInstances.from_fitted_rmax(Walk(), 500, n_episodes=2, seed=0)
    assert 2 <= len(found) <= 60


def test_a_method_of_choice_that_does_not_exist_is_refused_before_learning():
    for learn in (SourceInstances.from_q_learning, SourceInstances.from_fitted_rmax):
        with pytest.raises(ValueError, match="method must be 'random' or 'covering', got 'best'"):
            learn("no such task", 5, method="best")


@pytest.mark.parametrize("folder", [".", "..", "/", "inner"])
def test_a_folder_is_no_file_of_instances(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inner").mkdir()
    for read in (SourceInstances.load, SourceInstances.from_table, COMBREL):
        with pytest.raises(ValueError, match=f"must be .* file.* got the folder {re.escape(folder)}$"):
            read(folder)
    # A file of that name beside it is found.
    made = SourceInstances.record(None, TASK, 20, seed=0)
    made.save("inner")
    assert len(SourceInstances.load("inner")) == 20
    with pytest.raises(ValueError, match="path must be that of a file"):
        made.save(".")


@pytest.mark.parametrize("names", [None, iter(["left", "right"]), 7])
def test_names_that_are_no_sequence_are_refused_by_name(names):
    with pytest.raises(ValueError, match="action_names must hold"):
        dataclasses.replace(walk_source(), action_names=names)


def test_masked_states_are_refused():
    given = walk_source()
    masked = np.ma.masked_array(given.states, np.zeros(given.states.shape, dtype=np.bool_))
    dataclasses.replace(given, states=masked)
    masked[3, 0] = np.ma.masked
    with pytest.raises(ValueError, match="states must be numbers"):
        dataclasses.replace(given, states=masked)
