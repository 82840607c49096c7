"""Periodic variables: differences the short way around, observations that are wrapped, and flags that are refused."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from sb3_combrel.common.instances import BLOCK
from sb3_combrel.common.kernels import any_periodic, measure_gaps, squared_distance
from sb3_combrel.common.observations import ObservationScaler
from sb3_combrel.common.periodic import difference, differences, periodic_flags
from sb3_combrel.common.scaling import StateScaling

repeatable = settings(deadline=None, derandomize=True, max_examples=30)
coordinates = st.floats(-3.0, 3.0)
ANGLE_AND_SPEED = StateScaling([-np.pi, -8.0], [np.pi, 8.0])


@njit
def difference_of(a, b, periodic):
    return difference(a, b, periodic)


@njit
def squared_distance_of(a, b, periodic):
    return squared_distance(a, b, periodic, any_periodic(periodic))


@njit
def gaps_of(state, low, high, periodic, n_blocks, gap):
    measure_gaps(state, low, high, periodic, n_blocks, gap)


@repeatable
@given(coordinates, coordinates)
def test_a_difference_goes_the_short_way_around_a_period_of_1(a, b):
    found = difference_of(a, b, True)
    assert -0.5 - 1e-12 <= found <= 0.5
    assert abs(found - (a - b) - np.rint(found - (a - b))) < 1e-12, "whole periods are left out, nothing else"
    assert difference_of(a, b, False) == a - b
    assert differences(np.array([a, a]), np.array([b, b]), np.array([True, False])).tolist() == [found, a - b]


def test_half_a_period_apart_and_tiny_differences():
    assert difference_of(0.75, 0.25, True) == difference_of(0.25, 0.75, True) == -0.5
    assert difference_of(0.3 - 1e-17, 0.3, True) == (0.3 - 1e-17) - 0.3
    assert difference_of(0.0, 1e-20, True) == -1e-20, "no digits are lost"


@repeatable
@given(st.integers(0, 10**6), st.integers(1, 3))
def test_no_instance_is_nearer_than_the_box_of_its_block(seed, d):
    rng = np.random.default_rng(seed)
    periodic, n_blocks = rng.random(d) < 0.7, 4
    states = rng.uniform(0.0, 1.0, d) + rng.normal(0.0, 0.3, (n_blocks, BLOCK, d))
    states = np.where(periodic, states % 1.0, states)
    low, high = (np.ascontiguousarray(edge(states, axis=1).T) for edge in (np.min, np.max))
    gap = np.empty(n_blocks)
    for state in rng.uniform(-1.0, 2.0, (5, d)):
        gaps_of(state, low, high, periodic, n_blocks, gap)
        for block in range(n_blocks):
            # The box, point by point along each variable: the sum of the least squares is its distance.
            apart = []
            for k in range(d):
                inside = np.linspace(low[k, block], high[k, block], 501)
                turns = range(-3, 4) if periodic[k] else (0,)
                apart.append(min(np.abs(state[k] - inside - turn).min() for turn in turns))
            assert gap[block] == pytest.approx(np.square(apart).sum(), abs=5e-3)
            nearest = min(squared_distance_of(state, one, periodic) for one in states[block])
            assert gap[block] <= nearest + 1e-12


@repeatable
@given(st.floats(-50.0, 50.0), st.integers(-3, 3))
def test_an_angle_is_wrapped_without_a_warning(angle, turns):
    scale = ObservationScaler(ANGLE_AND_SPEED, [True, False])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        unit = scale(np.array([angle + 2 * np.pi * turns, 0.0]))
    assert 0.0 <= unit[0] <= 1.0 and unit[1] == 0.5
    assert np.cos(ANGLE_AND_SPEED.to_raw(unit)[0]) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(ANGLE_AND_SPEED.to_raw(unit)[0]) == pytest.approx(np.sin(angle), abs=1e-9)


def test_what_is_not_periodic_is_moved_to_the_boundary_with_a_warning_and_what_is_not_finite_is_refused():
    scale = ObservationScaler(ANGLE_AND_SPEED, [True, False])
    with pytest.warns(UserWarning, match="outside the bounds"):
        np.testing.assert_allclose(scale(np.array([[1.5 * np.pi, 9.0]])), [[0.25, 1.0]])
    for wrong in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="not finite"):
            scale(np.array([wrong, 0.0]))


@pytest.mark.parametrize("flags", [True, [True], [True, False, True], [1, 0], "TF", [None, True], np.array([0.0, 1.0])])
def test_wrong_flags_are_named_with_their_value(flags):
    with pytest.raises(ValueError, match="periodic must be None or 2 booleans") as caught:
        periodic_flags(flags, 2)
    assert repr(flags) in str(caught.value)


def test_flags_come_as_a_sequence_an_array_or_none():
    assert periodic_flags(None, 2) == (False, False)
    assert periodic_flags((True, False), 2) == periodic_flags(np.array([True, False]), 2) == (True, False)
