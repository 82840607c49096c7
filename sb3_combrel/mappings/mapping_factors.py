"""The two factors of a set of mappings: state mappings as rows of an array, action mappings by their number."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations, product
from math import comb, perm

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.mappings.inter_task_mapping import UNMAPPED, Ints

MAX_STATE_MAPPINGS = 100_000
"""State mappings are rows of an array, and the table of compliances has a column for each: more of them help nobody."""

LAYINGS_OF_TWO_ON_FOUR: Ints = np.array(list(permutations((0, 1, UNMAPPED, UNMAPPED))), dtype=np.int64)
"""The paper's 4! state mappings from two to four variables: the layings of (0, 1, None, None); 12 of the 24 differ."""


def state_mappings_using_sources(n_source: int, n_target: int, *, once: bool, allow_none: bool) -> Ints:
    """
    Every state mapping that uses as many different source variables as there is room for.

    :param n_source: number of source variables
    :param n_target: number of target variables
    :param once: whether a source variable is used at most once
    :param allow_none: whether target variables may be left unmapped
    :return: one mapping a row in lexicographic order (None first), shape (n, n_target), -1 for None
    :raises ValueError: if a number is below 1, or if there are more than ``MAX_STATE_MAPPINGS``
    """
    _check_positive(n_source_variables=n_source, n_target_variables=n_target)
    different = min(n_source, n_target)
    _check_state_mappings(_count_state_mappings(n_source, n_target, once, allow_none))
    choices = np.arange(UNMAPPED if allow_none else 0, n_source, dtype=np.int64)
    rows = np.empty((1, 0), dtype=np.int64)
    for position in range(n_target):
        rows = np.column_stack([np.repeat(rows, len(choices), axis=0), np.tile(choices, len(rows))])
        # Prune at once: rows that can no longer become valid would grow to (n_source + 1) ** n_target.
        used = (rows[:, :, None] == np.arange(n_source)).sum(axis=1)
        keep = (used > 0).sum(axis=1) + (n_target - 1 - position) >= different
        rows = rows[keep & (used <= 1).all(axis=1)] if once else rows[keep]
    return rows


def with_mirrored(state_mappings: Ints) -> tuple[Ints, Ints]:
    """
    Every state mapping with every choice of signs for its mapped variables.

    :param state_mappings: shape (n, n_target), -1 for None
    :return: the mappings and their signs (+1 or -1), both of shape (m, n_target); each mapping first with +1 throughout
    :raises ValueError: if there are more than ``MAX_STATE_MAPPINGS``
    """
    mapped = state_mappings != UNMAPPED
    copies = 2 ** mapped.sum(axis=1)
    _check_state_mappings(int(copies.sum()))
    rows = np.repeat(state_mappings, copies, axis=0)
    # The k-th copy of a mapping mirrors its mapped variables by the binary digits of k.
    number = np.arange(len(rows)) - np.repeat(np.cumsum(copies) - copies, copies)
    digit = np.cumsum(rows != UNMAPPED, axis=1) - 1
    mirrored = (rows != UNMAPPED) & ((number[:, None] >> np.maximum(digit, 0)) & 1 == 1)
    return rows, np.where(mirrored, -1, 1).astype(np.int64)


class ActionMappings(ABC):
    """
    A sequence of action mappings, each a tuple with the source action of every target action.

    :param n_source_actions: number of actions of the source task
    :param n_target_actions: number of actions of the target task
    """

    n_source_actions: int
    n_target_actions: int

    @property
    @abstractmethod
    def n_mappings(self) -> int:
        """Number of action mappings; may exceed what ``len`` can return."""

    @abstractmethod
    def __getitem__(self, index: int) -> tuple[int, ...]:
        """The action mapping of that number, from 0 to ``n_mappings - 1``."""

    @abstractmethod
    def count(self, action: int, source_action: int) -> int:
        """Number of the action mappings that map target action ``action`` to ``source_action``."""

    @abstractmethod
    def first(self, action: int, source_action: int) -> int:
        """Number of the first of them; ``ValueError`` if there is none."""

    def source_actions_for(self, action: int) -> Ints:
        """The source actions that target action ``action`` is mapped to by some mapping, ascending."""
        return np.array([b for b in range(self.n_source_actions) if self.count(action, b)], dtype=np.int64)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < self.n_mappings:
            raise IndexError(f"action mapping {index} does not exist, there are {self.n_mappings}")

    def _none_maps(self, action: int, source_action: int) -> ValueError:
        return ValueError(
            f"no mapping of the set maps target action {action} to source action {source_action}; "
            f"the possible source actions are {self.source_actions_for(action).tolist()}"
        )


