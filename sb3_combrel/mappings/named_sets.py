"""What a user may write for a set of mappings, in Python or in a YAML file, as a :class:`MappingSet`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Unpack

from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, MappingNames, TaskSizes, as_mapping
from sb3_combrel.mappings.mapping_set import MappingSet, check_set_name


def resolve(
    mappings: str | InterTaskMapping | MappingSet | Mapping[str, Any] | Iterable[InterTaskMapping | Mapping[str, Any]],
    **sizes: Unpack[TaskSizes],
) -> MappingSet:
    """The set of mappings that a user means, checked against the two tasks.

    :param mappings: the name of a set (:meth:`MappingSet.from_name`), a set, one mapping or several mappings.
        A mapping may be given as a dict of its arguments, as in a YAML file:
        ``{"state": [0, None, 1, None], "action": [1, 0, 2, 1, 1]}``.
    :raises ValueError: if ``mappings`` is none of these or does not fit the two tasks
    """
    found = _made(mappings)
    if isinstance(found, str):
        found = MappingSet.from_name(found, **sizes)
    elif not isinstance(found, MappingSet):
        found = MappingSet.from_list(found if isinstance(found, list) else [found])
    found.check(**sizes)
    return found


def check_mappings(mappings: Any) -> None:
    """Check as much of what a user gives, factored or as of :func:`resolve`, as is possible without the tasks."""
    if isinstance(_made(mappings), str):
        check_set_name(mappings)


def with_numbers(mappings: Any, names: Sequence[MappingNames]) -> Any:
    """Replace names of variables and actions by their numbers, which must be the same for all sources; other things stay."""
    made = _made(mappings)
    if isinstance(made, list):
        return [with_numbers(each, names) for each in made]
    if not (isinstance(made, InterTaskMapping | FactoredMapping) and made.has_names):
        return mappings
    found = [made.with_names(*each) for each in names]
    if any(each != found[0] for each in found):
        raise ValueError(f"{made!r} means different variables or actions in each of the source tasks: give numbers")
    return found[0]


def _made(mappings: Any) -> Any:
    """Mappings that are given as dicts made, a list of them as a list; names and sets as they are."""
    if isinstance(mappings, str | InterTaskMapping | FactoredMapping | MappingSet):
        return mappings
    if isinstance(mappings, Mapping):
        if "copies" not in mappings:
            return as_mapping(mappings, "mappings")
        if set(mappings) != {"copies"}:
            raise ValueError(f"a factored mapping must be a FactoredMapping or a dict of copies, got {mappings!r}")
        return FactoredMapping(**mappings)
    if not isinstance(mappings, Iterable):
        raise ValueError(f"mappings must be a name, an InterTaskMapping, a list of them or a MappingSet, got {mappings!r}")
    made = [as_mapping(each, "mappings") for each in mappings]
    if not made:
        raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
    return made
