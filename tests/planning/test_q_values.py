"""Q at exact states against its definition, through the agent."""

import copy
import warnings

import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.kernel_models import add_instances
from helpers.naive_fitted_rmax import NaiveFittedRMax
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import TIMBREL, InterTaskMapping, SourceInstances

N_ACTIONS = 3


def agent_and_definition(n_variables, resolution, *, gamma=1.0, max_value=0.0, threshold=1.0, periodic=None, **kernel):
    kernel = dict(breadth=0.3, min_weight=0.01, min_fraction=0.13) | kernel
    task = dict(gamma=gamma, max_value=max_value, periodic=periodic)
    breadth, fractions = kernel["breadth"], {name: kernel[name] for name in ("min_weight", "min_fraction")}
    model = dict(degree=0, model_breadth=breadth, exploration_threshold=threshold, resolution=resolution, **fractions)
    agent = make_agent(n_variables, N_ACTIONS, **model, **task)
    naive = NaiveFittedRMax(agent.grid.resolution, agent.grid.margin, N_ACTIONS, kernel, threshold=threshold, **task)
    return agent, naive


def q_values(agent, state, values, holds):
    agent._evaluate(state, agent._function()._replace(values=values, holds=holds))
    return agent._q.q.copy()


@settings(deadline=None, derandomize=True, max_examples=25)
@given(
    st.integers(0, 10**6),
    st.integers(1, 3),
    st.integers(0, 40),
    st.sampled_from([1.0, 0.9]),
    st.sampled_from([0.3, 1.0, 2.5]),
    st.sampled_from([0.0, 7.0, -3.0]),
    st.sampled_from([None, (True, True, True), (True, False, True)]),
    st.booleans(),
)
def test_q_is_the_backup_of_the_instances_near_the_state(seed, n_variables, n, gamma, threshold, max_value, periodic, holds):
    rng = np.random.default_rng(seed)
    flags = None if periodic is None else periodic[:n_variables]
    arguments = dict(gamma=gamma, threshold=threshold, max_value=max_value, periodic=flags)
    agent, naive = agent_and_definition(n_variables, 2, **arguments)
    transitions = []
    for _ in range(n):
        state = rng.random(n_variables)
        effect = rng.normal(0.0, 0.2, n_variables) * (rng.random() < 0.7)
        transitions.append(
            (state, int(rng.integers(N_ACTIONS)), float(rng.normal()), state + effect, bool(rng.random() < 0.1))
        )
    # Only the models learn: Q is compared on values at the grid points that are chosen here.
    for transition in transitions:
        agent.model.add(*transition)
    add_instances(naive, transitions)
    values = max_value - 5.0 * rng.random(naive.n_points)
    agent.planner.bounds = (max_value - 20.0, max_value)
    for state in [rng.random(n_variables) for _ in range(5)] + [t[0] for t in transitions[:5]]:
        expected = naive.q_values(state, values, max_value - 20.0, holds)
        found = q_values(agent, state, values, holds)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
        # Optimism is exact: exploration finds untried actions by comparing with ==.
        np.testing.assert_array_equal(found == max_value, expected == max_value)


class OneVariable:
    """An agent on a line, and values that fall by 1 with every grid point: grid coordinates are 4 u + 1."""

    def __init__(self):
        self.agent, naive = agent_and_definition(1, 2, breadth=0.2, min_fraction=0.01)
        self.values = -np.arange(naive.n_points, dtype=float)
        self.agent.planner.bounds = (-100.0, 0.0)

    def learn(self, state, effect, reward=-1.0, terminated=False, times=2, action=0):
        state = np.array([state])
        for _ in range(times):
            self.agent.model.add(state, action, reward, state + effect, terminated)

    def q_values(self, state):
        return q_values(self.agent, np.array([state]), self.values, holds=False)

    def q(self, state):
        return self.q_values(state)[0]


@pytest.fixture
def line():
    return OneVariable()


def test_below_the_threshold_an_action_has_the_bound_interpolated_between_grid_points(line):
    bounds = -np.arange(line.agent.grid.n_points, dtype=float) ** 2
    line.agent.planner.set_upper(bounds)
    line.learn(0.5, 0.1)
    for state in (0.0, 0.125, 0.3, 0.9):
        expected = np.interp(4.0 * state + 1.0, np.arange(len(bounds)), bounds)
        np.testing.assert_allclose(line.q_values(state), expected, atol=1e-12)
    assert line.q(0.5) == pytest.approx(-1.0 - 3.4), "a known action has what it leads to"
    assert line.q_values(0.5)[1] == pytest.approx(-9.0)
    line.agent.planner.set_upper(None)
    assert (line.q_values(0.3) == 0.0).all()


def test_pushing_against_the_edge_of_the_grid_is_staying():
    agent, _ = agent_and_definition(3, 1, breadth=0.5, min_fraction=0.01)
    agent.planner.bounds = (-100.0, 0.0)
    corner = np.ones(3)
    for _ in range(2):
        agent.model.add(corner, 0, -1.0, corner + 0.3, False)
    assert agent.q_values(corner)[0] == -100.0


