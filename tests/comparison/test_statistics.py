"""Statistics of runs, against SciPy's own, slow computations, whole distributions of draws, and simulations."""

from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel.comparison.statistics import (
    N_PERMUTATIONS,
    as_sample,
    bootstrap_band,
    bootstrap_difference,
    bootstrap_relative_difference,
    cliffs_delta,
    holm,
    interquartile_mean,
    mean_of_runs,
    p_value_of_difference,
    saving,
    smallest_p_value,
)

INF = np.inf
few_whole = st.lists(st.integers(-9, 9), min_size=2, max_size=5)
samples = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=9).map(np.array)
with_infinite = st.lists(st.sampled_from([-np.inf, -1.0, 0.0, 3.0, np.inf]), min_size=1, max_size=7).map(np.array)
quick = settings(deadline=None, derandomize=True, max_examples=40)


def test_the_interval_of_a_mean_is_students():
    samples = np.random.default_rng(0).normal(5.0, 2.0, size=(7, 3))
    mean, low, high = mean_of_runs(samples)
    np.testing.assert_allclose(mean, samples.mean(axis=0))
    for column in range(3):
        interval = stats.ttest_1samp(samples[:, column], 0.0).confidence_interval(0.95)
        assert (low[column], high[column]) == pytest.approx((interval.low, interval.high))
    assert np.isnan(mean_of_runs(samples[:1])[1:]).all(), "a single run has none"
    np.testing.assert_array_equal(mean_of_runs(np.full((4, 2), 2000.0)), 2000.0)
    saved = saving(np.array([100.0, 120.0, 110.0]), np.array([50.0, 60.0, 55.0]))
    assert (saved.steps, saved.share) == pytest.approx((55.0, 0.5))
    assert saved.low < 55.0 < saved.high and 0.0 < saved.p_value < 0.05


@pytest.mark.parametrize(("without", "with_transfer"), [([60.0], [50.0]), ([60.0, 60.0], [50.0, 50.0])])
def test_runs_that_allow_no_test_still_have_a_difference(without, with_transfer):
    saved = saving(np.array(without), np.array(with_transfer))
    assert saved.steps == 10.0 and np.isnan([saved.low, saved.high, saved.p_value]).all()


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    np.testing.assert_allclose(interquartile_mean(np.array([-1000.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, np.inf])), 3.5)
    curves = np.random.default_rng(0).normal(size=(15, 4))
    np.testing.assert_allclose(interquartile_mean(curves), np.sort(curves, axis=0)[3:12].mean(axis=0))
    np.testing.assert_allclose(interquartile_mean(curves, axis=1), np.sort(curves, axis=1)[:, 1:3].mean(axis=1))
    np.testing.assert_allclose(interquartile_mean(np.array([1.0, 2.0, 9.0])), 4.0, err_msg="three runs: none is left out")


@quick
@given(few_whole, few_whole)
def test_a_permutation_test_of_few_runs_counts_every_regrouping(first, second):
    together, differences = first + second, []
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
    assert p_value_of_difference(np.arange(20.0), np.arange(20.0) + 1e6, "permutation") == 1 / (N_PERMUTATIONS + 1)
    assert p_value_of_difference(np.ones(3), np.zeros(3), "permutation") == pytest.approx(2 / 20), "2 of 20 regroupings"
    assert p_value_of_difference(np.ones(3), np.ones(3), "permutation") == 1.0
    assert np.isnan(p_value_of_difference(np.ones(1), np.zeros(3), "permutation"))


def test_other_tests_are_scipys_and_defined_where_means_are_not():
    first, second, never = np.array([1.0, 2.0, 4.0, 3.0]), np.array([5.0, 2.5, 6.0]), np.array([np.inf, 5.0, 6.0])
    assert p_value_of_difference(first, second) == stats.ttest_ind(first, second, equal_var=False).pvalue
    exact = stats.mannwhitneyu(first, second, method="exact").pvalue
    assert p_value_of_difference(first, second, "mann-whitney") == pytest.approx(exact)
    for test in ("welch", "permutation"):
        assert p_value_of_difference(first, never, test) == p_value_of_difference(first, never, "mann-whitney")
        assert p_value_of_difference(np.ones(3), np.ones(4), test) == 1.0
        assert np.isnan(p_value_of_difference(first[:1], second, test))
    for n in range(2, 6):
        tied, none = np.full(n, 5.0), np.full(n, np.inf)
        for test, other in (("mann-whitney", none), ("welch", none), ("welch", np.zeros(n)), ("permutation", none)):
            assert p_value_of_difference(tied, other, test) == pytest.approx(smallest_p_value(n, n, 1)), (n, test)
    assert np.isnan(p_value_of_difference(first * np.nan, second))
    with pytest.raises(ValueError, match="test"):
        p_value_of_difference(first, second, "student")


