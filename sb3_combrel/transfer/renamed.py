"""Arguments under former names: accepted for one version, with a warning."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def accept_renamed(names: Mapping[str, str]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """
    Make a function accept keyword arguments under former names as well.

    :param names: from former to present names
    :return: a decorator; the function's signature stays that of the present names
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def accepting(*args: Any, **kwargs: Any) -> R:
            for old in names.keys() & kwargs.keys():
                if names[old] in kwargs:
                    raise TypeError(f"{old} was renamed to {names[old]}: give one of them, not both")
                warn_of_name(old, names[old])
                kwargs[names[old]] = kwargs.pop(old)
            return function(*args, **kwargs)

        return accepting

    return decorate


def warn_of_name(old: str, new: str) -> None:
    """Warn that ``old`` is now called ``new``."""
    warnings.warn(f"{old} was renamed to {new}; the former name goes with the next version", DeprecationWarning, stacklevel=3)
