"""Checks of arguments: every message names the argument, its value and what would be right."""

import math
from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np


def check_positive(name: str, value: object, *, largest: float = float("inf")) -> None:
    """
    :raises ValueError: unless ``value`` is a number above 0 and not above ``largest``
    """
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) <= largest or not math.isfinite(value):
        limit = "" if largest == float("inf") else f" and at most {largest:g}"
        raise ValueError(f"{name} must be a number above 0{limit}, got {value!r}")


def check_finite(name: str, value: object) -> None:
    """
    :raises ValueError: unless ``value`` is a finite number
    """
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")


def check_count(name: str, value: object, *, least: int = 1, none_allowed: bool = False) -> None:
    """
    :raises ValueError: unless ``value`` is a whole number from ``least`` on (or None, where that is allowed)
    """
    if value is None and none_allowed:
        return
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        or_none = " or None" if none_allowed else ""
        raise ValueError(f"{name} must be a whole number of at least {least}{or_none}, got {value!r}")


def check_resolution(value: int | Sequence[int] | None, n_variables: int) -> None:
    """
    :raises ValueError: unless ``value`` is None, a whole number, or one for each state variable
    """
    if value is None:
        return
    each = [value] if isinstance(value, Integral) else value
    if isinstance(each, str) or not isinstance(each, Sequence | np.ndarray) or len(each) not in (1, n_variables):
        raise ValueError(f"resolution must be one whole number or {n_variables}, one a state variable, got {value!r}")
    for r in each:
        if isinstance(r, bool) or not isinstance(r, Integral) or not 1 <= int(r) <= 20:
            raise ValueError(f"resolution must be whole numbers from 1 to 20 (2**resolution cells), got {value!r}")
