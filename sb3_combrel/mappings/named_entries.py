"""Entries of a mapping as a user gives them, by number or by name, and the numbers that they stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: For each target variable or action its counterpart in the source, by number or name; or a dict from one to the other.
Entries = Sequence[int | str | None] | Mapping[Any, Any]


def as_entries(argument: str, values: Any) -> tuple[Any, ...]:
    """What a user gave so that it can be compared and hashed: a dict as pairs of key and value."""
    if isinstance(values, Mapping):
        return tuple(values.items())
    if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray):
        raise ValueError(
            f"{argument} must be a sequence with one entry for each target variable or action, or a dict from their names, "
            f"got {values!r}"
        )
    # Pairs that were written to a file come back as lists.
    return tuple(tuple(each) if isinstance(each, list | tuple) and len(each) == 2 else each for each in values)


def as_given(entries: Sequence[Any]) -> Any:
    """Pairs of :func:`as_entries` as a dict again."""
    return dict(entries) if any(isinstance(each, tuple) for each in entries) else tuple(entries)


def has_names(entries: Sequence[Any]) -> bool:
    """Whether the tasks' names are needed to tell which numbers the entries are."""
    return any(isinstance(each, str | tuple) for each in entries)


def numbers(
    argument: str, entries: Sequence[Any], target_names: Sequence[str], source_names: Sequence[str], default: Any = None
) -> tuple[Any, ...]:
    """Replace names by their numbers; of pairs, make one entry for each of the target's, ``default`` where there is none."""
    if not any(isinstance(each, tuple) for each in entries):
        return tuple(_number(argument, each, source_names, "source") for each in entries)
    if not all(isinstance(each, tuple) for each in entries):
        raise ValueError(f"{argument} must be entries or pairs, not both, got {tuple(entries)!r}")
    found = dict.fromkeys(range(len(target_names)), default)
    seen = set()
    for key, value in entries:
        target = _number(argument, key, target_names, "target")
        if target not in found or target in seen:
            raise ValueError(
                f"{argument} must have keys from 0 to {len(target_names) - 1} or names, each of the target's "
                f"{_kind(argument)} once, got {key!r}{' twice' if target in seen else ''}"
            )
        seen.add(target)
        found[target] = _number(argument, value, source_names, "source")
    missing = [target_names[k] for k, each in found.items() if each is None]
    if argument == "action" and missing:
        raise ValueError(f"action must have a source action for each target action, got none for {', '.join(missing)}")
    return tuple(found.values())


def _number(argument: str, entry: Any, names: Sequence[str], task: str) -> Any:
    if not isinstance(entry, str):
        return entry
    if list(names).count(entry) != 1:
        raise ValueError(
            f"{argument} must hold names of the {task}'s {_kind(argument)}, {', '.join(names)}, got {entry!r}"
            + (", which is the name of several" if entry in names else "; a task that names none has s0, ... and a0, ...")
        )
    return list(names).index(entry)


def _kind(argument: str) -> str:
    return "actions" if argument == "action" else "variables"
