"""The local linear model with a prior, which joins its fits as further instances."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import N_ACTIONS, learn, make_model
from helpers.linear_models import LinearDynamics, StubPrior, make_linear_model, renew

GRID, KERNEL = ((2, 2), 0), dict(breadth=0.3, min_weight=0.05, n_neighbors=8, outcome_breadth=0.1)


def model_with_prior(prior, grid=GRID, kernel=KERNEL, **kwargs):
    model = make_linear_model(grid, kernel, prior=prior, **kwargs)
    model.update_rows(model.renew_prior())
    return model


def test_an_exact_prior_makes_what_is_known_exact_and_makes_nothing_known():
    dynamics = LinearDynamics(1, 2)
    model = model_with_prior(StubPrior(dynamics.effect, lambda state, action: 1e6))
    assert not model.mdp.arrays.modelled.any()
    learn(model, dynamics.transitions(np.random.default_rng(0).random((40, 2))))
    state = np.array([0.37, 0.81])
    prediction = model.predict_at(state)[0]
    for action in range(N_ACTIONS):
        np.testing.assert_allclose(prediction.effect[action, 0], dynamics.effect(state, action), atol=1e-6)


@pytest.mark.parametrize("weight", [0.0, 0.5, 3.0])
def test_a_prior_counts_as_so_many_instances_at_the_state_and_for_more_away_from_own_ones(weight):
    """With one instance, and a prior that says nothing moves."""
    model = model_with_prior(StubPrior(lambda state, action: np.zeros(2), lambda state, action: weight), n_actions=1)
    state, away = np.array([0.5, 0.5]), np.array([0.3, 0.0])
    learn(model, [(state, 0, -1.0, state + 0.1, False)])
    near, far = (model.predict_at(at)[0].effect[0, 0].copy() for at in (state, state + away))
    np.testing.assert_allclose(near, 0.1 / (1.0 + weight * np.array([1.0, 0.5])), rtol=1e-9)
    assert (far < near).all() if weight else (far == near).all()
    alone, leverage = model.predict_alone(state, 0)
    np.testing.assert_allclose(alone, 0.1, rtol=1e-9)
    assert leverage == pytest.approx(1.0)
    assert model.predict_alone(state + away, 0)[1] == pytest.approx(np.exp((0.3 / KERNEL["breadth"]) ** 2))
    assert model.predict_alone(state + 5.0, 0)[1] == 0.0, "nothing is near"


def test_a_weak_prior_does_not_decide_close_to_instances_in_a_plane_where_the_slope_across_it_is_not_determined():
    """All stand in front of a wall and do not move; a prior knows of no wall."""
    model = model_with_prior(StubPrior(lambda state, action: np.full(2, 0.1), lambda state, action: 0.01), n_actions=1)
    at_wall = [np.array([0.6, y]) for y in np.linspace(0.3, 0.7, 41)]
    learn(model, [(state, 0, -1.0, state, False) for state in at_wall])
    beyond = np.array([0.62, 0.5])
    assert abs(model.predict_at(beyond)[0].effect[0, 0, 0]) < 0.002
    assert model.predict_alone(beyond, 0)[1] == pytest.approx(1.0, rel=0.01)


def test_a_prior_is_asked_again_when_its_version_has_grown_and_only_then():
    one, other = LinearDynamics(5, 2), LinearDynamics(6, 2)
    prior = StubPrior(one.effect)
    model, naive = linear_models.linear_model_and_definition(GRID, KERNEL, prior=prior)
    model.update_rows(model.renew_prior())
    linear_models.learn_linear(model, naive, one.transitions(np.random.default_rng(0).random((30, 2))))
    prior.effect = other.effect
    assert len(model.renew_prior()) == 0
    before = model.pairs.fit.copy()
    renew(model, prior)
    assert (model.pairs.fit != before).any()
    assert linear_models.assert_same_rows(model, naive) > 0
    assert len(model.renew_prior()) == 0


@pytest.mark.parametrize("max_instances", [None, 8])
def test_a_new_prior_joins_fits_that_were_kept_as_it_joins_those_made_anew(max_instances):
    """``n_new`` says that none is kept."""
    one, other = LinearDynamics(5, 2), LinearDynamics(6, 2)
    models = []
    for _ in range(2):
        model = model_with_prior(StubPrior(one.effect), max_instances=max_instances)
        for transition in one.transitions(np.random.default_rng(0).random((40, 2))):
            model.update_rows(model.add(*transition))
        models.append(model)
    kept, anew = models
    outdated = np.setdiff1d(np.flatnonzero(kept.known), kept.outdated())
    assert len(outdated) > 4
    for model in models:
        model.mdp.gamma, model._prior.effect = 0.9, other.effect
    anew.pairs.n_new[outdated] = 1
    for model in models:
        renew(model, model._prior)
        model.update_rows(outdated)
    assert (kept.pairs.item[outdated] != 0).any()
    linear_models.assert_same_to_the_last_bit(kept, anew)


# What the local linear model makes of dynamics of a known kind: linear ones, and a wall.
BROAD = dict(breadth=0.5, min_weight=0.05, n_neighbors=20, outcome_breadth=0.05, min_fraction=0.01)
WALL, STRIDE = 0.6, 0.1


def effects_of(model, states):
    """Predicted mean effect of action 0 at states, over successors."""
    found = model.predict(states, np.zeros(len(states), dtype=np.int64))
    return (found.probability[:, :, None] * found.effect).sum(axis=1)


@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_linear_dynamics_are_found_from_a_few_instances_far_better_than_by_the_kernel_average(d):
    rng, dynamics = np.random.default_rng(d), LinearDynamics(d, d)
    grid = ((2,) * d, 0)
    models = make_linear_model(grid, BROAD), make_model(grid, BROAD)
    transitions = dynamics.transitions(rng.random((10 * d, d)))
    for model in models:
        learn(model, transitions)
    states = rng.uniform(0.2, 0.8, (50, d))
    expected = np.array([dynamics.effect(state, 0) for state in states])
    linear, average = (np.abs(effects_of(model, states) - expected).max() for model in models)
    assert linear < 0.05 * np.abs(expected).max(), "the ridge"
    assert linear < 0.25 * average


def walk_to_the_wall(states):
    """Steps to the right, as far as a wall; nobody gets through."""
    ends = np.where(states[:, 0] <= WALL, np.minimum(states[:, 0] + STRIDE, WALL), states[:, 0] + STRIDE)
    return [(s, 0, -1.0, np.array([end, s[1]]), False) for s, end in zip(states, ends, strict=True)]


def test_at_a_wall_visits_make_the_prediction_better():
    model = make_linear_model(((3, 3), 0), BROAD | dict(n_neighbors=40), n_actions=1)
    learn(model, walk_to_the_wall(np.random.default_rng(1).random((100, 2))))
    at_wall, errors = np.array([WALL, 0.5]), []
    for _ in range(45):
        errors.append(abs(model.predict_at(at_wall)[0].effect[0, 0, 0]))
        learn(model, walk_to_the_wall(at_wall[None]))
    assert errors[8] < 0.6 * errors[0] and errors[-1] < 0.01 * STRIDE and (np.diff(errors) < 1e-9).all()
