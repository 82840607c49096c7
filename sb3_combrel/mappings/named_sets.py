"""What a user may write for a set of mappings, in Python or in a YAML file, as a :class:`MappingSet`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, MappingNames
from sb3_combrel.mappings.mapping_set import MappingSet, check_set_name

WHAT_THEY_MUST_BE = "mappings must be a name, an InterTaskMapping, a list of them or a MappingSet"


def resolve(
    mappings: str | InterTaskMapping | MappingSet | Mapping[str, Any] | Sequence[InterTaskMapping | Mapping[str, Any]],
    *,
    n_source_variables: int,
    n_target_variables: int,
    n_source_actions: int,
    n_target_actions: int,
) -> MappingSet:
    """
    The set of mappings that a user means, checked against the two tasks.

    :param mappings: the name of a set (:meth:`MappingSet.from_name`, or "paper_mountain_car", "paper_icub"), a set, one
        mapping or a sequence of mappings. A mapping may be given as a dict of its arguments, as in a YAML file:
        ``{"state": [0, None, 1, None], "action": [1, 0, 2, 1, 1]}``.
    :param n_source_variables: number of variables of the source task
    :param n_target_variables: number of variables of the target task
    :param n_source_actions: number of actions of the source task
    :param n_target_actions: number of actions of the target task
    :raises ValueError: if ``mappings`` is none of these or does not fit the two tasks
    """
    sizes = (n_source_variables, n_target_variables, n_source_actions, n_target_actions)
    papers = {"paper_mountain_car": MappingSet.paper_mountain_car, "paper_icub": MappingSet.paper_icub}
    if isinstance(mappings, MappingSet):
        resolved = mappings
    elif isinstance(mappings, str):
        resolved = papers[mappings]() if mappings in papers else MappingSet.from_name(mappings, *sizes)
    elif isinstance(mappings, InterTaskMapping | Mapping):
        resolved = MappingSet.from_list([_mapping(mappings)])
    elif isinstance(mappings, Iterable):
        resolved = MappingSet.from_list([_mapping(mapping) for mapping in mappings])
    else:
        raise ValueError(f"{WHAT_THEY_MUST_BE}, got {mappings!r}")
    resolved.check(
        n_source_variables=n_source_variables,
        n_target_variables=n_target_variables,
        n_source_actions=n_source_actions,
        n_target_actions=n_target_actions,
    )
    return resolved


def _mapping(mapping: InterTaskMapping | Mapping[str, Any]) -> InterTaskMapping:
    if isinstance(mapping, InterTaskMapping):
        return mapping
    if isinstance(mapping, Mapping) and {"state", "action"} <= set(mapping) <= {"state", "action", "sign"}:
        return InterTaskMapping(**mapping)
    raise ValueError(
        f"each of the mappings must be an InterTaskMapping or a dict of state, action and (optional) sign, got {mapping!r}"
    )


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
        _mapping(mappings)
    elif isinstance(mappings, Sequence):
        if not mappings:
            raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
        for each in mappings:
            _mapping(each)
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
        made = _factored(mappings) if "copies" in mappings else _mapping(mappings)
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
