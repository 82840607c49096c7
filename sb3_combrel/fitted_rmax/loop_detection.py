"""What an evaluation stores of its episode, so as to notice that it is caught in a loop."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from sb3_combrel.planning.corrections import CELL_OFFSET, CELLS_PER_GRID_CELL, MAX_VISITS
from sb3_combrel.planning.grid import StateGrid

# How actions are chosen: without optimism; known actions first, but with optimistic values of where they lead; as in learning.
EXPLOIT, OPTIMISTIC, EXPLORE = range(3)
# The order in which it is tried, over and over.
ORDER = (EXPLOIT, OPTIMISTIC, EXPLORE)
# Where a source bounds what is unknown, optimism is well founded, and little is known beside the agent's way.
ORDER_WITH_BOUNDS = (EXPLORE, OPTIMISTIC, EXPLOIT)


class EpisodeMemory:
    """Notices that an evaluation is caught in a loop, and changes how actions are chosen.

    Where data are few a model may predict progress that does not happen, and a policy that learns no more would repeat the
    same for ever. While a model is right, values rise along the way by what is *expected* with each step,
    (1 - gamma) Q - reward. An agent is caught in a loop when it is in the same small cell more than ``MAX_VISITS`` times, and
    its value has not risen by half of what was expected since the first of them. Where it is good to stay none is expected.
    """

    def __init__(self) -> None:
        self._n_loops = 0
        self._seen: dict[Hashable, tuple[int, tuple[float, float, float]]] = {}
        self._expected = self._at_stake = 0.0

    @property
    def attempt(self) -> int:
        """Which manner of choosing actions is due: a place in :data:`ORDER` or :data:`ORDER_WITH_BOUNDS`."""
        return self._n_loops % len(ORDER)

    def note(self, cell: Hashable, value: float, reward: float, gamma: float) -> None:
        """Note a step that is about to be made: its small cell, Q of the action, and the reward that the model predicts."""
        visits, before = self._seen.get(cell, (0, (value, self._expected, self._at_stake)))
        self._seen[cell] = visits + 1, before
        if visits >= MAX_VISITS and (self.attempt > 0 or self._no_progress(value, *before)):
            self._n_loops += 1
            self._seen.clear()
        self._expected += (1.0 - gamma) * value - reward
        self._at_stake += (1.0 - gamma) * abs(value) + abs(reward)

    def _no_progress(self, value: float, value_before: float, expected_before: float, at_stake_before: float) -> bool:
        """Whether the value should have risen since an earlier visit, and has not by half of it."""
        expected = self._expected - expected_before
        # Where it is good to stay the two parts of what is expected cancel out, but for errors.
        return expected > 0.5 * (self._at_stake - at_stake_before) and value - value_before < 0.5 * expected


def manner(memory: EpisodeMemory | None, is_bounded: bool) -> int:
    """How actions are chosen in an evaluation; ``is_bounded``: a source bounds what is unknown."""
    return (ORDER_WITH_BOUNDS if is_bounded else ORDER)[0 if memory is None else memory.attempt]


def memories(state: Sequence[Any] | None, episode_start: np.ndarray | None, n: int) -> list[EpisodeMemory]:
    """Memories of ``n`` episodes from what ``predict`` returned, new where one begins; a ValueError if it did not."""
    if state is None:
        return [EpisodeMemory() for _ in range(n)]
    given = list(state[0]) if len(state) == 1 else []
    if len(given) != n or not all(isinstance(memory, EpisodeMemory) for memory in given):
        raise ValueError(f"state must be None or what predict returned for {n} observation(s), got {state!r}")
    begins = np.zeros(n, dtype=np.bool_) if episode_start is None else np.broadcast_to(episode_start, n)
    return [EpisodeMemory() if new else memory for memory, new in zip(given, begins, strict=True)]


def small_cell(state: np.ndarray, grid: StateGrid) -> Hashable:
    """The small cell around a state (unit coordinates), of the size of those of the corrections."""
    n_cells = grid.arrays.cells * CELLS_PER_GRID_CELL
    cell = np.floor(state * n_cells + CELL_OFFSET) if grid.arrays.periodic.any() else state * n_cells + CELL_OFFSET
    return np.where(grid.arrays.periodic, cell % n_cells, cell).astype(np.int64).tobytes()
