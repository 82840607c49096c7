"""Where lines move, a frozen policy acts by values on a grid twice as fine as the learner's."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.own_method import Mine
from scipy.interpolate import RegularGridInterpolator

from sb3_combrel.fitted_rmax import agent as agent_module
from sb3_combrel.planning.mdp import FiniteMDP

N_CELLS, STEP = 4, 0.09


def point_agent(transfer=None, is_bounded=True, ends=False, n=150, **settings):
    """Steps of 0.09 along each of three variables, up or down; the nearer to a place, the more they pay, for ever."""
    agent = make_agent(3, 6, transfer, resolution=2, gamma=0.9, **{"max_value": 10.0, "model_breadth": 0.3, **settings})
    agent.task = replace(agent.task, is_bounded=is_bounded)
    rng = np.random.default_rng(1)
    for _ in range(n):
        state, action = rng.random(3), int(rng.integers(6))
        after = state.copy()
        after[action // 2] = np.clip(after[action // 2] + (STEP if action % 2 else -STEP), 0.0, 1.0)
        agent.update(state, action, pays(after), after, False)
    if ends:
        agent.update(np.full(3, 0.95), 1, 0.0, np.array([1.0, 0.95, 0.95]), True)
    agent.end_episode(truncated=not ends)
    return agent


def pays(state):
    return float(np.exp(-20.0 * ((state - 0.62) ** 2).sum()))


@pytest.fixture(scope="module")
def agent():
    return point_agent()


STATES = np.random.default_rng(3).random((60, 3))


def actions_of(agent):
    return [agent.act(state, explore=False) for state in STATES]


def test_it_acts_by_value_iteration_over_what_is_known_on_a_grid_twice_as_fine(agent):
    grid, lowest = agent.grid.finer(), agent.planner.bounds[0]
    lines = [grid.arrays.lines[k, : 2 * N_CELLS + 1] for k in range(3)]
    assert not agent.grid.arrays.even and all(set(agent.grid.arrays.lines[k, :5]) <= set(lines[k]) for k in range(3))
    mdp = FiniteMDP(grid, 6, 0.9)
    agent.model.on(mdp)
    rows, modelled = mdp.arrays, mdp.arrays.modelled.reshape(6, -1).T
    assert modelled.any() and not modelled.all()
    transition = np.zeros((grid.n_points, 6, grid.n_points))
    for point, action in np.argwhere(modelled):
        n = rows.length[point, action]
        np.add.at(transition[point, action], rows.to[point, action, :n], rows.weight[point, action, :n])
    values = np.full(grid.n_points, lowest)
    for _ in range(300):
        q = np.where(modelled, rows.reward + transition @ values, lowest)
        values = np.minimum(q.max(axis=1), agent.planner.bounds[1])
    between = RegularGridInterpolator(lines, values.reshape(grid.arrays.shape))
    n_compared = 0
    for state, action in zip(STATES, actions_of(agent), strict=True):
        prediction, _ = agent.model.predict_at(state)
        known = prediction.weight >= 1.0
        if known.sum() < 2:
            continue
        q = prediction.reward + 0.9 * between(np.clip(state + prediction.effect[:, 0], 0.0, 1.0))
        n_compared += 1
        assert known[action] and q[action] == pytest.approx(q[known].max(), abs=0.02)
    assert n_compared > 20


def test_the_learner_s_grid_does_where_a_finer_one_has_too_many_pairs(monkeypatch):
    monkeypatch.setattr(agent_module, "MAX_PAIRS_BY_DEFAULT", 9**3 * 6 - 1)
    agent = point_agent()
    assert agent._function_of_frozen().grid is agent.grid.plain
    monkeypatch.setattr(agent_module, "MAX_PAIRS_BY_DEFAULT", 9**3 * 6)
    agent.plan_anew()
    assert len(agent._function_of_frozen().values) == 9**3


@pytest.mark.parametrize("kwargs", [dict(transfer=Mine()), dict(is_bounded=False), dict(ends=True), dict(degree=0)], ids=str)
def test_the_learner_s_grid_does_with_a_source_without_bounds_with_an_end_to_come_to_and_with_kernel_averages(kwargs):
    agent = point_agent(**kwargs)
    for agent.has_acted in (True, False):
        function = agent._function_of_frozen()
        assert function is None or len(function.values) <= 5**3


def test_it_changes_nothing_of_what_is_learned_and_follows_what_is(agent):
    asked, unasked = point_agent(n=100), point_agent(n=100)
    before = actions_of(asked)
    assert_same_state(asked, unasked)
    assert before == actions_of(unasked)
    for each in (asked, unasked):
        # All is paid for at the other end now.
        for state in np.random.default_rng(5).uniform(0.0, 0.3, (60, 3)):
            for action in range(6):
                each.update(state, action, 1.0, state, False)
    assert_same_state(asked, unasked)
    assert before != actions_of(asked) == actions_of(unasked)


def test_what_is_saved_acts_the_same(agent):
    again = point_agent(n=0)
    again.set_state({name: array.copy() for name, array in agent.get_state().items()})
    assert actions_of(again) == actions_of(agent)
