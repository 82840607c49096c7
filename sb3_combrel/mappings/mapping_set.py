"""Sets of inter-task mappings: pairs of state and action mappings, which are never all written out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from operator import index as as_index
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.common.checks import count_text
from sb3_combrel.common.serialisation import register_reader, register_writer
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
    TaskSizes,
    index_table,
)
from sb3_combrel.mappings.members import AllPairs, Candidates, ListedPairs
from sb3_combrel.mappings.state_mappings import TWO_VARIABLES_ON_FOUR, state_mappings_using_sources, with_mirrored


class MappingSet:
    """
    The set X of inter-task mappings (Section 3): all pairs of a state mapping and an action mapping, or some of them.

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
            raise ValueError(
                f"signs must be +1 and -1 and have the shape of state_mappings, {self.state_mappings.shape}, "
                f"got shape {self.signs.shape}"
            )
        if self.state_mappings.min() < UNMAPPED or (self.state_mappings == UNMAPPED).all(axis=1).any():
            raise ValueError("state_mappings must be source variables from 0 on or -1 for None, at least one of them not -1")
        self.signs[self.state_mappings == UNMAPPED] = 1
        self.state_mappings.flags.writeable = self.signs.flags.writeable = False
        _, first, row_of = np.unique(
            np.hstack([self.state_mappings, self.signs]), axis=0, return_index=True, return_inverse=True
        )
        self._first_equal: Ints = first[row_of.reshape(-1)].astype(np.int64)
        self._members = (
            AllPairs(self._first_equal, self.actions) if pairs is None else ListedPairs(self._first_equal, self.actions, pairs)
        )

    @property
    def pairs(self) -> Ints | None:
        """The members as they were listed, shape (n_mappings, 2); None for all pairs."""
        return self._members.pairs if isinstance(self._members, ListedPairs) else None

    @classmethod
    def injective(
        cls,
        n_source_variables: int,
        n_target_variables: int,
        n_source_actions: int,
        n_target_actions: int,
        *,
        signs: bool = False,
    ) -> MappingSet:
        """
        Each source variable is used by exactly one target variable, the other target variables are unmapped.

        If the source task has more variables than the target task, each target variable gets a source variable of its
        own instead. All action mappings are included. From 2 to 4 variables and 3 to 5 actions: 12 x 243.

        :param n_source_variables: number of the source's state variables, and so on
        :param signs: also include every state mapping with any of its mapped variables mirrored
        :raises ValueError: if a number is below 1 or astronomically large, or if there are too many state mappings
        """
        rows = state_mappings_using_sources(n_source_variables, n_target_variables, once=True, allow_none=True)
        return cls._of(rows, AllActionMappings(n_source_actions, n_target_actions), signs)

    @classmethod
    def surjective(
        cls,
        n_source_variables: int,
        n_target_variables: int,
        n_source_actions: int,
        n_target_actions: int,
        *,
        signs: bool = False,
    ) -> MappingSet:
        """
        Every target variable is mapped and every source variable is used at least once (as many as there is room for).

        All action mappings are included. From 2 to 4 variables and 3 to 5 actions: 14 x 243. The translated instances lie on
        diagonals of the target's state space. Parameters and errors: see :meth:`injective`.
        """
        rows = state_mappings_using_sources(n_source_variables, n_target_variables, once=False, allow_none=False)
        return cls._of(rows, AllActionMappings(n_source_actions, n_target_actions), signs)

    @classmethod
    def all(
        cls,
        n_source_variables: int,
        n_target_variables: int,
        n_source_actions: int,
        n_target_actions: int,
        *,
        signs: bool = False,
    ) -> MappingSet:
        """
        Every source variable is used at least once (as many as there is room for), target variables may be unmapped.

        It contains the injective and the surjective set. All action mappings are included. From 2 to 4 variables and 3
        to 5 actions: 50 x 243. Parameters and errors: see :meth:`injective`.
        """
        rows = state_mappings_using_sources(n_source_variables, n_target_variables, once=False, allow_none=True)
        return cls._of(rows, AllActionMappings(n_source_actions, n_target_actions), signs)

    @classmethod
    def balanced(
        cls,
        n_source_variables: int,
        n_target_variables: int,
        n_source_actions: int,
        n_target_actions: int,
        *,
        signs: bool = False,
    ) -> MappingSet:
        """
        The injective state mappings with those action mappings only that use the source actions as equally as possible.

        From 2 to 4 variables and 3 to 5 actions: 12 x 90. Parameters and errors: see :meth:`injective`.
        """
        rows = state_mappings_using_sources(n_source_variables, n_target_variables, once=True, allow_none=True)
        return cls._of(rows, BalancedActionMappings(n_source_actions, n_target_actions), signs)

    @classmethod
    def paper_mountain_car(cls) -> MappingSet:
        """
        The factors that the paper names for Mountain Car 2D -> 4D (footnote 6): 4! = 24 state, 90 action mappings.

        Each state mapping is a permutation of (x, v, None, None) and leaves two target variables unmapped; they come in pairs
        of equal ones, so 12 differ, those of :meth:`injective`. The action mappings use the source actions 2, 2 and 1 times.
        Of the 2160 members 1080 differ; the paper's "1960" (in Table 5's discussion "1195") follow from no such count.
        """
        return cls(TWO_VARIABLES_ON_FOUR, BalancedActionMappings(n_source_actions=3, n_target_actions=5))

    @classmethod
    def paper_icub(cls) -> MappingSet:
        """
        The factors of the iCub experiment (Section 5.2), torso -> arm: 24 state mappings x 48 action mappings = 1152.

        The state mappings are those of :meth:`paper_mountain_car`, with two arm joints unmapped. The 48 are the 6 ways to give
        each source joint two of the four target joints times the 2^3 relative directions: "T1-" always maps to the "+" of its
        source joint, as in all rows of Table 4 ("S1+"), and each other target joint moves with or against it. Action 2j moves
        joint j in the negative direction, action 2j + 1 in the positive direction, on both sides.
        """
        return cls(TWO_VARIABLES_ON_FOUR, paper_icub_actions())

    @classmethod
    def from_list(cls, mappings: Iterable[InterTaskMapping]) -> MappingSet:
        """
        Exactly the given mappings, in the given order; they need not be all pairs of their factors.

        :param mappings: mappings between the same two tasks
        :raises ValueError: if there is none, or if they differ in their numbers of target variables or actions
        """
        listed = list(mappings)
        if not listed:
            raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
        first = listed[0]
        # Dictionaries keep the order of first appearance.
        states: dict[tuple[tuple[int, ...], tuple[int, ...]], int] = {}
        actions: dict[tuple[int, ...], int] = {}
        pairs = []
        for mapping in listed:
            if not isinstance(mapping, InterTaskMapping):
                raise ValueError(f"mappings must be InterTaskMapping objects, got {mapping!r}")
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
        """
        One of the sets by its name, as in a YAML file.

        :param name: "injective", "surjective", "all" or "balanced"; "signed_injective" and so on with ``signs``
        :raises ValueError: for another name; for the other parameters and errors see :meth:`injective`
        """
        unsigned = name.removeprefix("signed_") if isinstance(name, str) else name
        if unsigned not in _SETS:
            raise _unknown_set(name)
        numbers = (n_source_variables, n_target_variables, n_source_actions, n_target_actions)
        return getattr(cls, unsigned)(*numbers, signs=signs or unsigned != name)

    @classmethod
    def _of(cls, state_mappings: Ints, actions: ActionMappings, signs: bool) -> MappingSet:
        rows, mirrored = with_mirrored(state_mappings) if signs else (state_mappings, None)
        return cls(rows, actions, mirrored)

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
        return self._members.n_mappings

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
        state_index, action_index = self._members.pair(number)
        state = tuple(None if i == UNMAPPED else i for i in self.state_mappings[state_index].tolist())
        sign = tuple(self.signs[state_index].tolist())
        return InterTaskMapping(state, self.actions[action_index], sign, names=self.names)

    def source_actions_for(self, action: int) -> Ints:
        """The source actions, ascending, that a target action is mapped to; ``ValueError`` if there is no such action."""
        self._check_action(action)
        return self._members.source_actions_for(action)

    def candidates(self, action: int) -> Candidates:
        """
        The different pairs of a state mapping and the source action that a target action maps to.

        All mappings with the same pair translate the same source instances in the same way for this target action, so
        compliance (Eq. 5) need be computed for these pairs only. Of state mappings that are equal only the first is listed.

        :return: the pairs, ordered by state mapping and source action
        :raises ValueError: if there is no such target action
        """
        self._check_action(action)
        return self._members.candidates(action)

    def count(self, state_index: int, action: int, source_action: int) -> int:
        """
        Number of mappings of the set with this state mapping (or an equal one) that map ``action`` to ``source_action``.

        :param state_index: row of ``state_mappings``
        :raises ValueError: if there is no such target action
        """
        self._check_action(action)
        return self._members.count(state_index, action, source_action)

    def find(self, state_index: int, action: int, source_action: int) -> int:
        """
        The first mapping with this state mapping (or an equal one) that maps ``action`` to ``source_action``.

        :param state_index: row of ``state_mappings``
        :return: its number, to be used as ``mapping_set[number]``
        :raises ValueError: if there is none
        """
        self._check_action(action)
        return self._members.find(state_index, action, source_action)

    def check(self, **sizes: Unpack[TaskSizes]) -> None:
        """Check every mapping against the spaces of the two tasks, see :meth:`InterTaskMapping.check`."""
        source_actions = [self._members.source_actions_for(action) for action in range(self.n_target_actions)]
        lengths = self.state_mappings.shape[1], self.n_target_actions
        if (
            lengths == (sizes["n_target_variables"], sizes["n_target_actions"])
            and self.state_mappings.max() < sizes["n_source_variables"]
            and max(int(actions.max()) for actions in source_actions) < sizes["n_source_actions"]
        ):
            return
        # Members with the largest index of a source variable or action: one of them fails its own check.
        for action in range(self.n_target_actions):
            states, actions = self.candidates(action)
            for worst in (self.state_mappings[states].max(axis=1).argmax(), actions.argmax()):
                self[self.find(int(states[worst]), action, int(actions[worst]))].check(**sizes)

    def with_names(
        self,
        source_variables: Iterable[str],
        target_variables: Iterable[str],
        source_actions: Iterable[str],
        target_actions: Iterable[str],
    ) -> MappingSet:
        """The same set, whose members carry names for ``repr``; see :meth:`InterTaskMapping.with_names`."""
        named = object.__new__(type(self))
        named.__dict__.update(self.__dict__)
        groups = source_variables, target_variables, source_actions, target_actions
        named.names = MappingNames(*(tuple(group) for group in groups))
        return named

    def __repr__(self) -> str:
        n_mappings, n_actions = (count_text(n).replace(",", "") for n in (self.n_mappings, self.n_action_mappings))
        listed, times = ("", " x") if self.pairs is None else (" listed one by one", ",")
        return f"<{n_mappings} mappings{listed}: {self.n_state_mappings} state mappings{times} {n_actions} action mappings>"

    def _check_action(self, action: int) -> None:
        if not 0 <= action < self.n_target_actions:
            raise ValueError(f"action must be a target action from 0 to {self.n_target_actions - 1}, got {action}")


