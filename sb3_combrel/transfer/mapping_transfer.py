"""What TIMBREL and COMBREL share: source tasks seen through mappings, and instances translated from them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_positive
from sb3_combrel.common.compiled import SameTypes
from sb3_combrel.common.instances import InstanceArrays, along_curve
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.transferred import Supply
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet, resolve
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.compliance import Bandwidths, MappingTable, default_bandwidths
from sb3_combrel.transfer.relevance import relevance
from sb3_combrel.transfer.translation import BestInstances, CandidateArrays, TransferRules, translate

SourceLike = SourceInstances | str | os.PathLike[str] | Sequence[SourceInstances | str | os.PathLike[str]]
MappingsLike = str | InterTaskMapping | MappingSet | Mapping[str, Any] | Sequence[Any]

DEFAULT_BREADTH = 0.3
DEFAULT_FADING = 0.8
MOST_TRANSFERRED = 32


class Way(NamedTuple):
    """
    What a candidate stands for.

    :param target_action: number of the target action
    :param source_action: name of the source action that stands for it
    :param state_mapping: the variables that stand for each other, in words
    """

    target_action: int
    source_action: str
    state_mapping: str


class VirtualSourceTransfer(Transfer):
    """Translates source instances through mappings; which mapping, and when, is for the subclasses to say.

    Several source tasks are held as one: their actions are numbered on, and their state mappings stacked. A candidate
    of a target action is a pair of a state mapping and a source action; nothing else of a mapping matters there.

    :param source: instances, a path to them, or a list of several
    :param mappings: mappings from the target to the source (see ``resolve``)
    :param breadth: kernel breadth of transferred instances, in unit coordinates
    :param fading: factor on ``breadth`` for each episode that runs into its time limit
    :param believe_terminal: whether a source instance that ended its episode ends the target's
    :param relevance: whether instances come in the order of their relevance (Eq. 7), not of their distance
    :param relevance_fraction: mu of Eq. 4
    :param bandwidths: (start, outcome, reward) of compliance and relevance; None: from the data
    """

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike,
        *,
        breadth: float,
        fading: float,
        believe_terminal: bool,
        relevance: bool,
        relevance_fraction: float,
        bandwidths: tuple[float, float, float] | None,
    ):
        check_positive("breadth", breadth)
        check_positive("fading", fading, largest=1.0)
        check_positive("relevance_fraction", relevance_fraction, largest=1.0)
        if bandwidths is not None:
            if isinstance(bandwidths, str) or not isinstance(bandwidths, Sequence | np.ndarray) or len(bandwidths) != 3:
                raise ValueError(f"bandwidths must be three numbers (start, outcome, reward) or None, got {bandwidths!r}")
            for value in bandwidths:
                check_positive("bandwidths", value)
        self.source = source
        self.mappings = mappings
        self.breadth = breadth
        self.fading = fading
        self.believe_terminal = bool(believe_terminal)
        self.relevance = bool(relevance)
        self.relevance_fraction = relevance_fraction
        self.bandwidths = bandwidths
        self.target: TargetTask | None = None

    # ----------------------------------------------------------------- binding

    def bind(self, target: TargetTask, rng: np.random.Generator) -> None:
        self.target = target
        self._rng = rng
        self._sources = load_sources(self.source)
        self._sets = [self._named(resolve(self.mappings, **_sizes(source, target)), source) for source in self._sources]
        self._instances = stacked_instances(self._sources)
        self._table = stacked_table(self._sets)
        self._ways = self._candidates()
        self._bandwidths = default_bandwidths(self._instances) if self.bandwidths is None else Bandwidths(*self.bandwidths)
        self._rules = TransferRules(
            threshold=target.exploration_threshold,
            breadth=float(self.breadth),
            min_weight=target.min_weight,
            min_fraction=target.min_fraction,
            believe_terminal=self.believe_terminal,
            by_merit=self.relevance,
        )
        n_candidates = len(self._ways.row)
        most = int(self._instances.count.max())
        self._merit = np.ones((n_candidates, most)) if self.relevance else np.empty((1, 0))
        self._seen = TargetTransitions(target.n_actions, target.n_variables)
        self._uses: Counter[int] = Counter()
        self._instances_used = 0
        self._merit_of = 0
        self._all_renewed = False
        self._states_at = np.empty((target.n_actions, target.n_variables))
        self._most_transferred = min(list_room(target.min_fraction), MOST_TRANSFERRED)
        self._translate = SameTypes(translate)
        self._best = BestInstances.empty(self._most_transferred, target.n_variables)
        self._nothing = Supply.empty(0, target.n_variables)
        self._supply = self._supply_at = Supply.empty(0, target.n_variables, self._most_transferred)

    def _most_ways_at_once(self) -> int:
        """Candidates from which one pair may draw at the same time."""
        return 1

    def _named(self, mappings: MappingSet, source: SourceInstances) -> MappingSet:
        assert self.target is not None
        return mappings.with_names(source.state_names, self.target.state_names, source.action_names, self.target.action_names)

    def _candidates(self) -> CandidateArrays:
        """The candidates of every target action, over all sources."""
        assert self.target is not None
        rows: list[np.ndarray] = []
        actions: list[np.ndarray] = []
        first = [0]
        self._origin: list[tuple[int, int, int, int]] = []
        for a in range(self.target.n_actions):
            row_offset = action_offset = 0
            for number, (source, mappings) in enumerate(zip(self._sources, self._sets, strict=True)):
                state_index, source_action = mappings.candidates(a)
                rows.append(state_index + row_offset)
                actions.append(source_action + action_offset)
                self._origin += [(number, a, int(s), int(u)) for s, u in zip(state_index, source_action, strict=True)]
                row_offset += mappings.n_state_mappings
                action_offset += source.n_actions
            first.append(len(self._origin))
        return CandidateArrays(
            first=np.array(first, dtype=np.int64),
            row=np.concatenate(rows).astype(np.int64),
            action=np.concatenate(actions).astype(np.int64),
        )

    # ---------------------------------------------------------------- supplying

    def _draw(self, states: np.ndarray, own: np.ndarray, first: np.ndarray, last: np.ndarray, supply: Supply) -> Supply:
        """Translate, for each state, instances of the candidates from ``first`` up to ``last``.

        :return: ``supply``, or one with more room
        """
        if len(own) > len(supply.count):
            supply = Supply.empty(2 * len(own), states.shape[1], self._most_transferred)
        self._translate(
            states,
            own,
            first,
            last,
            self._instances,
            self._ways,
            self._table,
            self._rules,
            self._merit,
            self._best,
            supply,
        )
        return supply

    def _draw_at(self, state: np.ndarray, own: np.ndarray, first: np.ndarray, last: np.ndarray) -> Supply:
        """The same for every action at one state; what is used there is counted."""
        self._states_at[:] = state
        supply = self._supply_at = self._draw(self._states_at, own, first, last, self._supply_at)
        one_way = self._most_ways_at_once() == 1
        for way, n in zip(first.tolist(), supply.count.tolist(), strict=False):
            if n > 0 and one_way:
                self._uses[way] += 1
            self._instances_used += n
        return supply

    def renewed(self, known: np.ndarray) -> np.ndarray:
        all_renewed, self._all_renewed = self._all_renewed, False
        return np.flatnonzero(~known) if all_renewed else NO_PAIRS

    def lowest_reward(self) -> float:
        return min(float(source.rewards.min()) for source in self._sources)

    def end_episode(self, truncated: bool) -> None:
        """An episode that ran into its time limit speaks against the transferred model: it reaches less far from now on.

        Where transferred instances settle every pair, wrongly, nothing is optimistic and nothing would ever be tried.
        """
        if truncated and self.fading < 1.0:
            self._rules = self._rules._replace(breadth=self._rules.breadth * self.fading)
            self._all_renewed = True

    def _nothing_for(self, n: int) -> Supply:
        assert self.target is not None
        if n > len(self._nothing.count):
            self._nothing = Supply.empty(2 * n, self.target.n_variables)
        return self._nothing

    def _renew_relevance(self) -> None:
        """Relevance of all instances to the target transitions seen so far."""
        for c in range(len(self._ways.row)):
            action = int(self._origin[c][1])
            states, effects, rewards = self._seen.of_action(action)
            row = self._ways.row[c]
            relevance(
                states,
                effects,
                rewards,
                self._instances,
                self._ways.action[c],
                self._table.index[row],
                self._table.sign[row],
                self._bandwidths,
                float(self.relevance_fraction),
                np.empty(len(rewards)),
                self._merit[c],
            )
        self._merit_of = self._seen.n

    # --------------------------------------------------------------- describing

    def describe(self, candidate: int) -> str:
        """A candidate in words: target action, source action and the variables that stand for each other."""
        assert self.target is not None
        way = self.way(candidate)
        words = f"{self.target.action_names[way.target_action]}<-{way.source_action} with {way.state_mapping}"
        return words if len(self._sources) == 1 else f"source {self._origin[candidate][0]}: {words}"

    def way(self, candidate: int) -> Way:
        """A candidate's parts, by name."""
        number, action, state_index, source_action = self._origin[candidate]
        mappings = self._sets[number]
        whole = repr(mappings[mappings.find(state_index, action, source_action)])
        variables = whole[whole.index("(") + 1 : whole.index(";")]
        return Way(action, self._sources[number].action_names[source_action], variables)

    @property
    def makes_choices(self) -> bool:
        """Whether :meth:`choices` ever says anything."""
        return False

    def choices(self) -> np.ndarray:
        """The candidate from which each pair of the sample would draw; -1 where there is none, or no single one."""
        assert self.target is not None
        return np.full(self.target.n_actions * len(self.target.sample_states), -1, dtype=np.int64)

    def source_action_names(self) -> list[str]:
        """Names of the source actions of all sources, each name once."""
        return list(dict.fromkeys(name for source in self._sources for name in source.action_names))

    def uses(self) -> dict[int, int]:
        """How many decisions each candidate supplied instances to."""
        return dict(self._uses)

    def mapping_counts(self) -> list[tuple[str, int]]:
        """How often each mapping supplied instances to a decision, the most used first, by name."""
        return [(self.describe(candidate), n) for candidate, n in self._uses.most_common()]

    def statistics(self) -> dict[str, float]:
        return {
            "transfer/instances_used": self._instances_used,
            "transfer/uses": sum(self._uses.values()),
            "transfer/mappings_used": len(self._uses),
        }

    # --------------------------------------------------------------- saving

    def arguments(self) -> dict[str, Any]:
        # Once read, the instances themselves: the file of a saved model must not depend on other files.
        if self.target is None:
            return super().arguments()
        return {**super().arguments(), "source": self._sources if len(self._sources) > 1 else self._sources[0]}

    def saved_arrays(self) -> dict[str, np.ndarray]:
        seen = self._seen
        n = seen.n
        columns = [seen.states[:n], seen.effects[:n], seen.rewards[:n, None], seen.actions[:n, None]]
        uses = np.zeros(len(self._origin))
        uses[list(self._uses)] = list(self._uses.values())
        return {
            "transitions": np.hstack(columns),
            "breadth": np.array([self._rules.breadth]),
            "uses": uses,
            "instances_used": np.array([float(self._instances_used)]),
        }

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        assert self.target is not None
        d = self.target.n_variables
        self._rules = self._rules._replace(breadth=float(saved["breadth"][0]))
        for row in saved["transitions"]:
            action = int(np.clip(row[-1], 0, self.target.n_actions - 1))
            self._note(row[:d], action, float(row[-2]), row[d : 2 * d])
        # All pairs are settled anew with what is restored here.
        self._all_renewed = False
        used = np.flatnonzero(saved["uses"] >= 1.0)
        self._uses = Counter(dict(zip(used.tolist(), saved["uses"][used].astype(np.int64).tolist(), strict=True)))
        self._instances_used = int(saved["instances_used"][0])

    def _note(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray) -> None:
        """Take up a saved transition."""
        self._seen.add(state, action, reward, effect)


