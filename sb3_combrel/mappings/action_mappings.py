"""Sequences of action mappings: which source action each target action is mapped to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.common.checks import check_count
from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.mappings.inter_task_mapping import Ints, index_table

MAX_ACTIONS = 1000  # the numbers of mappings, which are computed with, have at most 3,000 digits

# Finding a member takes a number of steps in proportion to the third power of the number of actions.
MAX_BALANCED_ACTIONS = 100


class ActionMappings(ABC):
    """A sequence of action mappings, each a tuple with the source action of every target action."""

    n_source_actions: int
    n_target_actions: int

    @property
    @abstractmethod
    def n_mappings(self) -> int:
        """Number of action mappings; may exceed what ``len`` can return."""

    @abstractmethod
    def __getitem__(self, index: int) -> tuple[int, ...]:
        """The action mapping of that number, from 0 to ``n_mappings - 1``."""

    def source_actions_for(self, action: int) -> Ints:
        """The source actions that target action ``action`` is mapped to by some mapping, ascending; unless overridden, all."""
        return np.arange(self.n_source_actions, dtype=np.int64)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < self.n_mappings:
            raise IndexError(f"action mapping {index} does not exist, there are {self.n_mappings}")


@dataclass(frozen=True)
class AllActionMappings(ActionMappings):
    """All functions from target actions to source actions, in lexicographic order; nothing is stored."""

    n_source_actions: int
    n_target_actions: int

    def __post_init__(self) -> None:
        check_count("n_source_actions", self.n_source_actions, max=MAX_ACTIONS)
        check_count("n_target_actions", self.n_target_actions, max=MAX_ACTIONS)

    @property
    def n_mappings(self) -> int:
        return self.n_source_actions**self.n_target_actions

    def __getitem__(self, index: int) -> tuple[int, ...]:
        self._check_index(index)
        n = self.n_source_actions
        return tuple(index // n**place % n for place in reversed(range(self.n_target_actions)))


@dataclass(frozen=True)
class BalancedActionMappings(ActionMappings):
    """The functions that use the source actions as equally as possible (Section 5.1), in lexicographic order, not stored."""

    n_source_actions: int
    n_target_actions: int

    def __post_init__(self) -> None:
        why = "of balanced action mappings"
        check_count("n_source_actions", self.n_source_actions, max=MAX_BALANCED_ACTIONS, why_max=why)
        check_count("n_target_actions", self.n_target_actions, max=MAX_BALANCED_ACTIONS, why_max=why)

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

    def _completions(self, chosen: Sequence[int]) -> int:
        """Number of balanced mappings that begin with ``chosen``."""
        usage = np.bincount(np.array(chosen, dtype=np.int64), minlength=self.n_source_actions)
        return _balanced_completions(tuple(sorted(usage.tolist())), self.n_target_actions)


@lru_cache(maxsize=4096)
def _balanced_completions(usage: tuple[int, ...], n_target: int) -> int:
    """Number of balanced mappings with a given beginning, which used the source actions so many times."""
    n_each, n_extra = divmod(n_target, len(usage))
    # ways[e]: distributions of the free positions over the source actions so far, e of which are used n_each + 1 times.
    ways = {0: (1, n_target - sum(usage))}
    for used in usage:
        following: dict[int, tuple[int, int]] = {}
        for extra, (count, free) in ways.items():
            for more in (0, 1):
                needed = n_each + more - used
                if needed < 0 or needed > free or extra + more > n_extra:
                    continue
                before = following.get(extra + more, (0, 0))[0]
                following[extra + more] = (before + count * comb(free, needed), free - needed)
        ways = following
    return ways.get(n_extra, (0, 0))[0]


class ListedActionMappings(ActionMappings):
    """Action mappings given one by one, one a row, shape (n, n_target_actions); ``ValueError`` for anything else."""

    def __init__(self, mappings: ArrayLike, n_source_actions: int | None = None) -> None:
        array = index_table("action mappings", mappings, "(n, n_target_actions)")
        check_count("n_source_actions", n_source_actions, none_allowed=True)
        self.mappings: Ints = array
        array.flags.writeable = False
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

    def source_actions_for(self, action: int) -> Ints:
        return np.unique(self.mappings[:, action])


def paper_icub_actions() -> Ints:
    """The 48 action mappings of the iCub experiment, shape (48, 8); see :meth:`MappingSet.paper_icub`."""
    mappings = []
    for first_joint, others in product(combinations(range(4), 2), product((True, False), repeat=3)):
        source_joint, reversed_joint = [0 if joint in first_joint else 1 for joint in range(4)], (True, *others)
        mappings.append([2 * source_joint[j] + (direction ^ reversed_joint[j]) for j in range(4) for direction in (0, 1)])
    return np.array(mappings, dtype=np.int64)


for _kind in (AllActionMappings, BalancedActionMappings):
    register_writer(_kind, lambda actions: (type(actions).__name__, dict(vars(actions))))
    register_reader(_kind.__name__, _kind)
register_writer(
    ListedActionMappings,
    lambda actions: ("ListedActionMappings", {"mappings": actions.mappings, "n_source_actions": actions.n_source_actions}),
)
register_reader("ListedActionMappings", ListedActionMappings)
