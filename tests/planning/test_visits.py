"""Visits where all is known end the optimism of grid points around them that nothing comes near to."""

import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.naive_fitted_rmax import NaiveGrid
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.visits import ENOUGH_VISITS, Visits

GRIDS = [((3,), 1), ((2, 2), 0), ((2, 1), 1), ((2,), 0, (True,)), ((2, 2), 0, (True, False)), ((1, 1, 1), 0)]
THRESHOLD = 0.7


def note_many(grid, visits, n_optimistic):
    """Note visits, each a (state, weights); what they return, and the counts in the end."""
    resolution, margin, periodic = *grid, *(None,) * (3 - len(grid))
    made = StateGrid(len(resolution), resolution, margin, periodic)
    counter = Visits(made.n_variables, made.n_points)
    found = [counter.note(state, weight, THRESHOLD, n_optimistic, made.plain).copy() for state, weight in visits]
    return found, counter.counts


@settings(deadline=None, derandomize=True, max_examples=25)
@given(st.sampled_from(GRIDS), st.integers(0, 10**6), st.integers(1, 30))
def test_visits_are_counted_at_the_optimistic_points_around_where_every_action_is_known(grid, seed, n):
    rng = np.random.default_rng(seed)
    naive, d = NaiveGrid(*grid), len(grid[0])
    n_optimistic = rng.integers(0, 3, len(naive.coordinates))
    states = [rng.uniform(-0.1, 1.1, d) if rng.random() < 0.7 else rng.integers(0, 5, d) / 4 for _ in range(4)]
    visits = [(states[rng.integers(4)], rng.uniform(0.6, 1.5, 2)) for _ in range(n)]
    found, counts = note_many(grid, visits, n_optimistic)
    expected = np.zeros(len(n_optimistic), dtype=int)
    for points, (state, weight) in zip(found, visits, strict=True):
        around = [p for p in naive.corners(state) if n_optimistic[p] > 0] if (weight >= THRESHOLD).all() else []
        expected[around] += 1
        assert sorted(points) == sorted(p for p in around if expected[p] >= ENOUGH_VISITS)
    np.testing.assert_array_equal(counts, expected)


STATE = np.array([0.5625, 0.5])


def agent_beside_unknown_points():
    """Both actions are known at STATE, but the narrow kernel leaves the grid points on both sides of it optimistic."""
    agent = make_agent(2, 2, degree=1, resolution=3, model_breadth=0.08, min_weight=0.4, n_neighbors=4, max_backups=10)
    for action in range(2):
        agent.update(STATE, action, -1.0, STATE + 0.02, False)
    return agent


@pytest.mark.filterwarnings("ignore:resolution")
def test_the_agent_makes_pairs_known_that_it_has_visited_often_enough():
    agent = agent_beside_unknown_points()
    points = list(NaiveGrid((3, 3), 1).corners(STATE))
    pairs = [action * agent.grid.n_points + point for action in range(2) for point in points]
    agent.model.known[pairs] = False
    agent.model.fits.total[pairs] = 0.3
    agent.model.update_rows(np.array(pairs))
    prediction, _ = agent.model.predict_at(STATE)
    assert (prediction.weight >= agent.model.exploration_threshold).all()
    for visit in range(1, ENOUGH_VISITS + 1):
        assert not agent.model.known[pairs].any()
        agent.act(STATE)
        assert agent.visits.counts[points].tolist() == [visit] * len(points)
    assert agent.model.known[pairs].all()
    assert (agent.mdp.arrays.n_optimistic[points] == 2).all(), "rows are written when the agent plans"
    agent.update(np.array([0.1, 0.1]), 0, -1.0, np.array([0.1, 0.2]), False)
    assert agent.mdp.arrays.modelled[pairs].all() and (agent.mdp.arrays.n_optimistic[points] == 0).all()
    agent.act(STATE)
    assert agent.visits.counts[points].tolist() == [ENOUGH_VISITS] * len(points), "they are not optimistic any more"


@pytest.mark.filterwarnings("ignore:resolution")
def test_evaluating_counts_no_visits():
    agent = agent_beside_unknown_points()
    agent.model.known[:] = False
    agent.model.update_rows(np.arange(len(agent.model.known)))
    agent.act(STATE, explore=False)
    agent.q_values(STATE)
    agent.sample_action(STATE)
    assert not agent.visits.counts.any()
    agent.act(STATE)
    assert agent.visits.counts.any()


@pytest.mark.filterwarnings("ignore:resolution")
def test_visits_are_saved_with_the_agents_state():
    agent, restored = agent_beside_unknown_points(), agent_beside_unknown_points()
    agent.visits.counts[::3] = 2
    agent.end_episode(False)
    restored.set_state(agent.get_state())
    assert restored.visits.counts.any()
    assert_same_state(agent, restored)
