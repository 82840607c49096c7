"""What the local linear model makes of dynamics of a known kind: linear ones, and a wall."""

import numpy as np
import pytest
from helpers.kernel_models import N_ACTIONS, learn, make_model
from helpers.linear_models import LinearDynamics, finish_episode, make_linear_model

BROAD = dict(breadth=0.5, min_weight=0.05, n_neighbors=20, outcome_breadth=0.05, min_fraction=0.01)
WALL, STRIDE = 0.6, 0.1


def effects_of(model, states):
    """Predicted mean effect of action 0 at states, over successors."""
    found = model.predict(states, np.zeros(len(states), dtype=np.int64))
    return (found.probability[:, :, None] * found.effect).sum(axis=1)


@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_linear_dynamics_are_found_from_a_few_instances_far_better_than_by_the_kernel_average(d):
    rng = np.random.default_rng(d)
    dynamics = LinearDynamics(d, d)
    grid = ((2,) * d, 0)
    models = make_linear_model(grid, BROAD), make_model(grid, BROAD)
    transitions = dynamics.transitions(rng.random((10 * d, d)))
    for model in models:
        learn(model, transitions)
    states = rng.uniform(0.2, 0.8, (50, d))
    expected = np.array([dynamics.effect(state, 0) for state in states])
    linear, average = (np.abs(effects_of(model, states) - expected).max() for model in models)
    assert linear < 0.05 * np.abs(expected).max(), "the ridge, a hundredth of what the kernel spans"
    assert linear < 0.25 * average


@pytest.mark.parametrize("periodic", [(False, False), (True, False)])
def test_the_error_on_linear_dynamics_is_that_of_the_ridge(periodic):
    # Of a slope the ridge takes away a fraction of about RIDGE * breadth^2 over the weighted sum of squared distances.
    dynamics = LinearDynamics(5, 2)
    model = make_linear_model(((2, 2), 0, periodic), BROAD, n_actions=N_ACTIONS)
    corners = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7], [0.5, 0.5]])
    learn(model, dynamics.transitions(corners))
    weight = np.exp(-2 * 0.2**2 / 0.5**2)
    shrunk = 0.01 * 0.5**2 / (4 * weight * 0.2**2 + 0.01 * 0.5**2)
    for offset in np.array([[0.1, 0.0], [0.0, -0.1], [0.05, 0.05]]):
        state = np.array([0.5, 0.5])
        np.testing.assert_allclose(effects_of(model, state[None])[0], dynamics.effect(state, 0), atol=1e-9)
        # The instances are the same ones nearby, their weights are a little different.
        error = np.abs(effects_of(model, (state + offset)[None])[0] - dynamics.effect(state + offset, 0))
        assert (error <= 2.0 * shrunk * np.abs(offset @ dynamics.matrix[0]).max() + 1e-3 * np.abs(offset).max()).all()


def test_grid_points_of_linear_dynamics_have_the_right_effects():
    rng = np.random.default_rng(3)
    dynamics = LinearDynamics(3, 2)
    model = make_linear_model(((3, 3), 0), BROAD)
    learn(model, dynamics.transitions(rng.random((60, 2))))
    finish_episode(model)
    assert model.known.all()
    points = model.grid.points()
    for action in range(N_ACTIONS):
        expected = np.array([dynamics.effect(point, action) for point in points])
        found = model.fits.row[action * len(points) : (action + 1) * len(points), :2]
        inside = ((points > 0.1) & (points < 0.9)).all(axis=1)
        assert np.abs(found - expected)[inside].max() < 0.02 * np.abs(expected).max()


def walk_to_the_wall(states):
    """Steps to the right, as far as a wall; nobody gets through."""
    ends = np.where(states[:, 0] <= WALL, np.minimum(states[:, 0] + STRIDE, WALL), states[:, 0] + STRIDE)
    return [(s, 0, -1.0, np.array([end, s[1]]), False) for s, end in zip(states, ends, strict=True)]


def test_at_visited_states_beside_a_wall_the_prediction_is_nearly_what_was_seen():
    rng = np.random.default_rng(0)
    model = make_linear_model(((3, 3), 0), BROAD | dict(n_neighbors=24), n_actions=1)
    transitions = walk_to_the_wall(rng.random((150, 2)))
    at_wall = np.array([WALL, 0.5])
    for _ in range(6):
        transitions += walk_to_the_wall(at_wall[None])
    learn(model, transitions)
    effect = model.predict_at(at_wall)[0].effect[0, 0].copy()
    intercept, slopes = model._near.fit[:2], model._near.fit[2:].reshape(2, 2)
    fitted = intercept + at_wall @ slopes
    assert abs(fitted[0]) > 0.2 * STRIDE, "the fit alone is a compromise of both sides: the case that this test is about"
    assert abs(effect[0]) < 0.2 * abs(fitted[0]) and abs(effect[1]) < 1e-6


def test_at_a_wall_visits_make_the_prediction_better():
    model = make_linear_model(((3, 3), 0), BROAD | dict(n_neighbors=40), n_actions=1)
    learn(model, walk_to_the_wall(np.random.default_rng(1).random((100, 2))))
    at_wall, errors = np.array([WALL, 0.5]), []
    for _ in range(8):
        errors.append(abs(model.predict_at(at_wall)[0].effect[0, 0, 0]))
        learn(model, walk_to_the_wall(at_wall[None]))
    assert errors[-1] < 0.25 * errors[0] and errors[-1] < 0.1 * STRIDE
    assert (np.diff(errors) < 0.0).all()
