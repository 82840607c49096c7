"""Source tasks and mapping sets held as one: the candidates from which instances for a target action are translated."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sb3_combrel.common.instances import Instances, along_curve
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import MappingNames
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet, resolve, with_numbers
from sb3_combrel.sources.recipes import OneSource, checked_source, find_source
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask

SourceLike: TypeAlias = OneSource | Sequence[OneSource]
MappingsLike = str | InterTaskMapping | FactoredMapping | MappingSet | Mapping[str, Any] | Sequence[Any]

MAX_WHOLE_MAPPINGS = 20_000  # compliance is stored with every candidate, for thousands of transitions


class Candidate(NamedTuple):
    """What a candidate stands for, by name."""

    target_action: int  #: its number
    source_action: str  #: what it is mapped to
    state_mapping: str  #: the pairs of target and source variables, as text
    action_mapping: tuple[str, ...] = ()  #: source actions of all target actions, where whole mappings are candidates


class MappedVariables(NamedTuple):
    """What a candidate makes of each target variable under its target action; int64, shape (n_target_variables,)."""

    target_action: int
    source: np.ndarray  #: number of the source task; -1 for no source variable
    variable: np.ndarray  #: variable of that source; -1 for none
    sign: np.ndarray  #: -1 for a mirrored variable, 1 for others, 0 for no source variable
    action: np.ndarray  #: source action that moves the variable; -1 for none

    @classmethod
    def of(cls, target_action: int, parts: Sequence[tuple[int, np.ndarray, np.ndarray, int]], n: int) -> MappedVariables:
        """Take ``n`` variables from parts: source task, source variables (-1 for none), signs, and the source action."""
        source, variable, action, sign = *np.full((3, n), -1, dtype=np.int64), np.zeros(n, dtype=np.int64)
        for number, read, its_sign, used in parts:
            mapped = read >= 0
            source[mapped], variable[mapped], action[mapped] = number, read[mapped], used
            sign[mapped] = np.where(its_sign[mapped] < 0, -1, 1)
        return cls(target_action, source, variable, sign, action)


class Origin(NamedTuple):
    """Where a candidate comes from, in numbers."""

    source: int
    target_action: int
    state_index: int  # state mapping of its set
    source_action: int


class CandidateArrays(NamedTuple):
    """The candidates of all target actions: ``first[a]`` to ``first[a + 1]`` are those of action a."""

    first: np.ndarray  # int64, shape (n_target_actions + 1,)
    row: np.ndarray  # int64, shape (n_candidates,): state mapping, a row of the mapping table
    action: np.ndarray  # int64, same shape: source action


class MappingTable(NamedTuple):
    """State mappings for compiled code, one a row; shape (n_state_mappings, n_target_variables)."""

    variable: np.ndarray  # int64: source variable of each target variable, -1 for none
    sign: np.ndarray  # float64: -1 where the variable is mirrored


class Candidates:
    """The candidates of each target action: pairs of a state mapping and a source action; all sources are numbered on.

    If whole mappings are to be distinguished (``whole``), each is a candidate of every action, in the same order.
    """

    def __init__(self, source: SourceLike, mappings: MappingsLike, task: TargetTask, whole: bool = False):
        self.task, self.whole = task, whole
        self.sources = load_sources(source)
        self.sets = resolved_sets(self.sources, mappings, task)
        self.instances = stacked_instances(self.sources)
        self.table = stacked_table(self.sets)
        #: Of each source, the number of its first state mapping in the table, and of its first action among all.
        self.first_row = np.cumsum([0, *(mappings.n_state_mappings for mappings in self.sets)])
        self.first_action = np.cumsum([0, *(source.n_actions for source in self.sources)])
        self.origins: list[Origin] = []
        self.arrays = self._numbered()

    def _numbered(self) -> CandidateArrays:
        n_all = sum(map(len, self.sets)) if self.whole else 0
        if n_all > MAX_WHOLE_MAPPINGS:
            raise ValueError(
                f'mappings must hold at most {MAX_WHOLE_MAPPINGS} whole mappings with neighbors="state_action", got {n_all}; '
                'a list of mappings or a smaller set would do, or neighbors="action", which needs no whole mappings'
            )
        members = [list(mappings.members()) if self.whole else [] for mappings in self.sets]
        first = [0]
        for a in range(self.task.n_actions):
            for number, mappings in enumerate(self.sets):
                whole = [(rows, actions[:, a]) for rows, actions in members[number]]
                for pairs in whole or [mappings.candidates(a)]:
                    self.origins += [Origin(number, a, int(s), int(u)) for s, u in zip(*pairs, strict=True)]
            first.append(len(self.origins))
        source, _, state_index, source_action = np.array(self.origins, dtype=np.int64).T
        row, action = self.first_row[source] + state_index, self.first_action[source] + source_action
        return CandidateArrays(np.array(first, dtype=np.int64), row, action)

    def __len__(self) -> int:
        return len(self.origins)

    def with_own(self, instances: Instances) -> Candidates:
        """Return the same candidates, each with instances of its own: those of "action" c are candidate c's."""
        made = copy.copy(self)
        made.instances = instances
        made.arrays = self.arrays._replace(action=np.arange(len(self), dtype=np.int64))
        return made

    def find(self, action: int, variable: np.ndarray, sign: np.ndarray, source_action: int) -> int:
        """Return the candidate that a state mapping and a source action, numbered on, amount to for a target action."""
        first, last = self.arrays.first[action : action + 2]
        same = ((self.table.variable == variable) & (self.table.sign == sign)).all(axis=1)
        fits = same[self.arrays.row[first:last]] & (self.arrays.action[first:last] == source_action)
        return int(first + np.flatnonzero(fits)[0])

    def parts(self, candidate: int) -> Candidate:
        """Return a candidate's parts, by name."""
        number, action, state_index, source_action = self.origins[candidate]
        mappings, names = self.sets[number], self.sources[number].action_names
        variables = mappings.of_candidate(state_index, source_action).variables_by_name()
        of_all: tuple[str, ...] = ()
        if self.whole:
            member = candidate - int(self.arrays.first[action]) - sum(map(len, self.sets[:number]))
            of_all = tuple(names[each] for each in mappings[member].action)
        return Candidate(action, names[source_action], variables, of_all)

    def mapped_variables(self, candidate: int) -> MappedVariables:
        """Return what a candidate makes of each target variable, in numbers."""
        origin, row = self.origins[candidate], self.arrays.row[candidate]
        part = origin.source, self.table.variable[row], self.table.sign[row], origin.source_action
        return MappedVariables.of(origin.target_action, [part], self.task.n_variables)

    def describe(self, candidate: int) -> str:
        """Return target action, source action and pairs of variables of a candidate as text."""
        parts = self.parts(candidate)
        words = f"{self.task.action_names[parts.target_action]}<-{parts.source_action} with {parts.state_mapping}"
        if self.whole:
            words += f", of the actions {', '.join(parts.action_mapping)}"
        return words if len(self.sources) == 1 else f"source {self.origins[candidate].source}: {words}"

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions of all sources, each name once."""
        return list(dict.fromkeys(name for source in self.sources for name in source.action_names))


def load_sources(source: SourceLike) -> list[SourceInstances]:
    """Return the instances of one source or of several, see :func:`~sb3_combrel.sources.recipes.find_source`."""
    source = checked_source(source)
    if isinstance(source, Sequence) and not isinstance(source, str):
        return [instances for one in source for instances in load_sources(one)]
    return [find_source(source)]


def loaded(source: SourceLike, mappings: MappingsLike, task: TargetTask) -> tuple[SourceLike, MappingsLike]:
    """Return a method's arguments as instances, as a saved model must not depend on other files, and numbers for names."""
    sources = load_sources(source)
    names = [MappingNames(each.state_names, task.state_names, each.action_names, task.action_names) for each in sources]
    return sources if len(sources) > 1 else sources[0], with_numbers(mappings, names)


