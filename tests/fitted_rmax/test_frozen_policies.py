"""By what values a frozen policy acts: no promise that nobody has seen kept, where caution has a grid to be cautious on."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.own_method import Mine
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax
from sb3_combrel.planning.q_values import ValueFunction

LEFT, RIGHT = 0, 1
HERE = np.array([0.45])


def line_agent(transfer=None, is_bounded=True, acted=True, is_coarse=False, **settings):
    """Steps of 0.05 cost 1, and an end beyond 0.9; nobody has been below 0.35, where all is worth 0 until somebody has."""
    agent = make_agent(1, 2, transfer, max_value=0.0, gamma=1.0, resolution=5, **settings)
    agent.task, agent.is_coarse = replace(agent.task, is_bounded=is_bounded), is_coarse
    rng = np.random.default_rng(0)
    states = [np.array([at]) for at in rng.uniform(0.4, 0.95, 200)]
    actions = rng.integers(2, size=200).tolist()
    effects = [0.05 if action == RIGHT else -0.05 for action in actions]
    after = [state + effect for state, effect in zip(states, effects, strict=True)]
    transitions = [(s, a, -1.0, n, bool(n > 0.9)) for s, a, n in zip(states, actions, after, strict=True)]
    if acted:
        for transition in transitions:
            agent.update(*transition)
    else:
        agent.take_in(transitions)
    agent.end_episode(truncated=False)
    return agent


def frozen(agent, states=(HERE,)):
    return [agent.act(state, explore=False) for state in states]


@pytest.mark.parametrize("acted", [False, True])
def test_a_frozen_policy_does_not_go_for_what_nobody_has_seen(acted):
    agent = line_agent(acted=acted)
    assert agent.act(HERE) == LEFT, "learning does, the unknown is nearer than the end"
    assert set(frozen(agent, np.arange(0.45, 0.9, 0.05)[:, None])) == {RIGHT}


def test_its_values_are_those_of_plain_value_iteration_over_what_is_known():
    agent = line_agent()
    grid, mdp, lowest = agent.grid, agent.mdp.arrays, agent.planner.bounds[0]
    values = np.full(grid.n_points, lowest)
    for _ in range(200):
        before = values.copy()
        for point in range(grid.n_points):
            of_actions = [lowest]
            for action in range(2):
                if mdp.modelled[action * grid.n_points + point]:
                    n = mdp.length[point, action]
                    successors = before[mdp.to[point, action, :n]]
                    of_actions.append(mdp.reward[point, action] + float(mdp.weight[point, action, :n] @ successors))
            values[point] = min(max(of_actions), 0.0)
    assert (values == lowest).any() and (values > -20.0).any()
    for state in np.linspace(0.36, 0.94, 30)[:, None]:
        prediction, _ = agent.model.predict_at(state)
        function = ValueFunction(values, grid.plain, 1.0, agent.planner.bounds, agent.planner.worth)
        agent._q.compute(prediction, state, function)
        known = prediction.weight >= 1.0
        expected = np.where(known, agent._q.q, -np.inf) if known.any() else agent._q.q
        assert expected[agent.act(state, explore=False)] == pytest.approx(expected.max(), abs=1e-2)


def test_a_source_or_a_coarse_grid_without_bounds_leave_it_the_learner_s_own_values():
    assert frozen(line_agent(is_bounded=False, is_coarse=True)) == [LEFT]
    assert frozen(line_agent(is_bounded=False)) == frozen(line_agent(is_coarse=True)) == [RIGHT]
    # Its instances tell nothing here, as what is known needs none; but it might say what the unknown is worth.
    assert line_agent(Mine())._function_of_frozen() is None
    cautious = line_agent(is_bounded=False, is_coarse=True, acted=False)
    assert frozen(cautious) == [RIGHT], "what others have seen is all there is to go by"


def test_it_holds_actions_until_they_leave_a_cell_but_on_a_coarse_grid_and_in_learning():
    fine, coarse = line_agent(), line_agent(is_coarse=True)
    assert fine._function_of_frozen().holds and not coarse._function_of_frozen().holds
    assert not fine._function().holds


def test_it_follows_what_is_learned_and_changes_none_of_it():
    agent, unasked = line_agent(), line_agent()
    before = frozen(agent)
    assert_same_state(agent, unasked)
    for _ in range(30):
        # There is an end on the left as well, and it is nearer.
        agent.update(np.array([0.38]), LEFT, -1.0, np.array([0.33]), True)
        agent.update(np.array([0.43]), LEFT, -1.0, np.array([0.38]), False)
    assert before == [RIGHT] and frozen(agent) == [LEFT]


@pytest.mark.parametrize(("name", "is_bounded"), [("MountainCar-v0", True), ("Pendulum-v1", True), ("CartPole-v1", False)])
def test_the_space_says_whether_variables_have_bounds(name, is_bounded):
    env = gym.make(name)
    if name == "Pendulum-v1":
        env = gym.wrappers.TransformAction(env, lambda a: [2.0 * a - 2.0], gym.spaces.Discrete(3))
    assert FittedRMax(env).agent.task.is_bounded is is_bounded
    low, high = np.full(env.observation_space.shape, -5.0), np.full(env.observation_space.shape, 5.0)
    assert FittedRMax(env, bounds=(low, high)).agent.task.is_bounded, "the user gives some"


class BetweenEdges(gym.Env):
    """Steps of 0.05 to either side, with noise; each pays 1, and beyond 0.1 and 0.9 an episode ends."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.n = self.np_random.uniform(0.4, 0.6), 0
        return np.float32([self.at]), {}

    def step(self, action):
        self.at = float(np.clip(self.at + 0.05 * (2 * action - 1) + 0.02 * self.np_random.normal(), 0.0, 1.0))
        self.n += 1
        return np.float32([self.at]), 1.0, not 0.1 < self.at < 0.9, self.n >= 200, {}


def test_a_frozen_policy_keeps_away_from_an_edge_where_noise_ends_episodes():
    model = FittedRMax(BetweenEdges(), seed=0).learn(1000)
    mean, _ = evaluate_policy(model, Monitor(BetweenEdges()), n_eval_episodes=20)
    # Random actions live 70 steps.
    assert mean > 140.0
