"""Effect sizes, against hand-computed examples, slow computations and simulations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.experiments.effect_sizes import cliffs_delta, hedges_g

samples = st.lists(st.integers(-20, 20).map(float), min_size=2, max_size=7).map(np.array)
with_infinite = st.lists(st.sampled_from([-np.inf, -1.0, 0.0, 3.0, np.inf]), min_size=1, max_size=7).map(np.array)
quick = settings(deadline=None, derandomize=True, max_examples=100)


def test_hedges_g_of_an_example():
    # Means 3 and 6, variances 1 and 4, 4 degrees of freedom: d = -3 / sqrt(2.5); Gamma(2) / (sqrt(2) Gamma(1.5)) = 0.797885.
    g = hedges_g(np.array([2.0, 3.0, 4.0]), np.array([4.0, 6.0, 8.0]))
    assert g == pytest.approx(-3 / np.sqrt(2.5) * 0.7978845608)


def test_hedges_g_is_unbiased_for_normal_samples():
    rng = np.random.default_rng(0)
    found = [hedges_g(rng.normal(5.0 + 2.0 * 0.8, 2.0, 4), rng.normal(5.0, 2.0, 6)) for _ in range(4000)]
    assert np.mean(found) == pytest.approx(0.8, abs=0.06), "without the correction it would be 0.89"


@quick
@given(samples, samples, st.integers(-50, 50), st.sampled_from([0.5, 2.0, 16.0]))
def test_hedges_g_has_no_unit_and_a_sign(first, second, shift, scale):
    g = hedges_g(first, second)
    assert hedges_g(second, first) == pytest.approx(-g)
    assert hedges_g(first * scale + shift, second * scale + shift) == pytest.approx(g)
    assert np.sign(g) == np.sign(round(first.mean() - second.mean(), 9)) or abs(g) < 1e-9


def test_hedges_g_without_spread_or_where_it_is_not_defined():
    assert hedges_g(np.full(3, 0.1), np.full(4, 0.1)) == 0.0
    assert hedges_g(np.full(3, 0.1), np.full(4, 0.3)) == -np.inf
    assert hedges_g(np.full(3, 0.3), np.full(4, 0.1)) == np.inf
    assert np.isnan(hedges_g(np.array([1.0]), np.array([2.0, 3.0])))
    assert np.isnan(hedges_g(np.array([1.0, np.inf]), np.array([2.0, 3.0])))


def test_cliffs_delta_of_examples():
    assert cliffs_delta(np.array([1.0, 2.0]), np.array([3.0, 4.0])) == -1.0
    assert cliffs_delta(np.array([1.0, 4.0, 5.0]), np.array([3.0, 4.0])) == pytest.approx((3 - 2) / 6)
    assert cliffs_delta(np.array([np.inf, np.inf]), np.array([np.inf, 4.0])) == 0.5, "two that never arrived are equal"


@quick
@given(with_infinite, with_infinite)
def test_cliffs_delta_counts_pairs(first, second):
    pairs = [1 if a > b else -1 if a < b else 0 for a in first for b in second]
    delta = cliffs_delta(first, second)
    assert delta == pytest.approx(np.mean(pairs))
    assert cliffs_delta(second, first) == pytest.approx(-delta)
    assert cliffs_delta(np.arctan(first), np.arctan(second)) == pytest.approx(delta), "any increasing function keeps it"


@pytest.mark.parametrize("effect_size", [hedges_g, cliffs_delta])
def test_what_is_no_sample_is_refused(effect_size):
    good = np.array([1.0, 2.0])
    with pytest.raises(ValueError, match=r"first.*NaN"):
        effect_size(np.array([1.0, np.nan]), good)
    with pytest.raises(ValueError, match=r"second.*shape"):
        effect_size(good, np.ones((2, 2)))
