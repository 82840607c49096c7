"""Checks of what users give to the environments; errors name the argument, its value and what would be right."""

import numbers
import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any, SupportsIndex


def check_choice(name: str, value: Any, choices: Collection[str]) -> str:
    """Return ``value``; ``ValueError`` unless it is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")
    return value


def check_number(name: str, value: Any, right: str, fits: Callable[[float], bool]) -> float:
    """Return ``value`` as a float; ``ValueError`` unless it is a number and ``fits``, that is, is what ``right`` says."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not fits(float(value)):
        raise ValueError(f"{name} must be {right}, got {value!r}")
    return float(value)


def check_action(action: SupportsIndex, names: Sequence[str]) -> int:
    """Return the number of an action, any integer type, as an int; ``ValueError`` unless there is a name for it."""
    try:
        number = operator.index(action)
    except TypeError:
        number = -1
    if not 0 <= number < len(names):
        raise ValueError(f"action must be an integer from 0 to {len(names) - 1} ({', '.join(names)}), got {action!r}")
    return number