@dataclass(frozen=True)
class AllActionMappings(ActionMappings):
    """
    All functions from target actions to source actions, in lexicographic order; nothing is stored.

    :param n_source_actions: number of actions of the source task
    :param n_target_actions: number of actions of the target task
    """

    n_source_actions: int
    n_target_actions: int

    def __post_init__(self) -> None:
        _check_positive(n_source_actions=self.n_source_actions, n_target_actions=self.n_target_actions)

    @property
    def n_mappings(self) -> int:
        return self.n_source_actions**self.n_target_actions

    def __getitem__(self, index: int) -> tuple[int, ...]:
        self._check_index(index)
        digits = []
        for _ in range(self.n_target_actions):
            index, digit = divmod(index, self.n_source_actions)
            digits.append(digit)
        return tuple(reversed(digits))

    def count(self, action: int, source_action: int) -> int:
        return self.n_source_actions ** (self.n_target_actions - 1) if 0 <= source_action < self.n_source_actions else 0

    def first(self, action: int, source_action: int) -> int:
        if not self.count(action, source_action):
            raise self._none_maps(action, source_action)
        return source_action * self.n_source_actions ** (self.n_target_actions - 1 - action)


@dataclass(frozen=True)
class BalancedActionMappings(ActionMappings):
    """
    The functions that use the source actions as equally as possible, in lexicographic order; nothing is stored.

    For five target and three source actions these are the 90 that use them 2, 2 and 1 times (the paper, Section 5.1;
    all mappings of its Table 2 are of this kind).

    :param n_source_actions: number of actions of the source task
    :param n_target_actions: number of actions of the target task
    """

    n_source_actions: int
    n_target_actions: int

    def __post_init__(self) -> None:
        _check_positive(n_source_actions=self.n_source_actions, n_target_actions=self.n_target_actions)

    @property
    def n_mappings(self) -> int:
        return self._completions([])

    def __getitem__(self, index: int) -> tuple[int, ...]:
        self._check_index(index)
        chosen: list[int] = []
        while len(chosen) < self.n_target_actions:
            for source_action in range(self.n_source_actions):
                following = self._completions([*chosen, source_action])
                if index < following:
                    chosen.append(source_action)
                    break
                index -= following
        return tuple(chosen)

    def count(self, action: int, source_action: int) -> int:
        # Every target action is as good as any other, and so is every source action.
        return self.n_mappings // self.n_source_actions if 0 <= source_action < self.n_source_actions else 0

    def first(self, action: int, source_action: int) -> int:
        if not self.count(action, source_action):
            raise self._none_maps(action, source_action)
        # The least such mapping: at each place the least choice that leaves a use of `source_action` for place `action`.
        chosen: list[int] = []
        number = 0
        for place in range(action + 1):
            for candidate in range(self.n_source_actions):
                # What is left to be chosen may come in any order, so `source_action` may as well come next.
                reserved = [candidate, source_action] if place < action else [candidate]
                if self._completions([*chosen, *reserved]) and (place < action or candidate == source_action):
                    chosen.append(candidate)
                    break
                number += self._completions([*chosen, candidate])
        return number

    def _completions(self, chosen: Sequence[int]) -> int:
        """Number of balanced mappings that begin with ``chosen``."""
        usage = np.bincount(np.array(chosen, dtype=np.int64), minlength=self.n_source_actions)
        return _balanced_completions(tuple(sorted(usage.tolist())), self.n_target_actions)


