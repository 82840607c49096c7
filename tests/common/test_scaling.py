"""Box <-> unit coordinates."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_combrel.common.observations import ROUNDING, wider_bounds
from sb3_combrel.common.scaling import StateScaling

BOX = gym.spaces.Box(np.array([-1.2, -0.07]), np.array([0.6, 0.07]), dtype=np.float64)

finite = st.floats(-1e6, 1e6)


@settings(max_examples=30)
@given(hnp.arrays(np.float64, (7, 3), elements=finite), hnp.arrays(np.float64, 3, elements=finite), st.floats(1e-2, 1e6))
def test_raw_to_unit_and_back_changes_nothing(states, low, extent):
    scaling = StateScaling(low, low + extent)
    tolerance = 1e-9 * (np.abs(low).max() + extent + np.abs(states).max())
    np.testing.assert_allclose(scaling.to_raw(scaling.to_unit(states)), states, atol=tolerance)


def test_each_variable_is_divided_by_its_range():
    scaling = StateScaling.from_space(BOX)
    units = scaling.to_unit([[-1.2, -0.07], [0.6, 0.07], [-0.3, 0.0]])
    np.testing.assert_allclose(units, [[0, 0], [1, 1], [0.5, 0.5]], atol=1e-15)
    assert units.dtype == np.float64 and scaling.n_variables == 2
    # One state alone, and one outside the box: neither reshaped nor clipped.
    np.testing.assert_allclose(scaling.to_unit([2.4, 0.21]), [2.0, 2.0])


def test_scalings_of_equal_bounds_are_equal_and_cannot_be_changed():
    low = np.array([-1.2, -0.07])
    scaling = StateScaling(low, [0.6, 0.07])
    assert scaling == StateScaling.from_space(BOX) and hash(scaling) == hash(StateScaling.from_space(BOX))
    assert scaling != StateScaling(low, [0.6, 0.08])
    low[0] = 5.0
    assert scaling.low[0] == -1.2
    with pytest.raises(ValueError, match="read-only"):
        scaling.low[0] = 0.0


def test_bounds_replace_those_of_the_space_and_scalars_hold_for_all_variables():
    scaling = StateScaling.from_space(gym.make("CartPole-v1").observation_space, bounds=(-3, [1, 2, 3, 4]))
    np.testing.assert_array_equal(scaling.low, [-3, -3, -3, -3])
    np.testing.assert_array_equal(scaling.high, [1, 2, 3, 4])


def test_a_space_that_is_unbounded_or_as_large_as_the_largest_float_needs_bounds():
    huge = np.finfo(np.float32).max
    for space in (gym.make("CartPole-v1").observation_space, gym.spaces.Box(-huge, huge, (2,), np.float32)):
        with pytest.raises(ValueError, match=r"no finite bounds .*1.*bounds=\(low, high\)"):
            StateScaling.from_space(space)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        *[(7, "got bounds=7"), ((0,), r"got bounds=\(0,\)"), (([0, 1, 2], 3), r"low of shape \(3,\)")],
        *[((0, 0), "low=0.0 and high=0.0 for variable 0"), (([0, 2], [1, 1]), "low=2.0 and high=1.0 for variable 1")],
        ([(-1, 3), (0, 2)], r"got a pair for each variable, .*: pass bounds=\[\(-1.0, 0.0\), \(3.0, 2.0\)\]"),
        *[((np.nan, 1), "low of nan"), ((0, np.inf), "high of inf"), (([0, "a"], 3), "got bounds=")],
    ],
)
def test_wrong_bounds_are_named_with_their_value(bounds, message):
    with pytest.raises(ValueError, match=message) as caught:
        StateScaling.from_space(BOX, bounds)
    assert str(caught.value).startswith("bounds")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Discrete(3), "one-dimensional Box of floating-point numbers, got Discrete"),
        (gym.spaces.Dict({"x": BOX}), "FlattenObservation"),
        (gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), "images"),
        (gym.spaces.Box(0, 1, (2, 2)), r"shape \(2, 2\)"),
        (gym.spaces.Box(0, 9, (2,), np.int64), "dtype int64"),
    ],
)
def test_other_spaces_are_refused(space, message):
    with pytest.raises(ValueError, match=message):
        StateScaling.from_space(space)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        *[([0, 0], [1], "same length"), ([], [], "at least one"), ([[0]], [[1]], "one-dimensional")],
        *[([np.nan], [1], "low must hold finite"), ([1], [0], "below its upper bound")],
        *[([-1.5e308], [1.5e308], "overflows"), ("ab", [1], "low must be")],
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_wrong_vectors_are_refused(low, high, message):
    with pytest.raises(ValueError, match=message):
        StateScaling(low, high)


@given(st.floats(-1e3, 1e3), st.floats(1e-6, 1e6), st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_proposed_bounds_hold_what_was_observed_and_are_not_much_wider(low, width, below, above):
    given_bounds = StateScaling(np.array([low]), np.array([low + width]))
    observed = np.array([[low - below * width], [low + width + above * width]])
    [least], [most] = wider_bounds(given_bounds, observed)
    whole = (1.0 + below + above) * width
    allowed = 1.1 * ROUNDING * whole + 1e-9
    assert least <= observed[0, 0] + allowed and most >= observed[1, 0] - allowed
    assert most - least <= 1.03 * whole + 1e-9
    assert (least == low or below > 0.0) and (most == low + width or above > 0.0)


@pytest.mark.parametrize("value", [0.0, 3.0, -1e17, 1e25, 1e300])
def test_a_variable_that_never_changes_has_a_scale_however_large_it_is(value):
    scaling = StateScaling.from_observed((np.full(1, -np.inf), np.full(1, np.inf)), np.full((3, 1), value))
    assert scaling.low[0] < value < scaling.high[0]