@pytest.mark.parametrize(
    ("values", "message"), [([[1.0]], r"\(1, 1\)"), ([], r"\(0,\)"), ([1.0, np.nan, np.nan], "got 2 of 3")]
)
def test_values_that_are_no_sample_are_refused(values, message):
    with pytest.raises(ValueError, match=f"steps.*{message}"):
        as_sample("steps", np.array(values))


def every_draw(sample, statistic):
    """The statistic of each of the n**n draws of n runs, which are equally likely."""
    return np.array([statistic(np.array(draw)) for draw in product(sample, repeat=len(sample))])


@pytest.mark.parametrize(
    ("name", "statistic"), [("mean", np.mean), ("median", np.median), ("iqm", lambda draw: stats.trim_mean(draw, 0.25))]
)
def test_bands_are_percentiles_of_all_draws(name, statistic):
    curves = np.random.default_rng(0).normal(size=(5, 2)) * [1.0, 10.0]
    value, low, high = bootstrap_band(curves, name, n_resamples=20_000)
    for point in range(2):
        assert value[point] == pytest.approx(statistic(curves[:, point]))
        draws = every_draw(curves[:, point], statistic)
        # The share of draws beyond each bound is 2.5%, but for chance and for the steps of the distribution.
        assert (draws < low[point] - 1e-9).mean() <= 0.03 and (draws <= low[point] + 1e-9).mean() >= 0.02
        assert (draws > high[point] + 1e-9).mean() <= 0.03 and (draws >= high[point] - 1e-9).mean() >= 0.02


@quick
@given(samples, st.sampled_from(["mean", "median"]), st.integers(-100, 100))
def test_a_band_contains_its_mean_and_moves_with_the_samples(values, statistic, shift):
    value, low, high = bootstrap_band(values, statistic, n_resamples=400)
    assert low <= value + 1e-9 and value <= high + 1e-9
    np.testing.assert_allclose(bootstrap_band(values + shift, statistic, 400), np.array([value, low, high]) + shift, atol=1e-6)
    np.testing.assert_allclose(bootstrap_band(2.0 * values, statistic, 400), 2.0 * np.array([value, low, high]), atol=1e-6)
    assert values.min() - 1e-9 <= low and high <= values.max() + 1e-9


def test_all_points_share_the_draws_of_runs():
    curve = np.random.default_rng(0).normal(size=8)
    _, low, high = bootstrap_band(np.stack([curve, 2.0 * curve, 1.0 - curve], axis=1))
    np.testing.assert_allclose(low[1:], [2.0 * low[0], 1.0 - high[0]])


def test_runs_that_agree_have_a_band_of_no_width_and_one_run_has_none():
    band = bootstrap_band(np.full((7, 3), 0.1))
    np.testing.assert_array_equal(band.low, band.high)
    np.testing.assert_allclose(band.low, band.mean)
    value, low, high = bootstrap_band(np.array([[3.0, 5.0]]))
    np.testing.assert_array_equal(value, [3.0, 5.0])
    assert np.isnan([low, high]).all()


def test_bands_of_steps_that_some_runs_never_needed():
    steps = np.array([[10.0, 10.0], [12.0, 12.0], [14.0, INF], [16.0, INF], [18.0, INF]])
    value, low, high = bootstrap_band(steps, "median")
    assert value.tolist() == [14.0, INF]
    assert np.isfinite([low[0], high[0]]).all() and np.isnan([low[1], high[1]]).all()


@quick
@given(samples, samples, st.sampled_from(["mean", "median", "iqm"]), st.integers(-100, 100))
def test_differences_have_a_sign_and_do_not_depend_on_a_common_shift(first, second, statistic, shift):
    value, low, high = bootstrap_difference(first, second, statistic, 400)
    assert bootstrap_difference(second, first, statistic, 400).value == pytest.approx(-value, abs=1e-9)
    np.testing.assert_allclose(
        bootstrap_difference(first + shift, second + shift, statistic, 400), (value, low, high), atol=1e-6
    )
    np.testing.assert_allclose(
        bootstrap_difference(first + shift, second, statistic, 400), np.array([value, low, high]) + shift, atol=1e-6
    )
    assert low <= high


def test_bounds_are_percentiles_of_all_pairs_of_draws():
    first, second = np.array([1.0, 5.0, 6.0, 20.0]), np.array([2.0, 2.5, 9.0])
    draws = (every_draw(first, np.mean)[:, None] - every_draw(second, np.mean)).ravel()
    value, low, high = bootstrap_difference(first, second, n_resamples=20_000)
    assert value == pytest.approx(8.0 - 4.5)
    assert np.isnan(bootstrap_difference(first[:1], second)[1:]).all(), "of a single run there is no interval"
    assert (draws < low - 1e-9).mean() <= 0.03 and (draws <= low + 1e-9).mean() >= 0.02
    assert (draws > high + 1e-9).mean() <= 0.03 and (draws >= high - 1e-9).mean() >= 0.02


