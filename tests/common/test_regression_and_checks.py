"""Local regression against least squares by NumPy, the nearest instances by sorting; and checks of arguments."""

import numpy as np
import pytest
from helpers.naive_local_linear import Fit
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.checks import as_count, check_count, count_text
from sb3_combrel.common.compiled import compiled
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import nearest_instances
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.regression import Kernel, LocalFit, fit_around, known_weight, number_at

repeatable = settings(deadline=None, derandomize=True, max_examples=40)
problems = st.tuples(st.integers(0, 10**6), st.integers(1, 5), st.integers(1, 60), st.integers(2, 30))


@compiled
def fit_and_predict(at, action, instances, kernel, fit, away, found):
    """Fit around a state; how many instances, their weight, and the numbers predicted ``away`` from there."""
    n = nearest_instances(instances, action, at, kernel.reach, fit.item, fit.distance)
    if n > 0:
        fit_around(at, action, n, instances, kernel, fit)
        for v in range(len(found)):
            found[v] = number_at(fit, v, away)
    return n, known_weight(fit, n, kernel)


def some_instances(seed, d, n, ends):
    """Instances of one action, some of them in the same state."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, d))
    states[rng.random(n) < 0.3] = states[0]
    effects, rewards = rng.normal(0.0, 0.3, (n, d)), rng.normal(size=n)
    return Instances.of_rows(1, np.zeros(n, dtype=int), states, effects, rewards, rng.random(n) < ends, rng.random(d) < 0.3)


@repeatable
@given(problems, st.sampled_from([0.0, 0.3, 1.0]), st.sampled_from([0.1, 0.3, 0.8]), st.sampled_from([0.05, 0.01, 0.3]))
def test_a_fit_is_that_of_least_squares_to_the_nearest_instances_within_reach(problem, ends, breadth, least):
    seed, d, n, n_neighbors = problem
    instances, rng = some_instances(seed, d, n, ends), np.random.default_rng(seed + 1)
    kernel = Kernel(-1.0 / breadth**2, -np.log(least), 3.0 * breadth**2, n_neighbors, 0.01)
    fit = LocalFit.empty(n_neighbors, d)
    for at in [*rng.uniform(-0.1, 1.1, (2, d)), instances.state[0, 0].copy()]:
        away, found = rng.normal(0.0, 0.1, d), np.empty(d + 1)
        length, weight = fit_and_predict(at, 0, instances, kernel, fit, away, found)
        apart = differences(instances.state[0, :n], at, instances.periodic)
        squared = (apart**2).sum(axis=1)
        nearest = [i for i in np.argsort(squared, kind="stable") if squared[i] <= kernel.reach][:n_neighbors]
        assert length == len(nearest)
        np.testing.assert_allclose(weight, np.exp(-squared[nearest] / breadth**2).sum(), rtol=1e-12)
        if length == 0:
            continue
        np.testing.assert_allclose(squared[fit.item[:length]], squared[nearest], rtol=1e-12)
        numbers = np.column_stack([instances.effect[0], instances.reward[0]])[nearest]
        some = apart[nearest], squared[nearest], numbers, instances.terminated[0, nearest]
        expected = Fit(*some, breadth, n_neighbors, least, prior=np.zeros((2, d)))
        np.testing.assert_allclose(found, expected.at(away), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(fit.solution[0, :-1], expected.mean, rtol=1e-8, atol=1e-9)


def test_predicted_numbers_stay_within_the_range_of_the_instances_and_ends_do_not_count_for_the_reward():
    states = np.linspace(0.0, 0.3, 4)[:, None]
    ended = np.array([False, False, False, True])
    instances = Instances.of_rows(1, np.zeros(4, dtype=int), states, states.copy(), np.array([-1.0, -1.0, -1.0, 100.0]), ended)
    kernel, fit, found = Kernel(-4.0, 3.0, 1.0, 10, 0.01), LocalFit.empty(10, 1), np.empty(2)
    for away, expected in ((0.0, 0.15), (0.1, 0.25), (5.0, 0.3), (-5.0, 0.0)):
        fit_and_predict(np.array([0.15]), 0, instances, kernel, fit, np.array([away]), found)
        np.testing.assert_allclose(found, [expected, -1.0], atol=2e-3)


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
