"""What the local linear model makes of dynamics of a known kind: linear ones, and a wall."""

import numpy as np
import pytest
from helpers.kernel_models import learn, make_model
from helpers.linear_models import LinearDynamics, make_linear_model

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


def walk_to_the_wall(states):
    """Steps to the right, as far as a wall; nobody gets through."""
    ends = np.where(states[:, 0] <= WALL, np.minimum(states[:, 0] + STRIDE, WALL), states[:, 0] + STRIDE)
    return [(s, 0, -1.0, np.array([end, s[1]]), False) for s, end in zip(states, ends, strict=True)]


def test_at_a_wall_visits_make_the_prediction_better():
    model = make_linear_model(((3, 3), 0), BROAD | dict(n_neighbors=40), n_actions=1)
    learn(model, walk_to_the_wall(np.random.default_rng(1).random((100, 2))))
    at_wall, errors = np.array([WALL, 0.5]), []
    for _ in range(8):
        errors.append(abs(model.predict_at(at_wall)[0].effect[0, 0, 0]))
        learn(model, walk_to_the_wall(at_wall[None]))
    assert errors[-1] < 0.25 * errors[0] and errors[-1] < 0.1 * STRIDE
    assert (np.diff(errors) < 0.0).all()
