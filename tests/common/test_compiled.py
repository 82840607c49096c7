"""A compiled function called with the same types every time."""

import copy
import gc
import pickle

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from sb3_combrel.common.compiled import SameTypes
from sb3_combrel.common.scaling import StateScaling, scale_into_box


def test_it_gives_what_the_function_gives_and_survives_copies():
    states = np.array([[0.5, 3.0], [-2.0, 1.0]])
    low, ranges = np.array([0.0, 1.0]), np.array([2.0, 4.0])
    scale = SameTypes(scale_into_box)
    for again in (scale, scale, copy.deepcopy(scale), pickle.loads(pickle.dumps(scale))):
        units, expected = np.empty_like(states), np.empty_like(states)
        assert again(states, low, ranges, units) == scale_into_box(states, low, ranges, expected)
        np.testing.assert_array_equal(units, expected)


def test_states_are_scaled_as_by_the_scaling_and_moved_into_the_box():
    scaling = StateScaling(np.array([-1.0, 0.0, 10.0]), np.array([1.0, 5.0, 11.0]))
    states = np.random.default_rng(0).uniform([-2.0, -1.0, 9.5], [2.0, 6.0, 11.5], (100, 3))
    units = np.empty_like(states)
    assert scale_into_box(states, scaling.low, scaling.high - scaling.low, units)
    np.testing.assert_array_equal(units, np.clip(scaling.to_unit(states), 0.0, 1.0))
    inside = scaling.to_raw(np.full((1, 3), 0.5))
    assert not scale_into_box(inside, scaling.low, scaling.high - scaling.low, units[:1])
    assert scale_into_box(np.full((1, 3), np.nan), scaling.low, scaling.high - scaling.low, units[:1])


@pytest.fixture
def collecting():
    """Garbage collection as tests expect it, whatever happens."""
    yield
    gc.enable()


@pytest.mark.parametrize("before", (True, False))
def test_no_garbage_is_collected_while_ours_is_compiled_and_then_as_before(collecting, monkeypatch, before):
    seen = []
    called = gc.disable
    monkeypatch.setattr(gc, "disable", lambda: (called(), seen.append(gc.isenabled())))
    if not before:
        called()

    def inner(x):
        return x + 1

    inner.__module__ = "sb3_combrel.inner"
    inner = njit(inner)

    def outer(x):
        return inner(x) * 2

    assert njit(outer)(1) == 4  # not ours, but what it calls is
    assert seen == [False] and gc.isenabled() == before
    outer.__module__ = "sb3_combrel.outer"
    assert njit(outer)(1.0) == 4.0
    assert seen == [False, False] and gc.isenabled() == before


def test_garbage_is_collected_again_when_ours_does_not_compile(collecting):
    def wrong(x):
        return x.nothing

    wrong.__module__ = "sb3_combrel.wrong"
    with pytest.raises(TypingError, match="nothing"):
        njit(wrong)(1)
    assert gc.isenabled()
