"""What a user may write for a set of mappings, in Python or in a YAML file, as a :class:`MappingSet`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Unpack

from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, MappingNames, TaskSizes, as_mapping
from sb3_combrel.mappings.mapping_set import MappingSet, check_set_name

WHAT_THEY_MUST_BE = "mappings must be a name, an InterTaskMapping, a list of them or a MappingSet"


def resolve(
    mappings: str | InterTaskMapping | MappingSet | Mapping[str, Any] | Sequence[InterTaskMapping | Mapping[str, Any]],
    **sizes: Unpack[TaskSizes],
) -> MappingSet:
    """
    The set of mappings that a user means, checked against the two tasks.

    :param mappings: the name of a set (:meth:`MappingSet.from_name`, or "paper_mountain_car", "paper_icub"), a set, one
        mapping or a sequence of mappings. A mapping may be given as a dict of its arguments, as in a YAML file:
        ``{"state": [0, None, 1, None], "action": [1, 0, 2, 1, 1]}``.
    :param sizes: numbers of variables and actions of the tasks, see :class:`TaskSizes`
    :raises ValueError: if ``mappings`` is none of these or does not fit the two tasks
    """
    papers = {"paper_mountain_car": MappingSet.paper_mountain_car, "paper_icub": MappingSet.paper_icub}
    if isinstance(mappings, MappingSet):
        resolved = mappings
    elif isinstance(mappings, str):
        resolved = papers[mappings]() if mappings in papers else MappingSet.from_name(mappings, **sizes)
    elif isinstance(mappings, InterTaskMapping | Mapping):
        resolved = MappingSet.from_list([as_mapping(mappings, "mappings")])
    elif isinstance(mappings, Iterable):
        resolved = MappingSet.from_list([as_mapping(mapping, "mappings") for mapping in mappings])
    else:
        raise ValueError(f"{WHAT_THEY_MUST_BE}, got {mappings!r}")
    resolved.check(**sizes)
    return resolved


def check_mappings(mappings: Any) -> None:
    """
    Check as much of what a user gives as can be checked before the tasks are known.

    :param mappings: see :func:`resolve`, or a factored mapping or a dict of its copies
    :raises ValueError: for a set that does not exist, an empty list, or something else than mappings
    """
    if isinstance(mappings, str):
        check_set_name(mappings)
    elif isinstance(mappings, Mapping) and "copies" in mappings:
        _factored(mappings)
    elif isinstance(mappings, Mapping):
        as_mapping(mappings, "mappings")
    elif isinstance(mappings, Sequence):
        if not mappings:
            raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
        for each in mappings:
            as_mapping(each, "mappings")
    elif not isinstance(mappings, InterTaskMapping | FactoredMapping | MappingSet | Iterable):
        raise ValueError(f"{WHAT_THEY_MUST_BE}, got {mappings!r}")


def with_numbers(mappings: Any, names: Sequence[MappingNames]) -> Any:
    """
    Replace names of variables and actions by their numbers.

    :param mappings: see :func:`check_mappings`
    :param names: of each source and the target
    :return: mappings that were given by name, with numbers; anything else as it is
    :raises ValueError: if a name is not that of one variable or action, or stands for different ones in several sources
    """
    if isinstance(mappings, Mapping):
        made = _factored(mappings) if "copies" in mappings else as_mapping(mappings, "mappings")
        return with_numbers(made, names) if made.has_names else mappings
    if isinstance(mappings, list | tuple):
        return [with_numbers(each, names) for each in mappings]
    if not (isinstance(mappings, InterTaskMapping | FactoredMapping) and mappings.has_names):
        return mappings
    found = [mappings.with_names(*each) for each in names]
    if any(each != found[0] for each in found):
        raise ValueError(f"{mappings!r} means different variables or actions in each of the source tasks: give numbers")
    return found[0]


def _factored(mapping: Mapping[str, Any]) -> FactoredMapping:
    if set(mapping) != {"copies"}:
        raise ValueError(f"a factored mapping must be a FactoredMapping or a dict of copies, got {mapping!r}")
    return FactoredMapping(**mapping)
