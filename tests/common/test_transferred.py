"""Transferred instances that break the contract are refused: the message names the method and what would be right."""

import re

import numpy as np
import pytest

from sb3_combrel.common.transferred import TransferredInstances, check_transferred

N, N_VARIABLES, MAX_INSTANCES, THRESHOLD = 3, 2, 4, 1.0
OWN_WEIGHT = np.array([0.0, 0.4, 1.5])


class SomeMethod:
    """A transfer method, by name."""


def fine():
    """Two instances for the first pair, one for the second, none for the third; nothing beyond them may be read."""
    given = TransferredInstances(
        length=np.array([2, 1, 0, -5], dtype=np.int64),
        weight=np.full((N + 1, MAX_INSTANCES), np.nan),
        effect=np.full((N + 1, MAX_INSTANCES, N_VARIABLES), np.nan),
        reward=np.full((N + 1, MAX_INSTANCES), np.nan),
        terminated=np.zeros((N + 1, MAX_INSTANCES), dtype=np.bool_),
    )
    for row, weights in enumerate(([0.5, 0.5], [0.6])):
        n = len(weights)
        given.weight[row, :n], given.effect[row, :n], given.reward[row, :n] = weights, 0.1, -1.0
    return given


def check(given, threshold=THRESHOLD):
    check_transferred(given, SomeMethod(), OWN_WEIGHT, N_VARIABLES, threshold)


def refused(given, *parts):
    with pytest.raises(ValueError) as error:
        check(given)
    message = str(error.value)
    assert message.startswith("SomeMethod ")
    for part in parts:
        assert re.search(part, message), message


def changed(field, place, value):
    given = fine()
    getattr(given, field)[place] = value
    return given


def test_instances_that_keep_the_contract_are_accepted():
    check(fine())
    check(TransferredInstances.empty(N, N_VARIABLES))
    check(TransferredInstances.empty(N + 100, N_VARIABLES, 50))
    check(changed("length", 0, 0))
    check(changed("weight", (0, 0), 1e9))


def test_rounding_may_leave_the_threshold_just_below():
    check(changed("weight", (0, 0), 0.5 - 1e-12))
    refused(changed("weight", (0, 0), 0.5 - 1e-6), "row 0")


def test_weights_that_do_not_reach_the_threshold_are_refused():
    tiny = changed("weight", (0, slice(0, 2)), 1e-6)
    refused(tiny, "add up to 2e-06 for row 0", "with 0 of the target's own", "threshold of 1", "length must be 0")
    refused(changed("weight", (1, 0), 0.59), "0.59 for row 1", "with 0.4 of the target's own", "threshold of 1")
    check(tiny, threshold=1e-6)


@pytest.mark.parametrize("value", [0.0, -0.5, np.nan, np.inf])
def test_weights_that_are_not_finite_or_not_above_0_are_refused(value):
    refused(changed("weight", (0, 1), value), r"the weights \[.*\] for row 0", "must be finite and above 0")


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize(("field", "place"), [("effect", (1, 0, 1)), ("reward", (1, 0)), ("effect", (0, 1, 0))])
def test_effects_and_rewards_that_are_not_finite_are_refused(field, place, value):
    refused(changed(field, place, value), f"not finite for row {place[0]}", "effect or a reward")


@pytest.mark.parametrize("length", [-1, MAX_INSTANCES + 1, 10**9])
def test_lengths_beyond_the_room_for_instances_are_refused(length):
    refused(changed("length", 2, length), f"length={length} for row 2", "from 0 to 4")


def test_missing_rows_are_refused():
    refused(TransferredInstances(*(array[: N - 1].copy() for array in fine())), "2 rows", "asked for 3")


@pytest.mark.parametrize("field", TransferredInstances._fields)
def test_what_is_no_contiguous_array_of_the_right_type_is_refused(field):
    array = getattr(fine(), field)
    wrong = [np.zeros(array.shape, other) for other in (np.float32, np.int32, np.object_)] + [None, [[1.0]], 3.0]
    wrong += [np.asfortranarray(array)] if array.ndim > 1 else []
    for value in wrong:
        refused(fine()._replace(**{field: value}), f"{field} of type", f"must be a C-contiguous array of {array.dtype}")


@pytest.mark.parametrize(
    ("field", "shape"),
    [
        *[("length", (N + 1, 1)), ("length", (N,)), ("weight", (N + 1,)), ("effect", (N + 1, MAX_INSTANCES))],
        *[("effect", (N + 1, MAX_INSTANCES, N_VARIABLES + 1)), ("reward", (N + 1, MAX_INSTANCES - 1))],
        ("terminated", (N, MAX_INSTANCES)),
    ],
)
def test_arrays_of_shapes_that_do_not_fit_together_are_refused(field, shape):
    array = np.ones(shape, dtype=getattr(fine(), field).dtype)
    refused(fine()._replace(**{field: array}), rf"returned {field} of shape {re.escape(str(array.shape))}", "must be")


@pytest.mark.parametrize("given", [None, tuple(fine()), np.zeros(3)], ids=repr)
def test_what_is_not_transferred_instances_is_refused(given):
    refused(given, "must return TransferredInstances, got")