NO_PAIRS = np.empty(0, dtype=np.int64)


class TargetTransitions:
    """The target transitions that a transfer method has noted, in growing arrays (unit coordinates)."""

    def __init__(self, n_actions: int, n_variables: int):
        self.n = 0
        self.states = np.empty((64, n_variables))
        self.effects = np.empty((64, n_variables))
        self.rewards = np.empty(64)
        self.actions = np.empty(64, dtype=np.int64)

    def add(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray) -> int:
        """Note one; its number."""
        if self.n == len(self.rewards):
            for name in ("states", "effects", "rewards", "actions"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        i = self.n
        self.states[i], self.effects[i] = state, effect
        self.rewards[i], self.actions[i] = reward, action
        self.n += 1
        return i

    def of_action(self, action: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States, effects and rewards of the transitions with one action."""
        rows = np.flatnonzero(self.actions[: self.n] == action)
        return self.states[rows], self.effects[rows], self.rewards[rows]


def load_sources(source: SourceLike) -> list[SourceInstances]:
    """The source instances that a user means.

    :raises FileNotFoundError: if a path leads nowhere
    :raises ValueError: if it is not instances, a path, or a list of these
    """
    if isinstance(source, SourceInstances):
        return [source]
    if isinstance(source, str | os.PathLike):
        return [SourceInstances.load(source)]
    if isinstance(source, Sequence) and len(source) > 0:
        return [instances for one in source for instances in load_sources(one)]
    raise ValueError(f"source must be SourceInstances, a path to them, or a list of these, got {source!r}")


def stacked_instances(sources: Sequence[SourceInstances]) -> InstanceArrays:
    """The instances of all sources in unit coordinates of each, by action, the sources' actions numbered on.

    In an order in which a search passes over most blocks.
    """
    n_actions = sum(source.n_actions for source in sources)
    n_variables = max(source.n_variables for source in sources)
    columns, offset = [], 0
    for source in sources:
        states = source.scaling.to_unit(source.states)
        effects = source.scaling.to_unit(source.next_states) - states
        order = np.argsort(along_curve(states), kind="stable")
        padding = ((0, 0), (0, n_variables - source.n_variables))
        rows = (source.actions + offset, np.pad(states, padding), np.pad(effects, padding), source.rewards, source.terminated)
        columns.append([column[order] for column in rows])
        offset += source.n_actions
    return InstanceArrays.of_rows(n_actions, *map(np.concatenate, zip(*columns, strict=True)))


def stacked_table(sets: Sequence[MappingSet]) -> MappingTable:
    """The state mappings of all sets, one below the other."""
    return MappingTable(
        index=np.vstack([mappings.state_mappings for mappings in sets]).astype(np.int64),
        sign=np.vstack([mappings.state_signs for mappings in sets]).astype(np.float64),
    )


def _sizes(source: SourceInstances, target: TargetTask) -> dict[str, int]:
    return {
        "n_source_variables": source.n_variables,
        "n_target_variables": target.n_variables,
        "n_source_actions": source.n_actions,
        "n_target_actions": target.n_actions,
    }
