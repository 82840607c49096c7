"""Regression from sums against least squares by NumPy, on random lists of instances."""

import numpy as np
import pytest
from helpers.naive_local_linear import ridge_regression
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.compiled import compiled
from sb3_combrel.common.linear_regression import (
    add_products,
    fitted_effect,
    linear_fit,
    n_products,
    products_of,
    solve_regression,
)
from sb3_combrel.models.linear_fits import EXPLAINED_WEIGHT, unexplained_effect

repeatable = settings(deadline=None, derandomize=True, max_examples=150)
problems = st.tuples(st.integers(0, 10**6), st.integers(1, 6), st.integers(1, 50), st.sampled_from([1e-4, 1e-2, 1.0]))


@compiled
def sums_of(weights, states, effects, products, sums):
    for i in range(len(weights)):
        products_of(states[i], effects[i], products)
        add_products(sums, weights[i], products)


@compiled
def solve(sums, ridge, factor, fit):
    solve_regression(sums, ridge, factor, fit)


@compiled
def effects_at(fit, state, found):
    for k in range(len(state)):
        found[k] = fitted_effect(fit, state, k)


@compiled
def unexplained_at(fit, outcome, found):
    for k in range(len(found)):
        found[k] = unexplained_effect(fit, outcome, k)


def random_list(seed, d, n, repeated=False):
    """Weights, states and effects; ``repeated``: all states are among a few."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, d))
    if repeated:
        states = states[rng.integers(0, max(1, n // 5), n)]
    return rng.uniform(0.05, 1.0, n), states, rng.normal(0.0, 0.3, (n, d))


def assert_same_regression(weights, states, effects, ridge):
    intercept, slopes = linear_fit(weights, states, effects, ridge)
    expected_intercept, expected_slopes = ridge_regression(weights, states, effects, ridge)
    np.testing.assert_allclose(slopes, expected_slopes, atol=1e-8)
    np.testing.assert_allclose(intercept, expected_intercept, atol=1e-8)


@repeatable
@given(problems)
def test_a_fit_is_the_one_of_least_squares(problem):
    seed, d, n, ridge = problem
    assert_same_regression(*random_list(seed, d, n), ridge)


@repeatable
@given(problems)
def test_a_fit_to_states_that_repeat_is_the_one_of_least_squares(problem):
    seed, d, n, ridge = problem
    assert_same_regression(*random_list(seed, d, n, repeated=True), ridge)


@pytest.mark.parametrize("d", range(1, 7))
def test_a_single_instance_gives_its_effect_everywhere(d):
    weights, states, effects = random_list(d, d, 1)
    intercept, slopes = linear_fit(weights, states, effects, 1e-3)
    np.testing.assert_allclose(slopes, 0.0, atol=1e-12)
    np.testing.assert_allclose(intercept, effects[0], atol=1e-12)


@pytest.mark.parametrize("d", range(1, 7))
def test_many_instances_at_one_state_give_their_weighted_mean_there(d):
    weights, states, effects = random_list(10 + d, d, 300)
    states[:] = states[0]
    intercept, slopes = linear_fit(weights, states, effects, 1e-6)
    np.testing.assert_allclose(intercept + states[0] @ slopes, np.average(effects, axis=0, weights=weights), atol=1e-9)
    assert np.isfinite(slopes).all()


@repeatable
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_effects_that_are_linear_are_found_exactly_if_there_are_more_instances_than_variables(seed, d):
    rng = np.random.default_rng(seed)
    weights, states, _ = random_list(seed, d, 4 * d + 4)
    slopes, intercept = rng.normal(size=(d, d)), rng.normal(size=d)
    found_intercept, found_slopes = linear_fit(weights, states, intercept + states @ slopes, 1e-12)
    np.testing.assert_allclose(found_slopes, slopes, atol=1e-6)
    np.testing.assert_allclose(found_intercept, intercept, atol=1e-6)


@repeatable
@given(problems, st.floats(-5.0, 5.0))
def test_a_constant_effect_has_no_slopes_however_large_the_ridge(problem, constant):
    seed, d, n, ridge = problem
    weights, states, effects = random_list(seed, d, n)
    intercept, slopes = linear_fit(weights, states, np.full_like(effects, constant), 100.0 * ridge)
    np.testing.assert_allclose(slopes, 0.0, atol=1e-9)
    np.testing.assert_allclose(intercept, constant, atol=1e-9)


@repeatable
@given(problems)
def test_sums_without_an_instance_that_was_taken_out_are_those_of_the_others(problem):
    seed, d, n, ridge = problem
    weights, states, effects = random_list(seed, d, n + 1)
    sums, products, factor, fit = np.zeros(n_products(d)), np.empty(n_products(d)), np.empty((d, d)), np.empty(d + d * d)
    sums_of(weights, states, effects, products, sums)
    sums_of(-weights[:1], states[:1], effects[:1], products, sums)
    solve(sums, ridge, factor, fit)
    intercept, slopes = ridge_regression(weights[1:], states[1:], effects[1:], ridge)
    np.testing.assert_allclose(fit[:d], intercept, atol=1e-7)
    np.testing.assert_allclose(fit[d:].reshape(d, d), slopes, atol=1e-7)


@repeatable
@given(problems)
def test_what_a_fit_leaves_unexplained_is_the_narrower_mean_of_the_residuals(problem):
    seed, d, n, ridge = problem
    weights, states, effects = random_list(seed, d, n)
    intercept, slopes = linear_fit(weights, states, effects, ridge)
    fit = np.concatenate([intercept, slopes.reshape(-1)])
    near = np.random.default_rng(seed + 1).uniform(0.0, 1.0, n) ** 4
    at = np.random.default_rng(seed + 2).random(d)
    predicted, unexplained = np.empty(d), np.empty(d)
    effects_at(fit, at, predicted)
    np.testing.assert_allclose(predicted, intercept + at @ slopes, atol=1e-12)
    # Reward and termination do not matter for effects.
    unexplained_at(fit, np.concatenate([[near.sum(), 7.0, 3.0], near @ states, near @ effects]), unexplained)
    residuals = effects - intercept - states @ slopes
    np.testing.assert_allclose(unexplained, near @ residuals / (near.sum() + EXPLAINED_WEIGHT), atol=1e-9)
