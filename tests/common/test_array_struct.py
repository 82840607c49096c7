"""Structs of arrays, as Python and as compiled code see them."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import SameTypes, compiled, inner


class Part(ArrayStruct):
    """Named like what a struct might keep for itself."""

    table: np.ndarray
    address: np.ndarray


class Whole(ArrayStruct):
    """A struct with a struct between arrays of several types and numbers of axes."""

    flags: np.ndarray
    part: Part
    cube: np.ndarray
    count: np.ndarray


def make(shape=(2, 3, 4)):
    size = int(np.prod(shape))
    part = Part(table=np.arange(5, dtype=np.int32), address=np.linspace(0.0, 1.0, 7))
    cube = np.arange(size, dtype=np.float64).reshape(shape)
    return Whole(flags=np.array([True, False]), part=part, cube=cube, count=np.zeros(1, dtype=np.int64))


@compiled
def shape_of(whole):
    return whole.cube.shape, len(whole.part.table), whole.part.address.shape[0], len(whole.flags)


@inner
def sum_row(row):
    total = 0.0
    for k in range(len(row)):
        total += row[k]
    return total


@compiled
def sums(whole, out):
    """Sums of the cube's rows, by way of views; the arrays around it are written to."""
    for i in range(whole.cube.shape[0]):
        for j in range(whole.cube.shape[1]):
            out[i, j] = sum_row(whole.cube[i, j])
            for k in range(whole.cube.shape[2]):
                whole.cube[i, j, k] += 1.0
            whole.count[0] += 1
    whole.part.table[4] = 40
    whole.flags[1] = whole.flags[0]


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.integers(0, 5)] * 3))
def test_compiled_code_sees_all_arrays_and_writes_to_them(shape):
    whole = make(shape)
    before, out = whole.cube.copy(), np.full(shape[:2], np.nan)
    assert shape_of(whole) == (shape, 5, 7, 2)
    sums(whole, out)
    np.testing.assert_array_equal(out, before.sum(axis=2))
    np.testing.assert_array_equal(whole.cube, before + 1.0)
    assert whole.count[0] == shape[0] * shape[1]
    assert whole.part.table.tolist() == [0, 1, 2, 3, 40]
    assert whole.flags.tolist() == [True, True]


def test_a_function_for_the_same_types_takes_other_structs():
    of_one_type = SameTypes(shape_of)
    assert of_one_type(make((2, 3, 4)))[0] == (2, 3, 4)
    assert of_one_type(make((6, 1, 2)))[0] == (6, 1, 2)


def test_another_array_makes_another_struct():
    whole = make()
    other = whole.replace(cube=np.ones((1, 2, 3)))
    assert shape_of(whole)[0] == (2, 3, 4)
    assert shape_of(other)[0] == (1, 2, 3)
    assert other.part is whole.part
    with pytest.raises(AttributeError):
        whole.cube = np.ones((1, 2, 3))
    with pytest.raises(TypeError, match="cubes"):
        whole.replace(cubes=np.ones((1, 2, 3)))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda whole: pickle.loads(pickle.dumps(whole))])
def test_a_copy_has_arrays_of_its_own(copied):
    whole = make()
    other = copied(whole)
    sums(other, np.empty((2, 3)))
    assert other.count[0] == 6
    np.testing.assert_array_equal(other.cube, whole.cube + 1.0)
    assert whole.count[0] == 0
    assert whole.part.table[4] == 4


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cube", np.ones((2, 3))),
        ("cube", np.ones((2, 3, 4), dtype=np.float32)),
        ("cube", np.ones((2, 3, 8))[:, :, ::2]),
        ("cube", np.asfortranarray(np.ones((2, 3, 4)))),
        ("cube", np.broadcast_to(1.0, (2, 3, 4))),
        ("cube", [[[1.0]]]),
        ("part", np.ones(3)),
        ("flags", make()),
    ],
)
def test_what_compiled_code_would_misread_is_refused(name, value):
    with pytest.raises(TypeError, match=rf"Whole\.{name} must be"):
        make().replace(**{name: value})
