"""Intervals and tests of experiments, against SciPy's own and simulations."""

import numpy as np
import pytest
from scipy import stats

from sb3_combrel.experiments.statistics import mean_of_runs, saving


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
