"""Mappings listed one by one, as the different state and action mappings that they consist of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping, Ints


class DistinctParts(NamedTuple):
    """
    The state and action mappings of a list, each once, in the order of first appearance.

    :param state_mappings: source variable of each target variable, shape (n_state_mappings, n_target_variables), -1 for None
    :param signs: +1 or -1, same shape
    :param action_mappings: source action of each target action, shape (n_action_mappings, n_target_actions)
    :param pairs: row of ``state_mappings`` and of ``action_mappings`` of each mapping, shape (n_mappings, 2)
    """

    state_mappings: Ints
    signs: Ints
    action_mappings: Ints
    pairs: Ints


def distinct_parts(mappings: Sequence[InterTaskMapping]) -> DistinctParts:
    """
    Take mappings apart.

    :param mappings: mappings between the same two tasks
    :raises ValueError: if there is none, or if they differ in their numbers of target variables or actions
    """
    if not mappings:
        raise ValueError("mappings must hold at least one InterTaskMapping, got an empty list")
    first = mappings[0]
    for mapping in mappings:
        if not isinstance(mapping, InterTaskMapping):
            raise ValueError(f"mappings must be InterTaskMapping objects, got {mapping!r}")
        if (mapping.n_target_variables, mapping.n_target_actions) != (first.n_target_variables, first.n_target_actions):
            raise ValueError(
                f"mappings must all have the same numbers of target variables and actions, got {first!r} and {mapping!r}"
            )
    # Dictionaries keep the order of first appearance.
    state_number: dict[tuple[tuple[int, ...], tuple[int, ...]], int] = {}
    action_number: dict[tuple[int, ...], int] = {}
    pairs = np.empty((len(mappings), 2), dtype=np.int64)
    for i, mapping in enumerate(mappings):
        row = (tuple(mapping.state_index.tolist()), tuple(mapping.state_sign.astype(int).tolist()))
        pairs[i, 0] = state_number.setdefault(row, len(state_number))
        pairs[i, 1] = action_number.setdefault(mapping.action, len(action_number))
    states, signs = zip(*state_number, strict=True)
    return DistinctParts(np.array(states), np.array(signs), np.array(list(action_number)), pairs)
