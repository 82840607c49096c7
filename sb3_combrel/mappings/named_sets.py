"""What a user may write for a set of mappings, in Python or in a YAML file, as a :class:`MappingSet`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.mappings.mapping_set import MappingSet


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
        raise ValueError(f"mappings must be a name, an InterTaskMapping, a list of them or a MappingSet, got {mappings!r}")
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
