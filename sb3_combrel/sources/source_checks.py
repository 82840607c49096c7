"""Checks of the fields of source instances; each returns an array of its own, or raises ``ValueError``."""

from __future__ import annotations

import reprlib

import numpy as np
from numpy.typing import NDArray


def finite_array(name: str, values: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """States or rewards: finite numbers of a certain shape, one row an instance."""
    try:
        if np.ma.is_masked(values):
            raise TypeError("some are masked")
        given = np.asarray(values)
        # NumPy would also convert text, dates and complex numbers.
        if given.dtype.kind not in "biufO":
            raise TypeError(f"{given.dtype} are no numbers")
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers of shape {shape}, got {reprlib.repr(values)}") from error
    if array.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, got {array.shape}")
    wrong = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))
    if wrong.size:
        raise ValueError(f"{name} must be finite, got {array[wrong[0]]} for instance {wrong[0]}")
    return array


def action_array(actions: object, n: int, n_actions: int) -> NDArray[np.int64]:
    """Actions of ``n`` instances: integers from 0 to ``n_actions - 1``."""
    array = np.array(actions)
    if array.shape != (n,) or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"actions must be integers of shape ({n},), got {array.dtype} of shape {array.shape}")
    if array.min() < 0 or array.max() >= n_actions:
        raise ValueError(f"actions must lie between 0 and n_actions - 1 = {n_actions - 1}, got {array.min()} to {array.max()}")
    return array.astype(np.int64)


def terminal_flags(terminated: object, n: int) -> NDArray[np.bool_]:
    """Whether each of ``n`` instances is terminal: booleans."""
    array = np.array(terminated)
    if array.shape != (n,) or array.dtype != np.bool_:
        raise ValueError(f"terminated must be booleans of shape ({n},), got {array.dtype} of shape {array.shape}")
    return array
