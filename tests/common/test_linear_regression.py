"""Regression from sums against least squares by NumPy, on random lists of instances."""

import numpy as np
from helpers.naive_local_linear import ridge_regression
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from sb3_combrel.common.linear_regression import add_products, fitted_effect, n_products, products_of, solve_regression
from sb3_combrel.models.linear_fits import EXPLAINED_WEIGHT, unexplained_effect

repeatable = settings(deadline=None, derandomize=True, max_examples=50)
problems = st.tuples(st.integers(0, 10**6), st.integers(1, 6), st.integers(1, 50), st.sampled_from([1e-4, 1e-2, 1.0]))


@njit
def fit_to(weights, states, effects, ridge, work):
    sums, products, factor, fit = work
    for i in range(len(weights)):
        products_of(states[i], effects[i], products)
        add_products(sums, weights[i], products)
    solve_regression(sums, ridge, factor, fit)


@njit
def effects_at(fit, state, outcome, found):
    for k in range(len(state)):
        found[0, k] = fitted_effect(fit, state, k)
        found[1, k] = unexplained_effect(fit, outcome, k)


def linear_fit(weights, states, effects, ridge):
    """Intercept, and slopes, as ``ridge_regression``."""
    d = states.shape[1]
    fit = np.empty(d + d * d)
    fit_to(weights, states, effects, ridge, (np.zeros(n_products(d)), np.empty(n_products(d)), np.empty((d, d)), fit))
    return fit[:d], fit[d:].reshape(d, d)


def random_list(seed, d, n, repeated=False):
    """Weights, states and effects; ``repeated``: all states are among a few."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, d))
    if repeated:
        states = states[rng.integers(0, max(1, n // 5), n)]
    return rng.uniform(0.05, 1.0, n), states, rng.normal(0.0, 0.3, (n, d))


@repeatable
@given(problems, st.booleans())
def test_a_fit_is_the_one_of_least_squares_also_without_an_instance_that_was_taken_out(problem, repeated):
    seed, d, n, ridge = problem
    given_ = random_list(seed, d, n, repeated)
    for found, expected in zip(linear_fit(*given_, ridge), ridge_regression(*given_, ridge), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8)
    weights, states, effects = random_list(seed + 1, d, n + 1, repeated)
    without = np.append(weights, -weights[0]), np.vstack([states, states[:1]]), np.vstack([effects, effects[:1]])
    others = weights[1:], states[1:], effects[1:]
    for found, expected in zip(linear_fit(*without, ridge), ridge_regression(*others, ridge), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-7)


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
@given(problems)
def test_what_a_fit_leaves_unexplained_is_the_narrower_mean_of_the_residuals(problem):
    seed, d, n, ridge = problem
    weights, states, effects = random_list(seed, d, n)
    intercept, slopes = linear_fit(weights, states, effects, ridge)
    near, at, found = np.random.default_rng(seed + 1).uniform(0.0, 1.0, n) ** 4, states[0], np.empty((2, d))
    # Reward and termination do not matter for effects.
    outcome = np.concatenate([[near.sum(), 7.0, 3.0], near @ states, near @ effects])
    effects_at(np.concatenate([intercept, slopes.reshape(-1)]), at, outcome, found)
    np.testing.assert_allclose(found[0], intercept + at @ slopes, atol=1e-12)
    residuals = effects - intercept - states @ slopes
    np.testing.assert_allclose(found[1], near @ residuals / (near.sum() + EXPLAINED_WEIGHT), atol=1e-9)
