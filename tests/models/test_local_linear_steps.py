"""Rows of the local linear model that lead several steps ahead, against the definition, and against exact dynamics."""

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, N_ACTIONS, learn, random_transitions, row_of
from helpers.linear_models import (
    LINEAR_KERNELS,
    LinearDynamics,
    StubPrior,
    assert_restored,
    assert_same_fits,
    finish_episode,
    learn_linear,
    linear_model_and_definition,
    make_linear_model,
)
from hypothesis import given, settings
from hypothesis import strategies as st

problems = st.tuples(
    st.sampled_from(GRIDS),
    st.sampled_from(LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 60),
    st.sampled_from([2, 3, 50]),
)
slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=30)
BROAD = dict(breadth=0.5, min_weight=0.05, n_neighbors=20, outcome_breadth=0.05)


def small_steps(seed, d, n, ends=False):
    """Transitions whose effects are much smaller than a cell; a few end the episode."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, d))
    effects = 0.03 * rng.normal(size=(N_ACTIONS, d)) + 0.05 * (states[:, None] - 0.5)
    return [(s, i % N_ACTIONS, -1.0, s + effects[i, i % N_ACTIONS], ends and i % 9 == 8) for i, s in enumerate(states)]


@slow_and_repeatable
@given(problems, st.sampled_from([1.0, 0.9]), st.booleans())
def test_every_row_is_the_one_of_the_definition(problem, gamma, ends):
    grid, kernel, seed, n, max_model_steps = problem
    model, naive = linear_model_and_definition(grid, kernel, gamma=gamma, max_model_steps=max_model_steps)
    d = len(grid[0])
    transitions = small_steps(seed, d, n, ends) + random_transitions(seed, d, n // 4)
    for first in range(0, len(transitions), 20):
        learn_linear(model, naive, transitions[first : first + 20])
        finish_episode(model)
        assert_same_fits(model, naive, gamma)


@slow_and_repeatable
@given(problems, st.sampled_from([1.0, 0.9]))
def test_every_row_is_the_one_of_the_definition_with_a_prior(problem, gamma):
    grid, kernel, seed, n, max_model_steps = problem
    d = len(grid[0])
    prior = StubPrior(LinearDynamics(seed, d, size=0.05).effect, claims=lambda state, action: state[0] < 0.6)
    model, naive = linear_model_and_definition(grid, kernel, gamma=gamma, prior=prior, max_model_steps=max_model_steps)
    model.update_rows(model.renew_prior())
    learn_linear(model, naive, small_steps(seed, d, n))
    finish_episode(model)
    assert assert_same_fits(model, naive, gamma) > 0


def test_several_steps_are_those_of_the_dynamics_where_these_are_linear():
    dynamics = LinearDynamics(0, 2, size=0.04)
    rng = np.random.default_rng(0)
    # So low a threshold that all is known from then on.
    model = make_linear_model(((2, 2), 0), BROAD, threshold=0.1, max_model_steps=50)
    learn(model, dynamics.transitions(rng.uniform(-0.1, 1.1, (40, 2))))
    finish_episode(model)
    middle = 2 * 5 + 2
    for action in range(N_ACTIONS):
        state, steps = np.array([0.5, 0.5]), 0
        while np.abs(state - 0.5).max() < 0.25 and steps < 50:
            state, steps = state + dynamics.effect(state, action), steps + 1
        # The last step is cut short where the cell is left.
        pair = action * model.grid.n_points + middle
        row = row_of(model.mdp, middle, action)
        assert steps - 1 <= -model.mdp.arrays.reward[pair] * (1.0 + 1e-9) and sum(row.values()) == pytest.approx(1.0)
        assert -model.mdp.arrays.reward[pair] <= steps + 0.2
        mean = sum(weight * model.grid.points()[to] for to, weight in row.items())
        assert np.abs(mean - 0.5).max() == pytest.approx(0.25), "on the edge of the cells around the point"


def test_where_an_episode_has_ended_nearby_a_row_leads_one_step_ahead():
    model = make_linear_model(((3,), 0), BROAD, n_actions=1, max_model_steps=50)
    for at in np.linspace(0.0, 1.0, 41):
        model.update_rows(model.add(np.array([at]), 0, -1.0, np.array([at + 0.01]), False))
    finish_episode(model)
    before = model.mdp.arrays.reward[4]
    assert before == pytest.approx(-12.5, rel=0.01), "a cell of 0.125 is left after 12.5 steps"
    assert row_of(model.mdp, 4) == pytest.approx({5: 1.0}, rel=1e-6)
    model.update_rows(model.add(np.array([0.55]), 0, -1.0, np.array([0.56]), True))
    finish_episode(model)
    assert model.fits.n_ended[4] == 1 and sum(row_of(model.mdp, 4).values()) < 1.0


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_what_is_restored_is_and_learns_the_same_to_the_last_bit(grid):
    model, restored = (make_linear_model(grid, LINEAR_KERNELS[0], max_model_steps=50) for _ in range(2))
    d = len(grid[0])
    learn(model, small_steps(1, d, 60, ends=True))
    finish_episode(model)
    # A larger effect far away widens the range that effects are kept within, and nothing else.
    learn(model, random_transitions(1, d, 20))
    assert_restored(model, restored, small_steps(2, d, 40, ends=True))
