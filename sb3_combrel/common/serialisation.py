"""Transfer objects as plain data that JSON can hold, and back: what a saved model keeps of them. Nothing is pickled."""

from __future__ import annotations

import base64
import binascii
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.mappings.mapping_factors import (
    ActionMappings,
    AllActionMappings,
    BalancedActionMappings,
    ListedActionMappings,
)
from sb3_combrel.mappings.mapping_list import ListedMappingSet
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.sources.source_instances import SourceInstances

KIND = "~kind"
"""The key that tells an object written as a dict from a dict of the user's."""


def to_plain(value: Any) -> Any:
    """
    A value as numbers, text, lists and dicts.

    :param value: None, a number, text, a path, an array; source instances, a mapping or a set of mappings; or sequences
        and dicts of these
    :raises TypeError: if it is, or holds, something else
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    # Of exactly these types: a subclass may hold more than would be written.
    if type(value) in _WRITERS:
        return {KIND: type(value).__name__, **_WRITERS[type(value)](value)}
    if isinstance(value, Mapping) and KIND not in value and all(isinstance(key, str) for key in value):
        return {key: to_plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(each) for each in value]
    raise TypeError(f"cannot write {value!r} as plain data")


def from_plain(value: Any) -> Any:
    """
    What :func:`to_plain` wrote; tuples and arrays come back as lists, paths as text.

    :raises ValueError: if it was not written by :func:`to_plain` or is damaged
    """
    if isinstance(value, Mapping):
        if KIND in value:
            return _read(dict(value))
        return {key: from_plain(each) for key, each in value.items()}
    if isinstance(value, list):
        return [from_plain(each) for each in value]
    return value


def _read(written: dict[str, Any]) -> Any:
    kind = written.pop(KIND)
    reader = _READERS.get(kind) if isinstance(kind, str) else None
    if reader is None:
        raise ValueError(f"an object of the kind {kind!r} is not known; known are {', '.join(_READERS)}")
    try:
        return reader(**written)
    except (TypeError, LookupError, AttributeError, binascii.Error) as error:
        raise ValueError(f"what was written of a {kind} is damaged ({error})") from error


def _write_source(source: SourceInstances) -> dict[str, Any]:
    return {"npz": base64.b64encode(source.to_bytes()).decode()}


def _read_source(npz: str) -> SourceInstances:
    return SourceInstances.from_bytes(base64.b64decode(npz, validate=True))


def _write_mapping(mapping: InterTaskMapping) -> dict[str, Any]:
    return {"state": list(mapping.state), "action": list(mapping.action), "sign": to_plain(mapping.sign)}


def _write_set(mappings: MappingSet) -> dict[str, Any]:
    return {
        "state_mappings": mappings.state_mappings.tolist(),
        "signs": mappings.signs.tolist(),
        "actions": to_plain(mappings.actions),
    }


def _read_set(state_mappings: Sequence[Any], signs: Sequence[Any], actions: Any) -> MappingSet:
    return MappingSet(state_mappings, from_plain(actions), signs)


def _write_list(mappings: ListedMappingSet) -> dict[str, Any]:
    return {"mappings": [_write_mapping(mapping) for mapping in mappings]}


def _read_list(mappings: Sequence[Mapping[str, Any]]) -> MappingSet:
    return MappingSet.from_list(InterTaskMapping(**mapping) for mapping in mappings)


def _write_sizes(actions: AllActionMappings | BalancedActionMappings) -> dict[str, Any]:
    return {"n_source_actions": actions.n_source_actions, "n_target_actions": actions.n_target_actions}


def _write_actions(actions: ListedActionMappings) -> dict[str, Any]:
    return {"mappings": actions.mappings.tolist(), "n_source_actions": actions.n_source_actions}


_WRITERS: dict[type, Callable[[Any], dict[str, Any]]] = {
    SourceInstances: _write_source,
    InterTaskMapping: _write_mapping,
    MappingSet: _write_set,
    ListedMappingSet: _write_list,
    AllActionMappings: _write_sizes,
    BalancedActionMappings: _write_sizes,
    ListedActionMappings: _write_actions,
}
_READERS: dict[str, Callable[..., SourceInstances | InterTaskMapping | MappingSet | ActionMappings]] = {
    "SourceInstances": _read_source,
    "InterTaskMapping": InterTaskMapping,
    "MappingSet": _read_set,
    "ListedMappingSet": _read_list,
    "AllActionMappings": AllActionMappings,
    "BalancedActionMappings": BalancedActionMappings,
    "ListedActionMappings": ListedActionMappings,
}