def resolved_sets(sources: Sequence[SourceInstances], mappings: MappingsLike, task: TargetTask) -> list[MappingSet]:
    """Return the set of mappings that a user means for each source, with names; ``ValueError`` if it does not fit."""
    if isinstance(mappings, FactoredMapping):
        raise ValueError(f'factored mappings need use="prior", got mappings={mappings!r}')
    found = []
    for one in sources:
        names = one.state_names, task.state_names, one.action_names, task.action_names
        found.append(resolve(mappings, **sizes(one, task)).with_names(*names))
    return found


def load_one_source(source: SourceLike, method: str) -> SourceInstances:
    """Return what :func:`load_sources` does, of one source; a ValueError that names the ``method`` if there are several."""
    found = load_sources(source)
    if len(found) > 1:
        raise ValueError(f"source must be one source with {method}, got {len(found)}")
    return found[0]


def stacked_instances(sources: Sequence[SourceInstances]) -> Instances:
    """Return the instances of all sources in unit coordinates of each, by action, the sources' actions numbered on.

    They are sorted along a curve that fills the space. A variable is periodic if it is in all sources that have it.
    """
    n_actions = sum(source.n_actions for source in sources)
    n_variables = max(source.n_variables for source in sources)
    columns, offset, periodic = [], 0, np.ones(n_variables, dtype=np.bool_)
    for source in sources:
        periodic[: source.n_variables] &= source.periodic
        states = source.scaling.to_unit(source.states)
        effects = differences(source.scaling.to_unit(source.next_states), states, np.array(source.periodic))
        states = np.where(source.periodic, states - np.floor(states), states)
        order = np.argsort(along_curve(states), kind="stable")
        padding = ((0, 0), (0, n_variables - source.n_variables))
        rows = (source.actions + offset, np.pad(states, padding), np.pad(effects, padding), source.rewards, source.terminated)
        columns.append([column[order] for column in rows])
        offset += source.n_actions
    _warn_of_broken_angles(sources, periodic)
    actions, starts, moves, rewards, ends = map(np.concatenate, zip(*columns, strict=True))
    return Instances.of_rows(n_actions, actions, starts, moves, rewards, ends, periodic)


def _warn_of_broken_angles(sources: Sequence[SourceInstances], periodic: np.ndarray) -> None:
    """Warn of variables of a source that are periodic, and are not once all sources are together."""
    broken = [np.array(source.periodic) & ~periodic[: source.n_variables] for source in sources]
    names = {source.state_names[k] for source, its in zip(sources, broken, strict=True) for k in np.flatnonzero(its).tolist()}
    if names:
        warn_user(
            f"state variables of a source, {', '.join(sorted(names))}, are periodic, and those in the same place of another "
            "source are not: none of them goes around now; let places of angles agree, or take one source"
        )


def stacked_table(sets: Sequence[MappingSet]) -> MappingTable:
    """Return the state mappings of all sets, one below the other."""
    variable = np.vstack([mappings.state_mappings for mappings in sets]).astype(np.int64)
    return MappingTable(variable, sign=np.vstack([mappings.state_signs for mappings in sets]).astype(np.float64))


def sizes(source: SourceInstances, task: TargetTask) -> dict[str, int]:
    """Return how many variables and actions a source and a target have, as the mappings' functions name them."""
    return {
        "n_source_variables": source.n_variables,
        "n_target_variables": task.n_variables,
        "n_source_actions": source.n_actions,
        "n_target_actions": task.n_actions,
    }
