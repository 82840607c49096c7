"""Periodic state variables, such as angles: their bounds are one period apart, so that it is 1 in unit coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.compiled import inlined


@inlined
def difference(a, b, periodic):
    """a - b, two unit coordinates of one variable; of a periodic one the shortest way, in [-0.5, 0.5)."""
    apart = a - b
    if periodic:
        apart -= np.floor(apart + 0.5)
    return apart


def differences(a: NDArray[np.float64], b: NDArray[np.float64], periodic: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """:func:`difference` of arrays of states, shape (..., n_variables); ``periodic`` None: no variable is."""
    apart: NDArray[np.float64] = np.asarray(a - b)
    if periodic is None or not periodic.any():
        return apart
    return np.where(periodic, apart - np.floor(apart + 0.5), apart)


def periodic_flags(periodic: object, n_variables: int) -> tuple[bool, ...]:
    """The argument ``periodic`` as one bool for each state variable.

    :raises ValueError: if it is neither that nor None
    """
    if periodic is None:
        return (False,) * n_variables
    is_list = isinstance(periodic, Sequence | np.ndarray) and not isinstance(periodic, str)
    flags = list(periodic) if is_list else []  # type: ignore[call-overload]
    if len(flags) != n_variables or not all(isinstance(flag, bool | np.bool_) for flag in flags):
        raise ValueError(
            f"periodic must be None or {n_variables} booleans, one a state variable (True for an angle), got {periodic!r}"
        )
    return tuple(bool(flag) for flag in flags)


def check_periods(unbounded: NDArray[np.bool_]) -> None:
    """:raises ValueError: if a variable is periodic and has no bounds, shape (n_variables,), by which its period were known"""
    if unbounded.any():
        raise ValueError(
            f"periodic variables must have finite bounds, one period apart, got none for variable(s) "
            f"{np.flatnonzero(unbounded).tolist()}: pass bounds=(low, high), such as -numpy.pi and numpy.pi for an angle"
        )


def flag_array(periodic: Sequence[bool] | NDArray[np.bool_] | None, n_variables: int) -> NDArray[np.bool_]:
    """Return the flags as an array for compiled code; None: no variable is periodic."""
    return np.zeros(n_variables, dtype=np.bool_) if periodic is None else np.array(periodic, dtype=np.bool_)