_SETS = ("injective", "surjective", "all", "balanced")
_OTHER_SETS = ("paper_mountain_car", "paper_icub")
_FACTORED_SETS = ("factored", "signed_factored")


def check_set_name(name: str) -> None:
    """Raise ``ValueError`` if there is no set of that name."""
    if name.removeprefix("signed_") not in _SETS and name not in (*_OTHER_SETS, *_FACTORED_SETS):
        raise _unknown_set(name)


def _unknown_set(name: object) -> ValueError:
    names = [*_SETS, *(f"signed_{each}" for each in _SETS), *_OTHER_SETS]
    factored = f'with use="prior" also {", ".join(_FACTORED_SETS)}'
    return ValueError(f"mappings must be one of {', '.join(names)}; {factored}; got {name!r}")


def _write(mappings: MappingSet) -> tuple[str, dict[str, Any]]:
    if mappings.pairs is not None:
        members = [{"state": each.state, "action": each.action, "sign": each.sign} for each in mappings]
        return "ListedMappingSet", {"mappings": members}
    factors = {"state_mappings": mappings.state_mappings, "signs": mappings.signs, "actions": mappings.actions}
    return "MappingSet", factors


register_writer(MappingSet, _write)
register_reader("MappingSet", lambda state_mappings, signs, actions: MappingSet(state_mappings, actions, signs))
register_reader(
    "ListedMappingSet",
    lambda mappings: MappingSet.from_list(InterTaskMapping(each["state"], each["action"], each["sign"]) for each in mappings),
)
