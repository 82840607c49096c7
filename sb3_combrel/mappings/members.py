"""Which pairs of a state mapping and an action mapping are members of a set, and look-ups among them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.common.checks import count_text
from sb3_combrel.mappings.action_mappings import ActionMappings
from sb3_combrel.mappings.inter_task_mapping import Ints, index_table

MAX_CANDIDATES = 10_000_000
"""Compliance is computed for every pair of a state mapping and a source action of a target action."""


class Candidates(NamedTuple):
    """
    The different ways in which the mappings of a set treat one target action; compliance distinguishes no others.

    :param state_index: row of ``MappingSet.state_mappings``, shape (n_candidates,)
    :param source_action: source action that the target action maps to, shape (n_candidates,)
    """

    state_index: Ints
    source_action: Ints


class AllPairs:
    """
    Every state mapping with every action mapping; the look-ups are those of :class:`MappingSet`.

    :param first_equal: for each state mapping the first row that is equal to it, shape (n_state_mappings,)
    :param actions: the action mappings
    :raises ValueError: if there are more than ``MAX_CANDIDATES``
    """

    def __init__(self, first_equal: Ints, actions: ActionMappings) -> None:
        self.first_equal = first_equal
        self.actions = actions
        self.n_mappings = len(first_equal) * actions.n_mappings
        n_states = len(np.unique(first_equal))
        n_candidates = n_states * sum(len(actions.source_actions_for(action)) for action in range(actions.n_target_actions))
        if n_candidates > MAX_CANDIDATES:
            raise ValueError(
                f"{n_states:,} state mappings with these action mappings make {n_candidates:,} candidates, more than the "
                f"{MAX_CANDIDATES:,} that are practical; choose fewer state mappings, or list the mappings of interest"
            )

    def pair(self, number: int) -> tuple[int, int]:
        return divmod(number, self.actions.n_mappings)

    def source_actions_for(self, action: int) -> Ints:
        return self.actions.source_actions_for(action)

    def candidates(self, action: int) -> Candidates:
        source_actions = self.actions.source_actions_for(action)
        rows = np.unique(self.first_equal)
        return Candidates(np.repeat(rows, len(source_actions)), np.tile(source_actions, len(rows)))

    def count(self, state_index: int, action: int, source_action: int) -> int:
        equal = int(np.count_nonzero(self.first_equal == self.first_equal[state_index]))
        return equal * self.actions.count(action, source_action)

    def find(self, state_index: int, action: int, source_action: int) -> int:
        return int(self.first_equal[state_index]) * self.actions.n_mappings + self.actions.first(action, source_action)


class ListedPairs:
    """
    The given pairs only; the look-ups are those of :class:`MappingSet`.

    :param pairs: row of a state mapping and number of an action mapping for each member, shape (n_mappings, 2)
    :raises ValueError: if ``pairs`` is something else
    """

    def __init__(self, first_equal: Ints, actions: ActionMappings, pairs: ArrayLike) -> None:
        table = index_table("pairs", pairs, "(n_mappings, 2)")
        size = (len(first_equal), actions.n_mappings)
        if table.shape[1] != 2 or table.min() < 0 or (table.max(axis=0) >= size).any():
            raise ValueError(
                f"pairs must be numbers of state mappings below {size[0]:,} and of action mappings below "
                f"{count_text(size[1])}, got {table.shape[1]} columns of numbers from {table.min()} to {table.max()}"
            )
        table.flags.writeable = False
        self.pairs = table
        self.n_mappings = len(table)
        # State mapping (the first of equal ones) and source actions, shape (n_mappings, n_target_actions), of each member.
        self._states: Ints = first_equal[table[:, 0]]
        self._source_actions: Ints = np.array([actions[number] for number in table[:, 1].tolist()], dtype=np.int64)
        self._first_equal = first_equal

    def pair(self, number: int) -> tuple[int, int]:
        state_index, action_index = self.pairs[number].tolist()
        return state_index, action_index

    def source_actions_for(self, action: int) -> Ints:
        return np.unique(self._source_actions[:, action])

    def candidates(self, action: int) -> Candidates:
        different = np.unique(np.column_stack([self._states, self._source_actions[:, action]]), axis=0)
        return Candidates(different[:, 0].copy(), different[:, 1].copy())

    def count(self, state_index: int, action: int, source_action: int) -> int:
        return len(self._matching(state_index, action, source_action))

    def find(self, state_index: int, action: int, source_action: int) -> int:
        matching = self._matching(state_index, action, source_action)
        if not matching.size:
            raise ValueError(
                f"no mapping of the set has state mapping {state_index} and maps target action {action} "
                f"to source action {source_action}"
            )
        return int(matching[0])

    def _matching(self, state_index: int, action: int, source_action: int) -> Ints:
        same_state = self._states == self._first_equal[state_index]
        return np.flatnonzero(same_state & (self._source_actions[:, action] == source_action))
