"""Bootstrap intervals, against slow computations, the whole distribution of draws, and simulations."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel.experiments import bootstrap
from sb3_combrel.experiments.bootstrap import bootstrap_band, bootstrap_difference, bootstrap_relative_difference

INF = np.inf
samples = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=9).map(np.array)
quick = settings(deadline=None, derandomize=True, max_examples=60)


def every_draw(sample, statistic):
    """The statistic of each of the n**n draws of n runs, which are equally likely."""
    return np.array([statistic(np.array(draw)) for draw in product(sample, repeat=len(sample))])


@pytest.mark.parametrize(
    ("name", "statistic"), [("mean", np.mean), ("median", np.median), ("iqm", lambda draw: stats.trim_mean(draw, 0.25))]
)
def test_bands_are_percentiles_of_all_draws(name, statistic):
    curves = np.random.default_rng(0).normal(size=(5, 3)) * [1.0, 10.0, 100.0]
    value, low, high = bootstrap_band(curves, name, n_resamples=20_000)
    for point in range(3):
        assert value[point] == pytest.approx(statistic(curves[:, point]))
        draws = every_draw(curves[:, point], statistic)
        # The share of draws beyond each bound is 2.5%, but for chance and for the steps of the distribution.
        assert (draws < low[point] - 1e-9).mean() <= 0.03 and (draws <= low[point] + 1e-9).mean() >= 0.02
        assert (draws > high[point] + 1e-9).mean() <= 0.03 and (draws >= high[point] - 1e-9).mean() >= 0.02


def test_bands_of_means_are_scipys():
    curves = np.random.default_rng(1).normal(size=(12, 4))
    ours = bootstrap_band(curves, n_resamples=20_000)
    theirs = stats.bootstrap((curves,), np.mean, n_resamples=20_000, method="percentile").confidence_interval
    np.testing.assert_allclose(ours.low, theirs.low, atol=0.05)
    np.testing.assert_allclose(ours.high, theirs.high, atol=0.05)


@quick
@given(samples, st.sampled_from(["mean", "median"]), st.integers(-100, 100))
def test_a_band_contains_its_mean_and_moves_with_the_samples(values, statistic, shift):
    value, low, high = bootstrap_band(values, statistic, n_resamples=400)
    assert low <= value + 1e-9 and value <= high + 1e-9
    np.testing.assert_allclose(bootstrap_band(values + shift, statistic, 400), np.array([value, low, high]) + shift, atol=1e-6)
    np.testing.assert_allclose(bootstrap_band(2.0 * values, statistic, 400), 2.0 * np.array([value, low, high]), atol=1e-6)
    assert values.min() - 1e-9 <= low and high <= values.max() + 1e-9


def test_the_same_seed_gives_the_same_band_also_in_blocks(monkeypatch):
    curves = np.random.default_rng(0).normal(size=(6, 20))
    band = bootstrap_band(curves, "iqm", 200, seed=4)
    np.testing.assert_array_equal(bootstrap_band(curves, "iqm", 200, seed=4), band)
    assert (bootstrap_band(curves, "iqm", 200, seed=5).low != band.low).any()
    monkeypatch.setattr(bootstrap, "BLOCK_SIZE", 200 * 6 * 3)
    np.testing.assert_allclose(bootstrap_band(curves, "iqm", 200, seed=4), band)


def test_all_points_share_the_draws_of_runs():
    curve = np.random.default_rng(0).normal(size=8)
    _, low, high = bootstrap_band(np.stack([curve, 2.0 * curve, 1.0 - curve], axis=1))
    np.testing.assert_allclose(low[1:], [2.0 * low[0], 1.0 - high[0]])


def test_runs_that_agree_have_a_band_of_no_width_and_one_run_has_none():
    band = bootstrap_band(np.full((7, 3), 0.1))
    np.testing.assert_array_equal(band.low, band.high)
    np.testing.assert_array_equal(band.low, band.mean)
    value, low, high = bootstrap_band(np.array([[3.0, 5.0]]))
    np.testing.assert_array_equal(value, [3.0, 5.0])
    assert np.isnan([low, high]).all()


def test_bands_of_steps_that_some_runs_never_needed():
    steps = np.array([[10.0, 10.0], [12.0, 12.0], [14.0, INF], [16.0, INF], [18.0, INF]])
    value, low, high = bootstrap_band(steps, "median")
    assert value.tolist() == [14.0, INF]
    assert np.isfinite([low[0], high[0]]).all() and np.isnan([low[1], high[1]]).all()


def test_the_band_contains_the_true_mean_as_often_as_its_description_says():
    samples = np.random.default_rng(0).normal(3.0, 2.0, size=(15, 1000))
    low, high = bootstrap_band(samples, n_resamples=1000)[1:]
    assert 0.90 <= np.mean((low <= 3.0) & (high >= 3.0)) <= 0.955, "93%"
    low, high = bootstrap_band(samples[:5], n_resamples=1000)[1:]
    assert 0.80 <= np.mean((low <= 3.0) & (high >= 3.0)) <= 0.88, "84%"


@pytest.mark.parametrize("statistic", ["mean", "median", "iqm"])
def test_the_interval_of_a_difference_contains_the_true_one_nearly_as_often_as_its_confidence(statistic):
    rng = np.random.default_rng(0)
    hits = 0
    for seed in range(400):
        first, second = rng.normal(10.0, 1.0, 20), rng.normal(7.0, 3.0, 20)
        _, low, high = bootstrap_difference(first, second, statistic, 400, seed)
        hits += low <= 3.0 <= high
    assert 0.90 <= hits / 400 <= 0.985


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
    assert (draws < low - 1e-9).mean() <= 0.03 and (draws <= low + 1e-9).mean() >= 0.02
    assert (draws > high + 1e-9).mean() <= 0.03 and (draws >= high - 1e-9).mean() >= 0.02


def test_medians_of_censored_steps():
    reached = np.array([10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0])
    one_never = np.append(reached[:-1], INF)
    value, low, high = bootstrap_difference(one_never, reached + 100.0, "median")
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


def test_a_single_run_has_a_difference_without_an_interval():
    value, low, high = bootstrap_difference(np.array([5.0]), np.array([1.0, 2.0]))
    assert value == 3.5 and np.isnan([low, high]).all()


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