@pytest.mark.parametrize(
    ("effect", "held", "once"), [(0.25, -5.0, -5.0), (0.3, -5.2, -5.2), (0.1, -6.5, -4.4), (0.0, -100.0, -100.0)]
)
def test_an_action_is_held_until_it_leaves_a_cell(line, effect, held, once):
    """Cells are 0.25 wide, and values fall from -3 by 1 to the next: to leave by 0.1 takes 2.5 steps, each for -1."""
    line.learn(0.5, effect)
    for holds, expected in ((True, held), (False, once)):
        assert q_values(line.agent, np.array([0.5]), line.values, holds)[0] == pytest.approx(expected)


def test_values_that_no_action_keeps_do_not_hold_a_frozen_policy():
    """Interpolated across a wall, values here are higher than any action's: to press pays by them, and never gets anywhere."""
    agent = make_agent(1, 2, degree=0, model_breadth=0.12, resolution=2, gamma=1.0, max_value=0.0)
    agent.planner.bounds = (-100.0, 0.0)
    here = np.array([0.5])
    for _ in range(3):
        agent.model.add(here, 0, -1.0, here + 0.001, False)
        agent.model.add(here, 1, -1.0, here - 0.25, False)
    values = np.array([0.0, -10.0, -12.0, 0.0, 0.0, 0.0, 0.0])  # 0 here, -12 to the left
    assert q_values(agent, here, values, False).argmax() == 0, "the wall"
    assert q_values(agent, here, values, True).argmax() == 1, "the way around"


def test_asking_for_q_changes_nothing_and_gives_an_array_of_the_caller_s_own(line):
    line.learn(0.5, 0.05)
    before, first = copy.deepcopy(line.agent), line.agent.q_values(np.array([0.52]))
    expected = first.copy()
    line.agent.q_values(np.array([0.1]))[:] = np.nan
    np.testing.assert_array_equal(first, expected)
    np.testing.assert_array_equal(line.agent.q_values(np.array([0.52])), expected)
    assert_same_state(line.agent, before)


HERE, ELSEWHERE = np.array([0.3]), np.array([0.7])


@pytest.fixture(params=[0, 1])
def line_agent(request):
    """Makes an agent on a line, with actions 0 and 1."""

    def make(transfer=None):
        return make_agent(1, 2, transfer, degree=request.param, model_breadth=0.05, resolution=4)

    return make


def learn_to_move(agent):
    for _ in range(3):
        agent.update(HERE, 0, -1.0, np.array([0.32]), False)


def ends_anywhere(reward):
    """Transfer from a source in which action 1 ends the episode anywhere, with a reward; action 0 moves a little, for -1."""
    at = np.linspace(0.0, 1.0, 201)
    states, ends = np.tile(at, 2)[:, None], np.append(np.clip(at + 0.1, 0.0, 1.0), at)[:, None]
    actions = np.repeat([0, 1], 201)
    source = SourceInstances(states, actions, np.where(actions == 1, reward, -1.0), ends, actions == 1, [0.0], [1.0], 2)
    return TIMBREL(source, InterTaskMapping([0], [0, 1]))


def test_an_evaluation_prefers_known_actions_to_transferred_ones_that_look_better(line_agent):
    agent = line_agent(ends_anywhere(-1.0))
    agent.prepare()
    learn_to_move(agent)
    best, second = agent.q_values(HERE)[::-1]
    assert best > second and agent.act(HERE) == 1 and agent.act(HERE, explore=False) == 0
    assert agent.act(ELSEWHERE, explore=False) == 1, "where nothing is known, the best of what was transferred"
    # A transferred end that is worth as much as optimism.
    agent = line_agent(ends_anywhere(0.0))
    agent.prepare()
    assert agent.q_values(HERE)[1] == agent.planner.bounds[1] > agent.q_values(HERE)[0]
    assert agent.act(HERE, explore=False) == 1


def test_an_evaluation_takes_a_known_end_that_is_worth_as_much_as_optimism(line_agent):
    agent = line_agent()
    learn_to_move(agent)
    assert agent.act(HERE, explore=False) == 0, "action 1 is optimistic: where it leads is not known"
    for _ in range(3):
        agent.update(HERE, 1, 0.0, np.array([0.32]), True)
    assert agent.q_values(HERE)[1] == 0.0 == agent.planner.bounds[1] and agent.act(HERE, explore=False) == 1


def test_a_state_that_cannot_be_one_is_refused_and_one_in_raw_units_warned_of(line_agent):
    agent = line_agent()
    for wrong in ([0.1, 0.2], [[0.5]], [np.nan]):
        with pytest.raises(ValueError, match="state must be 1 finite numbers, got"):
            agent.q_values(wrong)
    with pytest.warns(UserWarning, match=r"outside what has been seen, .*model.policy.to_unit\(observation\)"):
        agent.q_values([-0.5])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.q_values([1.0])
