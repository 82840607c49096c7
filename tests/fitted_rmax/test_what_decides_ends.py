"""Ends that the action decides, and not where it leads, are noticed and learned; others are learned by where one arrives."""

import gymnasium as gym
import numpy as np
import pytest
from helpers.walk import Walk
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax
from sb3_combrel.models.ends_by_action import evidence_for_action


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


class Stopping(gym.Env):
    """A value falls at the left and rises at the right, slowly; an episode ends, and pays it, when one stops."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.n = self.np_random.uniform(), 0
        return np.float32([self.at]), {}

    def step(self, action):
        paid = self.at if action else 0.0
        self.at, self.n = float(np.clip(self.at + (0.05 if self.at > 0.4 else -0.05), 0.0, 1.0)), self.n + 1
        return np.float32([self.at]), paid, bool(action), self.n >= 50, {}


class Zeros(Walk):
    """The walk, whose last observation is none."""

    def step(self, action):
        state, reward, terminated, truncated, info = super().step(action)
        return (np.full_like(state, -1.0) if terminated else state), reward, terminated, truncated, info


BANDIT = Choice(3, lambda x, a: a, first=lambda rng: 0.5)
CONTEXT = Choice(2, lambda x, a: x if a else 1.0 - x)


def learned(env, steps):
    """A model, and the mean return of its policy."""
    model = FittedRMax(env, seed=0).learn(steps)
    return model, evaluate_policy(model, Monitor(env), n_eval_episodes=50)[0]


def by_action(model):
    return model.agent.model_settings.ends_by_action


@pytest.mark.parametrize(
    ("env", "steps", "least"),
    [(BANDIT, 100, 2.0), (CONTEXT, 300, 0.7), (Stopping(), 600, 0.65), (Zeros(), 600, -9.0)],
    ids=["bandit", "context", "stopping", "zeros"],
)
def test_ends_that_the_action_decides_are_noticed_and_learned(env, steps, least, tmp_path):
    model, mean_return = learned(env, steps)
    assert by_action(model) and mean_return >= least
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=env)
    assert by_action(loaded)
    for state in np.random.default_rng(0).random((10, model.agent.task.n_variables)):
        np.testing.assert_array_equal(loaded.agent.q_values(state), model.agent.q_values(state))


@pytest.mark.parametrize(
    ("env", "steps"), [(Walk(), 500), ("MountainCar-v0", 1500), ("CartPole-v1", 1000)], ids=["walk", "car", "pole"]
)
def test_ends_are_learned_by_where_one_arrives_where_that_decides(env, steps):
    model = FittedRMax(env, seed=0).learn(steps)
    assert model.agent.rewards.n_ended > 0 and not by_action(model)


def test_in_two_calls_it_learns_what_it_does_in_one():
    one = FittedRMax(CONTEXT, seed=0).learn(200)
    two = FittedRMax(CONTEXT, seed=0).learn(30).learn(170, reset_num_timesteps=False)
    assert by_action(one) and by_action(two)
    for state in np.linspace(0.0, 1.0, 11)[:, None]:
        np.testing.assert_array_equal(one.agent.q_values(state), two.agent.q_values(state))


def test_what_past_data_show_of_ends_is_noticed_before_the_first_step():
    past = FittedRMax(BANDIT, seed=0).learn(100)
    model = FittedRMax(BANDIT, seed=0, instances=past)
    assert by_action(model) and evaluate_policy(model, Monitor(BANDIT), n_eval_episodes=5)[0] == 2.0


def test_an_interrupt_while_all_is_computed_anew_leaves_all_as_it_was(monkeypatch):
    model = FittedRMax(BANDIT, seed=0).learn(10)
    agent, due = model.agent, model.agent._ends_due
    monkeypatch.setattr(agent, "_build", lambda **_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        agent.rescale(agent.task.scaling, agent.task.bounds, ends_by_action=True)
    assert not by_action(model) and agent._ends_due == due


def evidence_in_loops(transitions):
    """The same from its definition."""
    rewards = [reward for _, _, reward, _, _ in transitions]
    better = []
    for i, (state, action, reward, _, ended) in enumerate(transitions):
        same = [j for j, other in enumerate(transitions) if j != i and other[1] == action]
        if not same:
            continue
        expected = state
        going_on = [j for j in same if not transitions[j][4]]
        if going_on:
            s, _, _, n, _ = transitions[min(going_on, key=lambda j: np.linalg.norm(transitions[j][0] - state))]
            expected = state + n - s
        others = [j for j in range(len(transitions)) if j != i]

        def arrival(j):
            return transitions[j][3]

        errors = []
        for j in (
            min(same, key=lambda j: np.linalg.norm(transitions[j][0] - state)),
            min(others, key=lambda j: np.linalg.norm(arrival(j) - expected)),
        ):
            other = transitions[j]
            both = min(1.0, abs(reward - other[2]) / max(np.ptp(rewards), 1e-300))
            errors.append(both if ended and other[4] else float(ended != other[4]))
        better.append(errors[1] - errors[0])
    better = np.array(better)
    return better.sum() / np.sqrt((better**2).sum()) if better.any() else 0.0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(2, 60), st.floats(0.0, 1.0))
def test_the_evidence_is_that_of_its_definition(seed, n_actions, n, share):
    rng = np.random.default_rng(seed)
    transitions = [
        (rng.random(2), int(rng.integers(n_actions)), float(rng.normal()), rng.random(2), bool(rng.random() < share))
        for _ in range(n)
    ]
    np.testing.assert_allclose(evidence_for_action(transitions), evidence_in_loops(transitions), atol=1e-9)


def test_it_is_noticed_although_few_instances_are_kept():
    model = FittedRMax(CONTEXT, seed=0, max_instances=20).learn(400)
    assert model.agent.model.n_instances == 40 and by_action(model)
