"""Sets of inter-task mappings: pairs of state and action mappings, which are never all written out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from operator import index as as_index
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.common.checks import count_text
from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.mappings.action_mappings import (
    ActionMappings,
    AllActionMappings,
    BalancedActionMappings,
    ListedActionMappings,
    paper_icub_actions,
)
from sb3_combrel.mappings.inter_task_mapping import (
    UNMAPPED,
    Floats,
    InterTaskMapping,
    Ints,
    MappingNames,
    Names,
    TaskSizes,
    check_sizes,
    index_table,
)
from sb3_combrel.mappings.state_mappings import TWO_VARIABLES_ON_FOUR, state_mappings_using_sources, with_mirrored

MAX_CANDIDATES = 10_000_000  # compliance is computed for every pair of a state mapping and a source action of a target action

# Whether a source variable is used once at most, whether target variables may be unmapped, and the action mappings.
_SETS: dict[str, tuple[bool, bool, type[AllActionMappings | BalancedActionMappings]]] = {
    "injective": (True, True, AllActionMappings),
    "surjective": (False, False, AllActionMappings),
    "all": (False, True, AllActionMappings),
    "balanced": (True, True, BalancedActionMappings),
}
_SIZED_SETS = (*_SETS, *(f"signed_{each}" for each in _SETS))
_PAPER_SETS = ("paper_mountain_car", "paper_icub")
FACTORED_SETS = ("factored", "signed_factored")


class MappingSet:
    """The set X of inter-task mappings (Section 3): all pairs of a state mapping and an action mapping, or some of them.

    Only the two factors are stored. Without ``pairs``, mapping number i is the pair of state mapping
    ``i // n_action_mappings`` and action mapping ``i % n_action_mappings``; it is built when it is asked for.

    ::

        mappings = MappingSet.injective(n_source_variables=2, n_target_variables=4, n_source_actions=3, n_target_actions=5)
        print(len(mappings), mappings[0])  # 2916 InterTaskMapping(...)

    :param state_mappings: one state mapping a row, shape (n_state_mappings, n_target_variables); the source variable of
        each target variable, -1 for None
    :param actions: action mappings: one a row, shape (n_action_mappings, n_target_actions), or an ``ActionMappings``
    :param signs: +1 or -1 for each entry of ``state_mappings``, -1 mirrors; None for +1 throughout
    :param pairs: the members, in their order: row of ``state_mappings`` and number of the action mapping, shape
        (n_mappings, 2); None for all pairs
    :raises ValueError: if an array has another shape or other entries, or if there are more than ``MAX_CANDIDATES``
    """

    def __init__(
        self,
        state_mappings: ArrayLike,
        actions: ActionMappings | ArrayLike,
        signs: ArrayLike | None = None,
        *,
        pairs: ArrayLike | None = None,
    ) -> None:
        shape = "(n_state_mappings, n_target_variables)"
        self.state_mappings: Ints = index_table("state_mappings", state_mappings, shape)
        self.signs: Ints = np.ones_like(self.state_mappings) if signs is None else index_table("signs", signs, shape)
        self.actions = actions if isinstance(actions, ActionMappings) else ListedActionMappings(actions)
        self.names: MappingNames | None = None
        if self.signs.shape != self.state_mappings.shape or not np.isin(self.signs, (1, -1)).all():
            raise ValueError(f"signs must be +1 and -1 and have the shape of state_mappings, {self.state_mappings.shape}")
        if self.state_mappings.min() < UNMAPPED or (self.state_mappings == UNMAPPED).all(axis=1).any():
            raise ValueError("state_mappings must be source variables from 0 on or -1 for None, at least one of them not -1")
        self.signs[self.state_mappings == UNMAPPED] = 1
        self.state_mappings.flags.writeable = self.signs.flags.writeable = False
        rows = np.hstack([self.state_mappings, self.signs])
        _, first, row_of = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        self._first_equal: Ints = first[row_of.reshape(-1)].astype(np.int64)
        self.pairs: Ints | None = None
        if pairs is None:
            self._check_size()
        else:
            self._take_pairs(pairs)

    def _check_size(self) -> None:
        n_states = len(np.unique(self._first_equal))
        n_candidates = n_states * sum(len(self.source_actions_for(action)) for action in range(self.n_target_actions))
        if n_candidates > MAX_CANDIDATES:
            raise ValueError(
                f"{n_states:,} state mappings with these action mappings make {n_candidates:,} candidates, more than the "
                f"{MAX_CANDIDATES:,} that are practical; choose fewer state mappings, or list the mappings of interest"
            )

    def _take_pairs(self, pairs: ArrayLike) -> None:
        self.pairs = index_table("pairs", pairs, "(n_mappings, 2)")
        size = self.n_state_mappings, self.n_action_mappings
        if self.pairs.shape[1] != 2 or self.pairs.min() < 0 or (self.pairs.max(axis=0) >= size).any():
            raise ValueError(
                f"pairs must be numbers of state mappings below {size[0]:,} and of action mappings below "
                f"{count_text(size[1])}, got {self.pairs.tolist()}"
            )
        self.pairs.flags.writeable = False
        # State mapping (the first of equal ones) and source actions, shape (n_mappings, n_target_actions), of each member.
        self._states = self._first_equal[self.pairs[:, 0]]
        self._source_actions = np.array([self.actions[number] for number in self.pairs[:, 1].tolist()], dtype=np.int64)

    @classmethod
    def injective(cls, *sizes: int, signs: bool = False, **named_sizes: int) -> MappingSet:
        """Each source variable is used by exactly one target variable, the other target variables are unmapped.

        If the source task has more variables than the target task, each target variable gets a source variable of its
        own instead. All action mappings: from 2 to 4 variables and 3 to 5 actions 12 x 243. Parameters: :meth:`from_name`.
        """
        return cls.from_name("injective", *sizes, signs=signs, **named_sizes)

    @classmethod
    def surjective(cls, *sizes: int, signs: bool = False, **named_sizes: int) -> MappingSet:
        """Every target variable is mapped and every source variable is used at least once (as many as there is room for).

        All action mappings: from 2 to 4 variables and 3 to 5 actions 14 x 243. The translated instances lie on diagonals of
        the target's state space. Parameters: :meth:`from_name`.
        """
        return cls.from_name("surjective", *sizes, signs=signs, **named_sizes)

    @classmethod
    def all(cls, *sizes: int, signs: bool = False, **named_sizes: int) -> MappingSet:
        """Every source variable is used at least once (as many as there is room for), target variables may be unmapped.

        It contains the injective and the surjective set. All action mappings: from 2 to 4 variables and 3 to 5 actions
        50 x 243. Parameters: :meth:`from_name`.
        """
        return cls.from_name("all", *sizes, signs=signs, **named_sizes)

    @classmethod
    def balanced(cls, *sizes: int, signs: bool = False, **named_sizes: int) -> MappingSet:
        """The injective state mappings with those action mappings only that use the source actions as equally as possible.

        From 2 to 4 variables and 3 to 5 actions: 12 x 90. Parameters: :meth:`from_name`.
        """
        return cls.from_name("balanced", *sizes, signs=signs, **named_sizes)

    @classmethod
    def from_name(
        cls,
        name: str,
        n_source_variables: int,
        n_target_variables: int,
        n_source_actions: int,
        n_target_actions: int,
        *,
        signs: bool = False,
    ) -> MappingSet:
        """One of the sets by its name, as in a YAML file.

        :param name: "injective", "surjective", "all" or "balanced"; "signed_injective" and so on with ``signs``;
            "paper_mountain_car" or "paper_icub", whose numbers are the paper's
        :param n_source_variables: number of the source's state variables, and so on
        :param signs: also include every state mapping with any of its mapped variables mirrored
        :raises ValueError: for another name, if a number is below 1 or astronomically large, or if there are too many state
            mappings
        """
        check_set_name(name, (*_SIZED_SETS, *_PAPER_SETS))
        if name in _PAPER_SETS:
            made = cls.paper_icub() if name == "paper_icub" else cls.paper_mountain_car()
            own = made.state_mappings.shape[1], made.n_target_actions
            if own != (n_target_variables, n_target_actions):
                raise ValueError(
                    f"mappings must be for a target with {n_target_variables} state variables and {n_target_actions} actions, "
                    f'got "{name}", which is for {own[0]} and {own[1]}'
                )
            return made
        unsigned = name.removeprefix("signed_")
        once, allow_none, action_mappings = _SETS[unsigned]
        rows = state_mappings_using_sources(n_source_variables, n_target_variables, once=once, allow_none=allow_none)
        rows, mirrored = with_mirrored(rows) if signs or unsigned != name else (rows, None)
        return cls(rows, action_mappings(n_source_actions, n_target_actions), mirrored)

    @classmethod
    def paper_mountain_car(cls) -> MappingSet:
        """The factors that the paper names for Mountain Car 2D -> 4D (footnote 6): 4! = 24 state, 90 action mappings.

        Each state mapping is a permutation of (x, v, None, None) and leaves two target variables unmapped; they come in pairs
        of equal ones, so 12 differ, those of :meth:`injective`. The action mappings use the source actions 2, 2 and 1 times.
        Of the 2160 members 1080 differ; the paper's "1960" (in Table 5's discussion "1195") follow from no such count.
        """
        return cls(TWO_VARIABLES_ON_FOUR, BalancedActionMappings(n_source_actions=3, n_target_actions=5))

    @classmethod
    def paper_icub(cls) -> MappingSet:
        """The factors of the iCub experiment (Section 5.2), torso -> arm: 24 state mappings x 48 action mappings = 1152.

        The state mappings are those of :meth:`paper_mountain_car`, with two arm joints unmapped. The 48 are the 6 ways to give
        each source joint two of the four target joints times the 2^3 relative directions: "T1-" always maps to the "+" of its
        source joint, as in all rows of Table 4 ("S1+"), and each other target joint moves with or against it. Action 2j moves
        joint j in the negative direction, action 2j + 1 in the positive direction, on both sides.
        """
        return cls(TWO_VARIABLES_ON_FOUR, paper_icub_actions())

    @classmethod
    def from_list(cls, mappings: Iterable[InterTaskMapping]) -> MappingSet:
        """Exactly the given mappings, in the given order; they need not be all pairs of their factors.

        :raises ValueError: if there is none, or if they differ in their numbers of target variables or actions
        """
        listed = list(mappings)
        wrong = [each for each in listed if not isinstance(each, InterTaskMapping)]
        if not listed or wrong:
            raise ValueError(f"mappings must be a list of at least one InterTaskMapping, got {(wrong or listed)!r}")
        first = listed[0]
        states: dict[tuple[tuple[int, ...], tuple[int, ...]], int] = {}
        actions: dict[tuple[int, ...], int] = {}
        pairs = []
        for mapping in listed:
            if (mapping.n_target_variables, mapping.n_target_actions) != (first.n_target_variables, first.n_target_actions):
                raise ValueError(
                    f"mappings must all have the same numbers of target variables and actions, got {first!r} and {mapping!r}"
                )
            state = tuple(mapping.state_index.tolist()), tuple(mapping.state_sign.astype(int).tolist())
            pairs.append((states.setdefault(state, len(states)), actions.setdefault(mapping.action, len(actions))))
        state_mappings, signs = zip(*states, strict=True)
        chosen = cls(state_mappings, list(actions), signs, pairs=pairs)
        chosen.names = first.names
        return chosen

    @property
    def n_state_mappings(self) -> int:
        """Number of state mappings, repeated ones included."""
        return len(self.state_mappings)

    @property
    def n_action_mappings(self) -> int:
        """Number of action mappings."""
        return self.actions.n_mappings

    @property
    def n_mappings(self) -> int:
        """Number of mappings; unlike ``len`` it has no upper limit."""
        return self.n_state_mappings * self.n_action_mappings if self.pairs is None else len(self.pairs)

    @property
    def n_target_actions(self) -> int:
        """Number of actions of the target task."""
        return self.actions.n_target_actions

    @property
    def state_signs(self) -> Floats:
        """``signs`` for compiled loops, shape (n_state_mappings, n_target_variables)."""
        return self.signs.astype(np.float64)

    def __len__(self) -> int:
        return self.n_mappings

    def __iter__(self) -> Iterator[InterTaskMapping]:
        return (self[i] for i in range(self.n_mappings))

    def __getitem__(self, index: int) -> InterTaskMapping:
        number = as_index(index)
        number = number + self.n_mappings if number < 0 else number
        if not 0 <= number < self.n_mappings:
            raise IndexError(f"mapping {index} does not exist, the set has {self.n_mappings}")
        row, action_index = divmod(number, self.n_action_mappings) if self.pairs is None else self.pairs[number].tolist()
        return self._mapping(row, self.actions[action_index])

    def _mapping(self, row: int, action: tuple[int, ...]) -> InterTaskMapping:
        return InterTaskMapping(_state(self.state_mappings[row]), action, self.signs[row].tolist(), names=self.names)

    @property
    def combines_freely(self) -> bool:
        """Whether every state mapping comes with every choice of a source action for each target action."""
        return self.pairs is None and isinstance(self.actions, AllActionMappings)

    def members(self) -> Iterator[tuple[Ints, Ints]]:
        """All members in their order, some at once: rows of ``state_mappings``, shape (n,), and source actions.

        Of these there is one for each target action, shape (n, n_target_actions).
        """
        if self.pairs is not None:
            yield self.pairs[:, 0], self._source_actions
            return
        actions = np.array([self.actions[number] for number in range(self.n_action_mappings)], dtype=np.int64)
        for row in range(self.n_state_mappings):
            yield np.full(len(actions), row, dtype=np.int64), actions

    def source_actions_for(self, action: int) -> Ints:
        """The source actions, ascending, that a target action is mapped to; ``ValueError`` if there is no such action."""
        if not 0 <= action < self.n_target_actions:
            raise ValueError(f"action must be a target action from 0 to {self.n_target_actions - 1}, got {action}")
        return self.actions.source_actions_for(action) if self.pairs is None else np.unique(self._source_actions[:, action])

    def candidates(self, action: int) -> tuple[Ints, Ints]:
        """The different pairs of a state mapping and the source action that a target action maps to.

        All mappings with the same pair translate the same source instances in the same way for this target action, so
        compliance (Eq. 5) need be computed for these pairs only. Of state mappings that are equal only the first is listed.

        :return: rows of ``state_mappings``, and source actions, shape (n_candidates,) each; in ascending order
        :raises ValueError: if there is no such target action
        """
        source_actions = self.source_actions_for(action)
        if self.pairs is None:
            rows = np.unique(self._first_equal)
            return np.repeat(rows, len(source_actions)), np.tile(source_actions, len(rows))
        different = np.unique(np.column_stack([self._states, self._source_actions[:, action]]), axis=0)
        return different[:, 0].copy(), different[:, 1].copy()

    def of_candidate(self, state_index: int, source_action: int) -> InterTaskMapping:
        """What a candidate is, for its target action: a state mapping of the set, with one source action for all actions.

        :param state_index: row of ``state_mappings``
        """
        return self._mapping(state_index, (source_action,) * self.n_target_actions)

    def check(self, **sizes: Unpack[TaskSizes]) -> None:
        """Check all state and action mappings against the spaces of the tasks, see :meth:`InterTaskMapping.check`."""
        # Those with the largest numbers: if they fit, all do.
        state = _state(self.state_mappings[self.state_mappings.max(axis=1).argmax()])
        actions = [int(self.source_actions_for(action).max()) for action in range(self.n_target_actions)]
        check_sizes(state, actions, **sizes)

    def with_names(
        self, source_variables: Names, target_variables: Names, source_actions: Names, target_actions: Names
    ) -> MappingSet:
        """The same set, whose members carry names for ``repr``; see :meth:`InterTaskMapping.with_names`."""
        named = copy(self)
        named.names = MappingNames(*map(tuple, (source_variables, target_variables, source_actions, target_actions)))
        return named

    def __repr__(self) -> str:
        n_mappings, n_actions = (count_text(n).replace(",", "") for n in (self.n_mappings, self.n_action_mappings))
        listed, times = ("", " x") if self.pairs is None else (" listed one by one", ",")
        return f"<{n_mappings} mappings{listed}: {self.n_state_mappings} state mappings{times} {n_actions} action mappings>"


def _state(row: Ints) -> tuple[int | None, ...]:
    return tuple(None if i == UNMAPPED else i for i in row.tolist())


def check_set_name(name: object, known: Sequence[str] = (*_SIZED_SETS, *_PAPER_SETS, *FACTORED_SETS)) -> None:
    """Raise ``ValueError`` if there is no set of that name."""
    if name not in known:
        names, factored = ", ".join((*_SIZED_SETS, *_PAPER_SETS)), ", ".join(FACTORED_SETS)
        close = did_you_mean(name, known)
        raise ValueError(f'mappings must be one of {names}; with use="prior" also {factored}; got {name!r}{close}')


def _write(mappings: MappingSet) -> tuple[str, dict[str, Any]]:
    if mappings.pairs is not None:
        members = [{"state": each.state, "action": each.action, "sign": each.sign} for each in mappings]
        return "ListedMappingSet", {"mappings": members}
    return "MappingSet", {name: getattr(mappings, name) for name in ("state_mappings", "signs", "actions")}


register_writer(MappingSet, _write)
register_reader("MappingSet", lambda state_mappings, signs, actions: MappingSet(state_mappings, actions, signs))
register_reader(
    "ListedMappingSet",
    lambda mappings: MappingSet.from_list(InterTaskMapping(each["state"], each["action"], each["sign"]) for each in mappings),
)