def test_medians_of_censored_steps():
    reached = np.array([10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0])
    value, low, high = bootstrap_difference(np.append(reached[:-1], INF), reached + 100.0, "median")
    assert value == -100.0 and np.isfinite([low, high]).all()
    # Four of nine: the median is finite, yet in many draws it is not, so nothing bounds the difference from above.
    four_never = np.append(reached[:5], np.full(4, INF))
    value, low, high = bootstrap_difference(four_never, reached, "median")
    assert value == 0.0 and np.isfinite(low) and high == INF
    # Both: infinity minus infinity might be anything.
    value, low, high = bootstrap_difference(four_never, four_never, "median")
    assert (value, low, high) == (0.0, -INF, INF)


def test_half_of_the_runs_censored_leaves_no_interval():
    reached, half_never = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 2.0, INF, INF])
    value, low, high = bootstrap_difference(reached, half_never, "median")
    assert value == -INF and np.isnan([low, high]).all()
    value, low, high = bootstrap_difference(half_never, half_never, "median")
    assert np.isnan([value, low, high]).all()
    assert np.isnan(bootstrap_difference(np.array([1.0, INF, 2.0]), reached).low), "one is enough for a mean"


def test_relative_differences():
    first, second = np.array([12.0, 18.0]), np.array([8.0, 10.0, 12.0])
    draws = (every_draw(first, np.mean)[:, None] / every_draw(second, np.mean) - 1.0).ravel()
    value, low, high = bootstrap_relative_difference(first, second, n_resamples=20_000)
    assert value == pytest.approx(0.5)
    assert (draws < low - 1e-9).mean() <= 0.03 and (draws <= low + 1e-9).mean() >= 0.02
    assert (draws > high + 1e-9).mean() <= 0.03 and (draws >= high - 1e-9).mean() >= 0.02
    np.testing.assert_allclose(bootstrap_relative_difference(first * 7.0, second * 7.0, 20_000), (value, low, high))


def test_relative_to_nothing_there_is_no_ratio():
    nothing, some = np.zeros(3), np.array([1.0, 2.0])
    assert bootstrap_relative_difference(some, nothing).value == INF
    assert np.isnan(bootstrap_relative_difference(nothing, nothing).value)
    assert np.isnan(bootstrap_relative_difference(some, nothing).low)
    assert bootstrap_relative_difference(nothing, some).value == -1.0
    # One run of three without transfer got anything: a draw may have none, so the ratio has no upper bound.
    assert bootstrap_relative_difference(some, np.array([0.0, 0.0, 3.0])).high == INF


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bootstrap_band(np.ones((2, 3, 4))), r"samples.*\(2, 3, 4\)"),
        (lambda: bootstrap_band(np.ones((0, 3))), r"samples.*\(0, 3\)"),
        (lambda: bootstrap_band(np.array([[1.0, np.nan]])), "samples.*NaN.*1 of 2"),
        (lambda: bootstrap_band(np.ones(3), "mode"), "statistic.*mean, median, iqm.*'mode'"),
        (lambda: bootstrap_band(np.ones(3), n_resamples=10), "n_resamples.*40.*10"),
        (lambda: bootstrap_difference(np.ones(3), np.ones(3), "mode"), "statistic.*'mode'"),
        (lambda: bootstrap_difference(np.ones(3), np.array([1.0, np.nan])), "second.*NaN"),
        (lambda: bootstrap_relative_difference(np.ones(3), np.array([1.0, -2.0])), "second.*below 0.*-2"),
        (lambda: bootstrap_relative_difference(np.array([]), np.ones(2)), "first.*shape"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@quick
@given(with_infinite, with_infinite)
def test_cliffs_delta_counts_pairs(first, second):
    pairs = [1 if a > b else -1 if a < b else 0 for a in first for b in second]
    delta = cliffs_delta(first, second)
    assert delta == pytest.approx(np.mean(pairs)) and cliffs_delta(second, first) == pytest.approx(-delta)
    assert cliffs_delta(np.arctan(first), np.arctan(second)) == pytest.approx(delta), "any increasing function keeps it"


@pytest.mark.parametrize(("n_first", "n_second"), [(2, 2), (3, 3), (4, 4), (2, 5), (3, 4)])
def test_the_smallest_p_value_is_that_of_the_most_extreme_groups(n_first, n_second):
    values = np.arange(n_first + n_second, dtype=float) ** 1.3
    observed = abs(values[:n_first].mean() - values[n_first:].mean())
    apart = [
        abs(values[list(group)].mean() - np.delete(values, list(group)).mean())
        for group in combinations(range(len(values)), n_first)
    ]
    assert smallest_p_value(n_first, n_second, 1) <= np.mean(np.array(apart) >= observed - 1e-12)
    assert smallest_p_value(1, 5, 1) == 1.0


def test_holms_correction_multiplies_by_the_number_of_tests_left_and_keeps_the_order():
    found = holm({"a": 0.01, "b": 0.04, "none": np.nan, "c": 0.03})
    assert found == pytest.approx({"a": 0.03, "c": 0.06, "b": 0.06, "none": np.nan}, nan_ok=True)
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0} and holm({}) == {}
