"""Checks of arguments: every message names the argument, its value and what would be right."""

import math
from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np


def check_positive(name: str, value: object, *, max: float = float("inf"), none_allowed: bool = False) -> None:
    """:raises ValueError: unless ``value`` is a number above 0 and not above ``max`` (or None, where that is allowed)"""
    if value is None and none_allowed:
        return
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) <= max or not math.isfinite(value):
        limit = "" if max == float("inf") else f" and at most {max:g}"
        raise ValueError(f"{name} must be a number above 0{limit}, got {value!r}")


def check_finite(name: str, value: object, *, min: float = -math.inf) -> None:
    """:raises ValueError: unless ``value`` is a finite number, of at least ``min``"""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    if value < min:
        raise ValueError(f"{name} must be at least {min:g}, got {value!r}")


def check_boolean(name: str, value: object) -> None:
    """:raises ValueError: unless ``value`` is True or False"""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def check_count(
    name: str, value: object, *, min: int = 1, max: int | None = None, none_allowed: bool = False, why_max: str = ""
) -> None:
    """:param why_max: the reason for ``max``, for the message, such as "more cannot be kept in memory"
    :raises ValueError: unless ``value`` is a whole number from ``min`` to ``max`` (or None, where that is allowed)
    """
    if value is None and none_allowed:
        return
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or value < min or (max is not None and value > max):  # type: ignore[operator]
        limit = f"of at least {min}" if max is None else f"from {min} to {max:,}"
        reason = f" ({why_max})" if max is not None and why_max else ""
        or_none = " or None" if none_allowed else ""
        given = count_text(int(value)) if is_whole else repr(value)  # type: ignore[call-overload]
        raise ValueError(f"{name} must be a whole number {limit}{reason}{or_none}, got {given}")


def as_count(name: str, value: object, *, min: int = 1, max: int | None = None, why_max: str = "") -> int:
    """A whole number that may have been written as a float, such as 1e5; for the parameters see :func:`check_count`.

    :return: the value as an int
    :raises ValueError: unless it is a whole number from ``min`` to ``max``
    """
    if isinstance(value, float | np.floating) and float(value).is_integer():
        value = int(value)
    check_count(name, value, min=min, max=max, why_max=why_max)
    return int(value)  # type: ignore[call-overload]


def count_text(number: int) -> str:
    """A whole number with separators, or, of more than 15 digits, as a power of ten: Python refuses to write out too many."""
    if abs(number) < 10**15:
        return f"{number:,}"
    return f"{'-' if number < 0 else ''}about 10^{math.log10(abs(number)):.0f}"


def check_resolution(value: int | Sequence[int] | None, n_variables: int) -> None:
    """:raises ValueError: unless ``value`` is None, a whole number, or one for each state variable"""
    if value is None:
        return
    each = [value] if isinstance(value, Integral) else value
    if isinstance(each, str) or not isinstance(each, Sequence | np.ndarray) or len(each) not in (1, n_variables):
        raise ValueError(f"resolution must be one whole number or {n_variables}, one a state variable, got {value!r}")
    for r in each:
        if isinstance(r, bool) or not isinstance(r, Integral) or not 1 <= int(r) <= 20:
            raise ValueError(f"resolution must be whole numbers from 1 to 20 (2**resolution cells), got {value!r}")


def checked_names(argument: str, names: Sequence[str], n: int, letter: str) -> tuple[str, ...]:
    """Names of ``n`` variables or actions; if none are given, the letter and a number.

    :raises ValueError: unless there is one for each, all different
    """
    is_list = isinstance(names, Sequence | np.ndarray) and not isinstance(names, str)
    if not is_list or len(names) not in (0, n):
        raise ValueError(f"{argument} must hold {n} names or none, got {names!r}")
    texts = tuple(map(str, names)) if len(names) else tuple(f"{letter}{k}" for k in range(n))
    if len(set(texts)) < n:
        raise ValueError(f"{argument} must be different names, got {texts}")
    return texts
