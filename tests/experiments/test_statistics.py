"""Intervals and tests of experiments, against SciPy's own, simulations and slow computations."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel.experiments.statistics import (
    N_PERMUTATIONS,
    area_under_curve,
    as_sample,
    interquartile_mean,
    mean_of_runs,
    p_value_of_difference,
    saving,
    steps_to_reach,
)

few_whole = st.lists(st.integers(-9, 9), min_size=2, max_size=5)


def test_the_interval_of_a_mean_is_students():
    samples = np.random.default_rng(0).normal(5.0, 2.0, size=(7, 3))
    mean, low, high = mean_of_runs(samples)
    np.testing.assert_allclose(mean, samples.mean(axis=0))
    for column in range(3):
        interval = stats.ttest_1samp(samples[:, column], 0.0).confidence_interval(0.95)
        assert (low[column], high[column]) == pytest.approx((interval.low, interval.high))


def test_runs_that_agree_have_an_interval_of_no_width():
    mean, low, high = mean_of_runs(np.full((4, 2), 2000.0))
    np.testing.assert_array_equal([mean, low, high], 2000.0)


def test_a_single_run_has_a_mean_but_no_interval():
    mean, low, high = mean_of_runs(np.array([[3.0, 5.0]]))
    np.testing.assert_array_equal(mean, [3.0, 5.0])
    assert np.isnan([low, high]).all()


def test_a_saving_is_the_difference_of_the_means():
    saved = saving(np.array([100.0, 120.0, 110.0]), np.array([50.0, 60.0, 55.0]))
    assert saved.steps == pytest.approx(55.0)
    assert saved.share == pytest.approx(0.5)
    assert saved.low < 55.0 < saved.high
    assert 0.0 < saved.p_value < 0.05


def test_the_interval_of_a_saving_contains_the_true_value_as_often_as_its_confidence():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(1000):
        saved = saving(rng.normal(1000.0, 100.0, size=8), rng.normal(400.0, 20.0, size=8))
        hits += saved.low <= 600.0 <= saved.high
    assert 930 <= hits <= 970


@pytest.mark.parametrize(("without", "with_transfer"), [([60.0], [50.0]), ([60.0, 60.0], [50.0, 50.0])])
def test_runs_that_allow_no_test_still_have_a_difference(without, with_transfer):
    saved = saving(np.array(without), np.array(with_transfer))
    assert saved.steps == 10.0
    assert np.isnan([saved.low, saved.high, saved.p_value]).all()


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    np.testing.assert_allclose(interquartile_mean(np.array([-1000.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, np.inf])), 3.5)
    curves = np.random.default_rng(0).normal(size=(15, 4))
    np.testing.assert_allclose(interquartile_mean(curves), np.sort(curves, axis=0)[3:12].mean(axis=0))
    np.testing.assert_allclose(interquartile_mean(curves, axis=1), np.sort(curves, axis=1)[:, 1:3].mean(axis=1))
    np.testing.assert_allclose(interquartile_mean(np.array([1.0, 2.0, 9.0])), 4.0, err_msg="three runs: none is left out")


def test_areas_are_sums_of_rectangles():
    curves = np.array([[1.0, -2.0, 5.0], [0.0, 0.5, 1.0]])
    np.testing.assert_allclose(area_under_curve(curves), [4.0, 1.5])
    np.testing.assert_allclose(area_under_curve(curves, np.array([10.0, 1.0, 2.0])), [18.0, 2.5])
    np.testing.assert_allclose(area_under_curve(curves, np.array([[1, 1, 0], [4, 2, 3]])), [-1.0, 4.0])


@settings(deadline=None, derandomize=True, max_examples=60)
@given(few_whole, few_whole)
def test_a_permutation_test_of_few_runs_counts_every_regrouping(first, second):
    together = first + second
    differences = []
    for chosen in combinations(range(len(together)), len(first)):
        one = [together[i] for i in chosen]
        other = [together[i] for i in range(len(together)) if i not in chosen]
        # Whole numbers, without rounding: the difference of the means times both numbers of runs.
        differences.append(abs(sum(one) * len(other) - sum(other) * len(one)))
    own = abs(sum(first) * len(second) - sum(second) * len(first))
    expected = np.mean([difference >= own for difference in differences])
    assert p_value_of_difference(np.array(first), np.array(second), "permutation") == pytest.approx(expected)


def test_a_permutation_test_of_many_runs_agrees_with_scipys():
    rng = np.random.default_rng(0)
    for shift in (0.0, 0.5, 1.0):
        first, second = rng.normal(shift, 1.0, 14), rng.normal(0.0, 1.0, 15)

        def difference(one, other, axis):
            return one.mean(axis=axis) - other.mean(axis=axis)

        theirs = stats.permutation_test((first, second), difference, n_resamples=50_000, vectorized=True).pvalue
        ours = p_value_of_difference(first, second, "permutation", seed=3)
        assert ours == pytest.approx(theirs, abs=5 * np.sqrt(0.25 / N_PERMUTATIONS))
        assert ours == p_value_of_difference(first, second, "permutation", seed=3), "the same seed, the same value"
        assert ours == pytest.approx(p_value_of_difference(first * 1e6 + 1e9, second * 1e6 + 1e9, "permutation", seed=3))


def test_a_permutation_test_never_says_that_chance_is_impossible():
    far = p_value_of_difference(np.arange(20.0), np.arange(20.0) + 1e6, "permutation")
    assert far == 1 / (N_PERMUTATIONS + 1)
    assert p_value_of_difference(np.ones(3), np.zeros(3), "permutation") == pytest.approx(2 / 20), "2 of 20 regroupings"
    assert p_value_of_difference(np.ones(3), np.ones(3), "permutation") == 1.0
    assert np.isnan(p_value_of_difference(np.ones(1), np.zeros(3), "permutation"))


def test_a_permutation_test_errs_as_often_as_it_says():
    rng = np.random.default_rng(0)
    p_values = [p_value_of_difference(*rng.exponential(size=(2, 6)), "permutation") for _ in range(600)]
    assert 0.02 <= np.mean(np.array(p_values) <= 0.05) <= 0.08


def test_infinite_values_are_tested_by_mann_and_whitney():
    first, second = np.array([5.0, 7.0, np.inf]), np.array([1.0, 2.0, 3.0])
    assert p_value_of_difference(first, second, "permutation") == stats.mannwhitneyu(first, second).pvalue


@pytest.mark.parametrize(
    ("values", "message"), [([[1.0]], r"\(1, 1\)"), ([], r"\(0,\)"), ([1.0, np.nan, np.nan], "got 2 of 3")]
)
def test_values_that_are_no_sample_are_refused(values, message):
    with pytest.raises(ValueError, match=f"steps.*{message}"):
        as_sample("steps", np.array(values))


def test_a_curve_without_runs_has_no_area():
    with pytest.raises(ValueError, match=r"n_runs, n_points.*\(3,\)"):
        area_under_curve(np.ones(3))


def test_steps_to_reach_counts_up_to_the_end_of_the_first_good_window():
    steps = np.array([[400, 30, 400, 30, 30, 30], [400, 400, 400, 400, 400, 400]])
    np.testing.assert_array_equal(steps_to_reach(steps, 50, 3), [860, np.inf])
    np.testing.assert_array_equal(steps_to_reach(steps, 50, 7), [np.inf, np.inf])
