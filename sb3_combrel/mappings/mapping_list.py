"""A set of mappings that is not a product: pairs of numbers that point into the two factors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, Ints
from sb3_combrel.mappings.mapping_factors import ListedActionMappings
from sb3_combrel.mappings.mapping_set import Candidates, MappingSet


class ListedMappingSet(MappingSet):
    """
    Exactly the given mappings; made by :meth:`MappingSet.from_list`.

    ``state_mappings`` and ``actions`` hold the different state and action mappings of the list.

    :param mappings: mappings between the same two tasks
    :raises ValueError: if there is none, or if they differ in their numbers of target variables or actions
    """

    def __init__(self, mappings: Sequence[InterTaskMapping]) -> None:
        if not mappings:
            raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
        first = mappings[0]
        for mapping in mappings:
            if len(mapping.state) != len(first.state) or len(mapping.action) != len(first.action):
                raise ValueError(
                    f"mappings must all have the same numbers of target variables and actions, got {first!r} and {mapping!r}"
                )
        # Dictionaries keep the order of first appearance, which the numbers of the factors follow.
        state_number: dict[tuple[tuple[int, ...], tuple[int, ...]], int] = {}
        action_number: dict[tuple[int, ...], int] = {}
        pairs = np.empty((len(mappings), 2), dtype=np.int64)
        for i, mapping in enumerate(mappings):
            row = (tuple(mapping.state_index.tolist()), tuple(mapping.state_sign.astype(int).tolist()))
            pairs[i, 0] = state_number.setdefault(row, len(state_number))
            pairs[i, 1] = action_number.setdefault(mapping.action, len(action_number))
        states, signs = zip(*state_number, strict=True)
        actions = ListedActionMappings(np.array(list(action_number)))
        super().__init__(np.array(states), actions, np.array(signs))
        self._source_action: Ints = actions.mappings
        self._pairs: Ints = pairs
        self.names = first.names

    @property
    def n_mappings(self) -> int:
        return len(self._pairs)

    def candidates(self, action: int) -> Candidates:
        self._check_action(action)
        pairs = np.column_stack([self._pairs[:, 0], self._source_action[self._pairs[:, 1], action]])
        rows, source_actions = np.unique(pairs, axis=0).T
        return Candidates(rows.copy(), source_actions.copy())

    def count(self, state_index: int, action: int, source_action: int) -> int:
        return len(self._members(state_index, action, source_action))

    def find(self, state_index: int, action: int, source_action: int) -> int:
        members = self._members(state_index, action, source_action)
        if not members.size:
            raise ValueError(
                f"no mapping of the set has state mapping {state_index} and maps target action {action} "
                f"to source action {source_action}"
            )
        return int(members[0])

    def __repr__(self) -> str:
        return (
            f"<{self.n_mappings} mappings listed one by one: {self.n_state_mappings} state mappings, "
            f"{self.n_action_mappings} action mappings>"
        )

    def _members(self, state_index: int, action: int, source_action: int) -> Ints:
        self._check_action(action)
        same_state = self._pairs[:, 0] == state_index
        return np.flatnonzero(same_state & (self._source_action[self._pairs[:, 1], action] == source_action))

    def _pair(self, number: int) -> tuple[int, int]:
        state_index, action_index = self._pairs[number].tolist()
        return state_index, action_index
