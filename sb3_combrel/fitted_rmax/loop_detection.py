"""What an evaluation remembers of its episode: where it has been, and whether what the model promises comes true."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from sb3_combrel.common.instances import InstanceArrays
from sb3_combrel.common.transferred import Supply
from sb3_combrel.planning.corrections import CELL_OFFSET, CELLS_PER_GRID_CELL, PATIENCE
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.q_values import QueryScratch

# Ways to act, in the order in which they are tried, over and over: without optimism; known actions first, but with
# optimistic values of where they lead; as in learning.
TRUSTING, HOPEFUL, TRYING = range(3)


class EpisodeMemory:
    """Notices that an evaluation goes round in circles, and says how to act then.

    Where data are few a model may promise progress that doesn't come. Learning would find out; a policy that learns no
    more would try the same for ever. While a model is right, values rise on the way by what is *hoped* for with each step,
    (1 - gamma) Q - reward. An agent that is in the same small cell more than ``PATIENCE`` times, and whose value has not
    risen by half of what was hoped for since the first of them, hopes in vain: it tries the next way to act. Where it is
    good to stay, as with a pole in balance, nothing is hoped for.
    """

    def __init__(self) -> None:
        self._n_doubts = 0
        self._seen: dict[Hashable, tuple[int, tuple[float, float, float]]] = {}
        self._hoped = self._at_stake = 0.0

    @property
    def mode(self) -> int:
        """How to act: TRUSTING, HOPEFUL or TRYING."""
        return self._n_doubts % 3

    def note(self, cell: Hashable, value: float, reward: float, gamma: float) -> None:
        """
        Note a step that is about to be made.

        :param cell: where (see :func:`small_cell`)
        :param value: Q of the chosen action
        :param reward: what the model predicts of it
        """
        visits, before = self._seen.get(cell, (0, (value, self._hoped, self._at_stake)))
        self._seen[cell] = visits + 1, before
        if visits >= PATIENCE and (self.mode != TRUSTING or self._in_vain(value, *before)):
            self._n_doubts += 1
            self._seen.clear()
        self._hoped += (1.0 - gamma) * value - reward
        self._at_stake += (1.0 - gamma) * abs(value) + abs(reward)

    def _in_vain(self, value: float, value_before: float, hoped_before: float, at_stake_before: float) -> bool:
        """Whether the value should have risen since an earlier visit, and has not by half of it."""
        hoped = self._hoped - hoped_before
        # Where it is good to stay the two parts of what is hoped for cancel out, but for errors.
        return hoped > 0.5 * (self._at_stake - at_stake_before) and value - value_before < 0.5 * hoped


def memories(state: Sequence[Any] | None, episode_start: np.ndarray | None, n: int) -> list[EpisodeMemory]:
    """
    The memories of ``n`` episodes: those that ``predict`` returned as its state, new ones where an episode begins.

    :raises ValueError: if ``state`` is something else
    """
    if state is None:
        return [EpisodeMemory() for _ in range(n)]
    held = list(state[0]) if len(state) == 1 else []
    if len(held) != n or not all(isinstance(memory, EpisodeMemory) for memory in held):
        raise ValueError(f"state must be None or what predict returned for {n} observation(s), got {state!r}")
    begins = np.zeros(n, dtype=np.bool_) if episode_start is None else np.broadcast_to(episode_start, n)
    return [EpisodeMemory() if new else memory for memory, new in zip(held, begins, strict=True)]


def small_cell(state: np.ndarray, grid: StateGrid) -> Hashable:
    """The small cell around a state (unit coordinates), of the size of those of the corrections."""
    return (state * grid.arrays.cells * CELLS_PER_GRID_CELL + CELL_OFFSET).astype(np.int64).tobytes()


def predicted_reward(action: int, instances: InstanceArrays, query: QueryScratch, supply: Supply, threshold: float) -> float:
    """What the instances in ``query``, and those of ``supply`` if they are needed, predict for an action; 0 without any."""
    n, total = query.length[action], query.total[action]
    reward = query.weight[action, :n] @ instances.reward[action, query.index[action, :n]]
    if total < threshold:
        n_supplied = supply.count[action]
        weights = supply.weight[action, :n_supplied]
        total += weights.sum()
        reward += weights @ supply.reward[action, :n_supplied]
    return float(reward / total) if total > 0.0 else 0.0
