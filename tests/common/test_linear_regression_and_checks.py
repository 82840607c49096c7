"""Regression from sums against least squares by NumPy, on random lists of instances."""

import numpy as np
import pytest
from helpers.naive_local_linear import ridge_regression
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from sb3_combrel.common.checks import as_count, check_count, count_text
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


# Checks of arguments: what they accept, what they return, and what their messages name.
NO_COUNTS = [float("inf"), -float("inf"), float("nan"), 2.5, 1e308, True, np.bool_(True), "3", None, [3], 1j, 0, -4, 10**400]


@pytest.mark.parametrize("value", NO_COUNTS, ids=str)
def test_as_count_refuses_what_is_no_count_and_names_it(value):
    with pytest.raises(ValueError, match=r"n_things must be a whole number from 1 to 1,000 \(so many fit\), got "):
        as_count("n_things", value, max=1000, why_max="so many fit")


@settings(max_examples=30)
@given(st.integers(1, 2**53))
def test_as_count_converts_whole_floats(number):
    for written in (number, float(number), np.int64(number), np.float64(number)):
        count = as_count("n_things", written)
        assert count == number and type(count) is int


@pytest.mark.parametrize("value", [*NO_COUNTS[:-3], 3.0], ids=str)
def test_check_count_accepts_integers_only(value):
    with pytest.raises(ValueError, match="n_things must be a whole number of at least 1, got"):
        check_count("n_things", value)


def test_check_count_knows_its_limits():
    check_count("n_things", 0, min=0)
    check_count("n_things", np.int32(7), max=7)
    check_count("n_things", None, none_allowed=True)
    with pytest.raises(ValueError, match="n_things must be a whole number from 1 to 7 or None, got 8"):
        check_count("n_things", 8, max=7, none_allowed=True)


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0"), (1234567, "1,234,567"), (-1234, "-1,234"), (10**20, "about 10^20"), (-(10**500), "-about 10^500")],
)
def test_count_text_is_short_however_large_the_number(number, text):
    assert count_text(number) == text
