"""Factored mappings: the target's variables divided among copies of the source, each moved by an action of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, Names, TaskSizes, as_mapping


@dataclass(frozen=True, repr=False)
class FactoredMapping:
    """The target's variables divided among copies of the source, each moved by a source action of its own.

    MountainCar4D is two cars of MountainCar2D: East is Right on (x, vx) and Neutral on (y, vy). Each copy is an
    :class:`InterTaskMapping`: its mapped variables are those of the copy, its actions what each target action does to it.
    What the target does is what all copies do at once: their displacements together, the mean of their rewards, and an end
    where all of them end. A variable in no copy stays as it is.

    A copy may leave out source variables. The source is then seen through the others alone: it is fitted to them, over all
    that its instances have in those that are left out.

    ::

        # Target states are (x, y, vx, vy), source states (x, v); source actions are Neutral, Left, Right.
        along_x = InterTaskMapping(state=(0, None, 1, None), action=(0, 1, 2, 0, 0))
        along_y = InterTaskMapping(state=(None, 0, None, 1), action=(0, 0, 0, 1, 2))
        transfer = TIMBREL(source, FactoredMapping([along_x, along_y]), use="prior")

    :param copies: inter-task mappings, or dicts of their arguments as in a YAML file
    :raises ValueError: if there is no copy, if copies differ in their numbers of target variables or actions, or if two have
        a target variable in common
    """

    copies: tuple[InterTaskMapping, ...]

    def __init__(self, copies: Iterable[InterTaskMapping | Mapping[str, Any]]) -> None:
        if isinstance(copies, str | Mapping) or not isinstance(copies, Iterable):
            raise ValueError(f"copies must be a list of inter-task mappings, one a copy of the source, got {copies!r}")
        mappings = tuple(as_mapping(each, "copies") for each in copies)
        if not mappings:
            raise ValueError("copies must hold at least one inter-task mapping, got none")
        # Those that are given by name cannot be compared before both tasks are known: see ``with_names``.
        named = any(each.has_names for each in mappings)
        object.__setattr__(self, "copies", mappings if named else _disjoint(mappings))

    @property
    def has_names(self) -> bool:
        """Whether there are names that have not been replaced by numbers yet."""
        return any(each.has_names for each in self.copies)

    def check(self, **sizes: Unpack[TaskSizes]) -> None:
        """Check every copy against the spaces of the two tasks, see :meth:`InterTaskMapping.check`."""
        for each in self.copies:
            each.check(**sizes)

    def with_names(
        self, source_variables: Names, target_variables: Names, source_actions: Names, target_actions: Names
    ) -> FactoredMapping:
        """The same mapping with names for ``repr``, and numbers for names; see :meth:`InterTaskMapping.with_names`."""
        names = tuple(map(tuple, (source_variables, target_variables, source_actions, target_actions)))
        return FactoredMapping([each.with_names(*names) for each in self.copies])

    def __repr__(self) -> str:
        names = self.copies[0].names
        if names is None or any(each.names is None for each in self.copies):
            return f"FactoredMapping({list(self.copies)!r})"
        moves = [(describe_copy(each), [names.source_actions[u] for u in each.action]) for each in self.copies]
        return "; ".join(
            f"{name}: " + ", ".join(f"{actions[a]} on {variables}" for variables, actions in moves)
            for a, name in enumerate(names.target_actions)
        )


def describe_copy(copy: InterTaskMapping) -> str:
    """The target variables of a copy with names, in the order of the source's variables: "(x, vx)"; a mirrored one as "-x"."""
    assert copy.names is not None
    names = [("-" if copy.state_sign[v] < 0 else "") + copy.names.target_variables[v] for v in _in_source_order(copy)]
    return f"({', '.join(names)})"


def describe_both_sides(copy: InterTaskMapping) -> str:
    """:func:`describe_copy` and, where these have other names, the source variables: "(x, vx) as (x, v)"."""
    assert copy.names is not None
    target = [copy.names.target_variables[v] for v in _in_source_order(copy)]
    source = [copy.names.source_variables[k] for k in sorted(k for k in copy.state if k is not None)]
    return describe_copy(copy) + (f" as ({', '.join(source)})" if source != target else "")


def _in_source_order(copy: InterTaskMapping) -> list[int]:
    """The mapped target variables by their source variables."""
    return [v for _, v in sorted((k, v) for v, k in enumerate(copy.state) if k is not None)]


def _disjoint(copies: tuple[InterTaskMapping, ...]) -> tuple[InterTaskMapping, ...]:
    """Copies by their first target variable, after a check that they fit together."""
    first = copies[0]
    for each in copies:
        if len(each.state) != len(first.state) or len(each.action) != len(first.action):
            raise ValueError(
                f"copies must all have the same numbers of target variables and actions, got {first!r} and {each!r}"
            )
    shared = np.flatnonzero(np.sum([each.mapped for each in copies], axis=0) > 1)
    if len(shared):
        raise ValueError(f"copies must have no target variable in common, got variable {shared[0]} in two of {copies!r}")
    return tuple(sorted(copies, key=lambda each: int(each.mapped.argmax())))


register_writer(FactoredMapping, lambda mapping: ("FactoredMapping", {"copies": list(mapping.copies)}))
register_reader("FactoredMapping", FactoredMapping)
