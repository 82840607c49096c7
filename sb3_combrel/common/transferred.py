"""What transfer methods give to the model: transferred instances, or predictions as a prior."""

import reprlib
from typing import NamedTuple

import numpy as np

ROUNDING = 1e-9


class TransferredInstances(NamedTuple):
    """Transferred instances for a number of state-action pairs, one pair a row (see ``Transfer.transferred``).

    Rows beyond those asked for are not read, nor are entries beyond a row's length: a transfer method may write to the
    same arrays at every call.

    :param length: int64, shape (n,): instances for each pair; 0 leaves the pair optimistic
    :param weight: float64, shape (n, max_instances): their kernel weights, above 0
    :param effect: float64, shape (n, max_instances, n_variables): predicted displacement, unit coordinates of the target
    :param reward: float64, shape (n, max_instances), raw
    :param terminated: bool, shape (n, max_instances): the instance ends the episode
    """

    length: np.ndarray
    weight: np.ndarray
    effect: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray

    @classmethod
    def empty(cls, n: int, n_variables: int, max_instances: int = 0) -> "TransferredInstances":
        """Make room for ``max_instances`` for each of ``n`` pairs; nothing is transferred to any."""
        return cls(
            length=np.zeros(n, dtype=np.int64),
            weight=np.zeros((n, max_instances)),
            effect=np.zeros((n, max_instances, n_variables)),
            reward=np.zeros((n, max_instances)),
            terminated=np.zeros((n, max_instances), dtype=np.bool_),
        )


class PriorPredictions(NamedTuple):
    """What a source predicts of n state-action pairs of the target (see ``Transfer.prior``). Unit coordinates of the target.

    Effects join the fits to the target's own instances; what is known, ends and rewards are the target's own.

    :param effect: float64, shape (n, n_variables): predicted displacement; 0 for variables of which it says nothing
    :param weight: float64, the same: as how many own instances at the very state it counts, at least 0
    """

    effect: np.ndarray
    weight: np.ndarray

    @classmethod
    def nothing(cls, n: int, n_variables: int) -> "PriorPredictions":
        """Say nothing of any of ``n`` pairs."""
        return cls(np.zeros((n, n_variables)), np.zeros((n, n_variables)))


def check_prior(given: PriorPredictions, method: object, n: int, n_variables: int) -> None:
    """Check what a transfer method predicts of ``n`` pairs before it joins any fit.

    :raises ValueError: if arrays have other shapes, a number is not finite, or a weight is below 0
    """
    name = type(method).__name__
    if not isinstance(given, PriorPredictions):
        raise ValueError(f"{name}.prior must return PriorPredictions, got {reprlib.repr(given)}")
    for field, array in zip(given._fields, given, strict=True):
        if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, np.floating):
            raise ValueError(f"{name}.prior returned {field} that is no array of floats, got {reprlib.repr(array)}")
        if array.shape != (n, n_variables):
            raise ValueError(f"{name}.prior returned {field} of shape {np.shape(array)}; it must be {(n, n_variables)}")
        wrong = ~np.isfinite(array) | ((array < 0.0) & (field == "weight"))
        if wrong.any():
            row = int(np.flatnonzero(wrong.any(axis=1))[0])
            least = ", and at least 0" if field == "weight" else ""
            raise ValueError(f"{name}.prior returned {field} {array[row]} for row {row}; it must be finite{least}")


_TYPES = tuple(map(np.dtype, (np.int64, np.float64, np.float64, np.float64, np.bool_)))


def check_transferred(
    given: TransferredInstances, method: object, own_weight: np.ndarray, n_variables: int, threshold: float
) -> None:
    """Check what a transfer method returned before compiled code reads it; the first row that is wrong is named.

    :param own_weight: of the target's own instances of each pair that was asked for, shape (n,)
    :param threshold: weight that own and transferred instances of a pair must reach together
    :raises ValueError: if rows are missing, arrays have other types or shapes, a value is not finite, a weight is not above
        0, or the weights of a pair do not reach the threshold
    """
    name, n = type(method).__name__, len(own_weight)
    _check_arrays(given, name, n, n_variables)
    length, room = given.length[:n], given.weight.shape[1]
    used = np.arange(room) < length[:, None]
    weight = np.where(used, given.weight[:n], 0.0)
    total = own_weight + weight.sum(axis=1)
    weighed = ((weight > 0.0) & (weight < np.inf)) | ~used
    finite = (np.isfinite(given.reward[:n]) & np.isfinite(given.effect[:n]).all(axis=2)) | ~used
    problems = np.stack(
        [
            (length < 0) | (length > room),
            ~weighed.all(axis=1),
            ~finite.all(axis=1),
            (length > 0) & (total < threshold * (1.0 - ROUNDING)),
        ]
    )
    if not problems.any():
        return
    row = int(problems.any(axis=0).argmax())
    weights = given.weight[row, : max(0, length[row])]
    messages = (
        f"length={length[row]} for row {row}; it must be from 0 to {room}, the room in weight",
        f"the weights {weights} for row {row}; they must be finite and above 0",
        f"an effect or a reward that is not finite for row {row}",
        f"weights that add up to {weights.sum():g} for row {row}, with {own_weight[row]:g} of the target's own instances; "
        f"together they must reach the threshold of {threshold:g}, or length must be 0",
    )
    raise ValueError(f"{name} returned {messages[problems[:, row].argmax()]}")


def _check_arrays(given: TransferredInstances, name: str, n: int, n_variables: int) -> None:
    if not isinstance(given, TransferredInstances):
        raise ValueError(f"{name} must return TransferredInstances, got {given!r}")
    for field, array, dtype in zip(given._fields, given, _TYPES, strict=True):
        if not isinstance(array, np.ndarray) or array.dtype != dtype or not array.flags.carray:
            kind = getattr(array, "dtype", type(array).__name__)
            raise ValueError(f"{name} returned {field} of type {kind}; it must be a C-contiguous array of {dtype}")
    shape = given.weight.shape
    if len(shape) != 2:
        raise ValueError(f"{name} returned weight of shape {shape}; it must be (number of pairs, max_instances)")
    expected = (shape[:1], shape, (*shape, n_variables), shape, shape)
    for field, array, wanted in zip(given._fields, given, expected, strict=True):
        if array.shape != wanted:
            raise ValueError(
                f"{name} returned {field} of shape {array.shape} with weight of shape {shape}; "
                f"with {n_variables} state variables it must be {wanted}"
            )
    if shape[0] < n:
        raise ValueError(f"{name} returned {shape[0]} rows, but was asked for {n}")