@lru_cache(maxsize=4096)
def _balanced_completions(usage: tuple[int, ...], n_target: int) -> int:
    """In how many ways a beginning that used the source actions so many times can be completed to a balanced mapping."""
    least, n_extra = divmod(n_target, len(usage))
    # ways[e]: distributions of the free places over the source actions so far, e of which are used least + 1 times.
    ways = {0: (1, n_target - sum(usage))}
    for used in usage:
        following: dict[int, tuple[int, int]] = {}
        for extra, (count, free) in ways.items():
            for more in (0, 1):
                places = least + more - used
                if places < 0 or places > free or extra + more > n_extra:
                    continue
                before = following.get(extra + more, (0, 0))[0]
                following[extra + more] = (before + count * comb(free, places), free - places)
        ways = following
    return ways.get(n_extra, (0, 0))[0]


class ListedActionMappings(ActionMappings):
    """
    Action mappings given one by one.

    :param mappings: one mapping a row, shape (n, n_target_actions)
    :param n_source_actions: number of actions of the source task; None to take the largest one used plus 1
    :raises ValueError: if the rows are not integers in range
    """

    def __init__(self, mappings: ArrayLike, n_source_actions: int | None = None) -> None:
        array = np.array(mappings)
        if array.ndim != 2 or 0 in array.shape or not np.issubdtype(array.dtype, np.integer):
            raise ValueError(
                f"action mappings must be integers of shape (n, n_target_actions), got {array.dtype} of shape {array.shape}"
            )
        self.mappings: Ints = array.astype(np.int64)
        self.mappings.flags.writeable = False
        self.n_target_actions = int(array.shape[1])
        self.n_source_actions = int(array.max()) + 1 if n_source_actions is None else n_source_actions
        if array.min() < 0 or array.max() >= self.n_source_actions:
            raise ValueError(
                f"action mappings must hold source actions from 0 to {self.n_source_actions - 1}, "
                f"got {int(array.min() if array.min() < 0 else array.max())}"
            )

    @property
    def n_mappings(self) -> int:
        return len(self.mappings)

    def __getitem__(self, index: int) -> tuple[int, ...]:
        self._check_index(index)
        return tuple(self.mappings[index].tolist())

    def count(self, action: int, source_action: int) -> int:
        return int(np.count_nonzero(self.mappings[:, action] == source_action))

    def first(self, action: int, source_action: int) -> int:
        found = np.flatnonzero(self.mappings[:, action] == source_action)
        if not found.size:
            raise self._none_maps(action, source_action)
        return int(found[0])


def paper_icub_actions() -> Ints:
    """The 48 action mappings of the iCub experiment, shape (48, 8); see :meth:`MappingSet.paper_icub`."""
    mappings = []
    for first_joint in combinations(range(4), 2):
        source_joint = [0 if joint in first_joint else 1 for joint in range(4)]
        for others in product((True, False), repeat=3):
            reversed_joint = (True, *others)
            mappings.append([2 * source_joint[j] + (direction ^ reversed_joint[j]) for j in range(4) for direction in (0, 1)])
    return np.array(mappings, dtype=np.int64)


def _count_state_mappings(n_source: int, n_target: int, once: bool, allow_none: bool) -> int:
    if once:
        return perm(max(n_source, n_target), min(n_source, n_target))
    if n_source >= n_target:
        return perm(n_source, n_target)
    # Inclusion and exclusion over the source variables that are left out.
    choices = n_source + allow_none
    return sum((-1) ** k * comb(n_source, k) * (choices - k) ** n_target for k in range(n_source + 1))


def _check_state_mappings(count: int) -> None:
    if count > MAX_STATE_MAPPINGS:
        raise ValueError(
            f"these spaces have {count:,} state mappings of that kind, more than the {MAX_STATE_MAPPINGS:,} that are "
            "practical; give mappings=[InterTaskMapping(...), ...], or a MappingSet of the state mappings of interest"
        )


def _check_positive(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
