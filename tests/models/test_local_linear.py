"""The local linear model against its definition in plain loops: exact states, rows on the grid, and what is known."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import N_ACTIONS, pairs_of, random_transitions
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.local_linear import LocalLinear
from sb3_combrel.planning.mdp import FiniteMDP

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=15)
problems = st.tuples(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 30),
    st.sampled_from([0.3, 1.0, 4.0]),
)
# What a prior weighs; without any there is no prior.
weights = st.sampled_from([None, None, linear_models.left_half, lambda state, action: 0.1 * action, linear_models.nothing])


def with_some_prior(problem, weight, **kwargs):
    grid, kernel, seed, _, threshold = problem
    effect = linear_models.CurvedDynamics(seed, len(grid[0])).effect
    prior = weight and linear_models.StubPrior(effect, weight)
    model, naive = linear_models.linear_model_and_definition(grid, kernel, threshold=threshold, prior=prior, **kwargs)
    model.update_rows(model.renew_prior())
    return model, naive


@slow_and_repeatable
@given(problems, weights, st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3))
def test_the_prediction_at_any_state_is_that_of_the_definition(problem, weight, at):
    model, naive = with_some_prior(problem, weight)
    d = len(problem[0][0])
    transitions = random_transitions(problem[2], d, problem[3])
    linear_models.learn_linear(model, naive, transitions)
    for state in np.array([at[:d], transitions[0][0], transitions[-1][0] + 1e-3]):
        linear_models.assert_same_prediction(model, naive, state)
        prediction, several = model.predict_at(state)[0], model.predict(np.array([state] * N_ACTIONS), np.arange(N_ACTIONS))
        np.testing.assert_array_equal(several.weight, prediction.weight)
        np.testing.assert_array_equal(several.reward, prediction.reward)
        np.testing.assert_array_equal(
            several.probability[:, 0], np.where(prediction.length, prediction.probability[:, 0], 0.0)
        )


@slow_and_repeatable
@given(problems)
def test_on_a_finer_grid_it_is_the_model_that_its_transitions_make_there_and_it_stays_as_it_is(problem):
    grid, kernel, seed, n, threshold = problem
    model, same = (linear_models.make_linear_model(grid, kernel, threshold=threshold, gamma=0.9) for _ in range(2))
    finer = FiniteMDP(model.grid.finer(), N_ACTIONS, 0.9)
    expected = LocalLinear(FiniteMDP(model.grid.finer(), N_ACTIONS, 0.9), model.settings)
    for transition in random_transitions(seed, len(grid[0]), n):
        for each in (model, same):
            each.update_rows(each.add(*transition))
        expected.add(*transition)
    expected.update_all(np.arange(len(expected.known)))
    found = model.on(finer)
    assert found.mdp is finer and found.transfer is None
    linear_models.assert_same_to_the_last_bit(found, expected)
    linear_models.assert_same_to_the_last_bit(model, same)


@slow_and_repeatable
@given(problems, weights, st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3))
def test_how_sure_an_effect_is_is_that_of_the_definition_without_a_prior(problem, weight, at):
    (model, naive), (_, alone) = with_some_prior(problem, weight), with_some_prior(problem, None)
    d = len(problem[0][0])
    transitions = random_transitions(problem[2], d, problem[3])
    linear_models.learn_linear(model, naive, transitions)
    for transition in transitions:
        alone.add(*transition)
    for state in np.array([at[:d], transitions[0][0], transitions[-1][0] + 1e-3]):
        found = model.predict(np.array([state] * N_ACTIONS), np.arange(N_ACTIONS)).fit
        for action in range(N_ACTIONS):
            slopes, variance, leverage = (array[action] for array in found)
            fit, _ = alone.fitted(state, action, alone.now)
            if fit is None:
                assert np.isnan([*slopes.ravel(), *variance, leverage]).all()
                continue
            np.testing.assert_allclose(slopes, fit.slopes[:, :d], rtol=1e-6, atol=1e-8)
            assert leverage == pytest.approx(fit.sure, rel=1e-6)
            hat = (
                fit.design
                @ np.linalg.inv((fit.design.T * fit.weights) @ fit.design + fit.penalty)
                @ (fit.design.T * fit.weights)
            )
            freedom = fit.weights @ (1.0 - np.diag(hat))
            residual = (np.eye(len(hat)) - hat) @ fit.effects
            expected = fit.weights @ residual**2 / freedom if freedom > 1e-3 else np.full(d, np.inf)
            np.testing.assert_allclose(variance, expected, rtol=1e-5, atol=1e-10)


def test_the_true_effect_is_where_it_is_said_to_be():
    rng, noise = np.random.default_rng(0), 0.01
    model = linear_models.make_linear_model(((2, 2), 0), dict(linear_models.LINEAR_KERNELS[0], n_neighbors=30))
    slopes = np.array([[0.1, -0.2], [0.05, 0.1]])
    for state in rng.random((2000, 2)):
        model.add(state, 0, 0.0, state + state @ slopes + noise * rng.standard_normal(2), False)
    states = rng.uniform(0.1, 0.9, (300, 2))
    found = model.predict(states, np.zeros(len(states), dtype=np.int64))
    assert np.sqrt(found.fit.variance.mean()) == pytest.approx(noise, rel=0.03)
    error = (found.effect[:, 0] - states @ slopes) / np.sqrt(found.fit.variance * found.fit.leverage[:, None])
    # Instances that weigh less are counted as less exact, which they are not here.
    assert 0.7 < np.sqrt((error**2).mean()) < 1.0
    steepness = found.fit.slopes.mean(axis=0)
    np.testing.assert_allclose(steepness, slopes, atol=0.02)


@slow_and_repeatable
@given(problems, weights, st.sampled_from([1.0, 0.9]), st.booleans(), st.sampled_from([None, None, 4, 9]))
def test_each_row_is_that_of_the_transitions_up_to_which_it_was_fitted(problem, weight, gamma, small, max_instances):
    model, naive = with_some_prior(problem, weight, gamma=gamma, max_instances=max_instances)
    d, seed, n = len(problem[0][0]), problem[2], problem[3]
    transitions = linear_models.small_steps(seed, d, n, ends=bool(seed % 3)) if small else random_transitions(seed, d, n)
    linear_models.learn_linear(model, naive, transitions)
    linear_models.assert_same_rows(model, naive)
    assert (2 * model.pairs.n_new < model.pairs.length)[model.known].all(), "at once when half of the instances are new"
    modelled = model.mdp.arrays.modelled.reshape(N_ACTIONS, -1)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~modelled).sum(axis=0))
    model.update_all(np.arange(len(model.known)))
    assert (model.pairs.fitted_at == n).all()
    linear_models.assert_same_rows(model, naive)


@slow_and_repeatable
@given(problems, st.booleans(), st.sampled_from([None, 5]))
def test_after_every_transition_just_those_pairs_are_known_whose_instances_weigh_enough(problem, ends, max_instances):
    model, naive = with_some_prior(problem, None, max_instances=max_instances)
    d, seed, n = len(problem[0][0]), problem[2], problem[3]
    for transition in linear_models.small_steps(seed, d, n, ends):
        linear_models.learn_linear(model, naive, [transition])
        expected = [naive.known(action, point, naive.now) for action, point, _ in pairs_of(naive)]
        np.testing.assert_array_equal(model.known, expected)
        np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)


@pytest.mark.parametrize("outcome", [(-1.0, True), (-2.0, False)], ids=["an end", "another reward"])
def test_grid_points_are_known_with_less_once_an_outcome_has_told_states_apart(outcome):
    grid, kernel = ((4,), 0), linear_models.LINEAR_KERNELS[0]
    model, naive = linear_models.linear_model_and_definition(grid, kernel, threshold=2.0)
    linear_models.learn_linear(model, naive, linear_models.small_steps(0, 1, 6))
    before = model.known.copy()
    linear_models.learn_linear(model, naive, [(np.array([0.9]), 0, outcome[0], np.array([0.95]), outcome[1])])
    weight = np.array([naive.weight_of(action, point, naive.now) for action, point, _ in pairs_of(naive)])
    np.testing.assert_array_equal(model.known, weight >= 1.0)
    assert (model.known & (weight < 2.0)).any() and not (before & ~model.known).any()
    assert model.exploration_threshold == 2.0, "what is known of exact states needs as much as before"


def test_instances_that_agree_with_the_fit_change_few_rows_and_one_that_does_not_changes_those_around_it():
    model = linear_models.make_linear_model(((3, 3), 0), linear_models.LINEAR_KERNELS[0], n_actions=1)
    rng, n_changed = np.random.default_rng(0), []
    for state in rng.random((400, 2)):
        changed = model.add(state, 0, -1.0, state + 0.1 + 0.05 * state, False)
        model.update_rows(changed)
        n_changed.append(len(changed))
    assert np.mean(n_changed[200:]) < 0.3 * np.mean(n_changed[:20])
    state = np.array([0.51, 0.49])
    changed = model.add(state, 0, -1.0, state - 0.2, False)
    [nearest] = np.flatnonzero((model.grid.points() == 0.5).all(axis=1))
    assert nearest in changed and len(changed) > np.mean(n_changed[200:])


def test_what_an_end_means_is_known_at_once_to_all_actions_that_may_lead_there():
    model, naive = linear_models.linear_model_and_definition(((4,), 0), linear_models.LINEAR_KERNELS[1], gamma=0.9)
    linear_models.learn_linear(model, naive, linear_models.small_steps(1, 1, 40))
    model.update_all(np.arange(len(model.known)))
    linear_models.learn_linear(model, naive, [(np.array([0.5]), 0, 5.0, np.array([0.52]), True)])
    around = np.abs(model.grid.points()[:, 0] - 0.52) <= 1.0 / 16.0 + 0.02
    of_both = np.tile(around, N_ACTIONS)
    assert (model.pairs.fitted_at == naive.now)[of_both & model.known].all() and model.known[of_both].any()
    assert linear_models.assert_same_rows(model, naive) > 0
    # What leads there with some probability is fitted at once with each new instance near it.
    assert np.isinf(model.pairs.surprise).any()
