"""Experience of one task, in unit coordinates, kept by action for compiled code."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, inlined
from sb3_combrel.common.periodic import difference, flag_array

BLOCK = 8


class Instances(NamedTuple):
    """Instances by action; those of action ``a`` are the first ``size[a]`` along the second axis.

    Experience comes as trajectories, so ``BLOCK`` instances in a row lie close together: the box around each block
    lets a search for near instances skip most blocks.
    """

    state: np.ndarray  # float64, (n_actions, capacity, n_variables)
    effect: np.ndarray  # the same: next state minus state; along a periodic variable the shortest way
    reward: np.ndarray  # float64, (n_actions, capacity)
    terminated: np.ndarray  # bool, (n_actions, capacity): the episode ended in a terminal state, not by a time limit
    size: np.ndarray  # int64, (n_actions,)
    block_low: np.ndarray  # float64, (n_actions, n_variables, capacity / BLOCK): lower corners of the blocks' boxes
    block_high: np.ndarray  # the same: upper corners
    gap: np.ndarray  # float64 scratch, (capacity / BLOCK,): how far a state is from the boxes
    apart: np.ndarray  # float64 scratch, (BLOCK,): squared distances of the instances of a block
    periodic: np.ndarray  # bool, (n_variables,): coordinates of periodic variables are stored wrapped to [0, 1]

    @classmethod
    def empty(
        cls, n_actions: int, n_variables: int, capacity: int = 8 * BLOCK, periodic: Sequence[bool] | np.ndarray | None = None
    ) -> "Instances":
        """:param capacity: of each action, a multiple of BLOCK
        :param periodic: one bool for each state variable; None: none is periodic
        """
        n_blocks = capacity // BLOCK
        return cls(
            state=np.empty((n_actions, capacity, n_variables)),
            effect=np.empty((n_actions, capacity, n_variables)),
            reward=np.empty((n_actions, capacity)),
            terminated=np.zeros((n_actions, capacity), dtype=np.bool_),
            size=np.zeros(n_actions, dtype=np.int64),
            block_low=np.full((n_actions, n_variables, n_blocks), np.inf),
            block_high=np.full((n_actions, n_variables, n_blocks), -np.inf),
            gap=np.empty(n_blocks),
            apart=np.empty(BLOCK),
            periodic=flag_array(periodic, n_variables),
        )

    @classmethod
    def of_rows(
        cls,
        n_actions: int,
        action: np.ndarray,
        state: np.ndarray,
        effect: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
        periodic: Sequence[bool] | np.ndarray | None = None,
    ) -> "Instances":
        """Instances given one a row, in their order; coordinates of periodic variables are wrapped to [0, 1].

        :param action: int64, shape (n,); ``reward`` and ``terminated``, bool: the same
        :param state: shape (n, n_variables); ``effect``: the same
        """
        flags = flag_array(periodic, state.shape[1])
        if flags.any():
            state = np.where(flags, state - np.floor(state), state)
        counts = np.bincount(action, minlength=n_actions)
        made = cls.empty(n_actions, state.shape[1], periodic=flags).enlarged(int(counts.max()))
        made.size[:] = counts
        for a, n in enumerate(counts):
            rows, first = np.flatnonzero(action == a), np.arange(0, n, BLOCK)
            made.state[a, :n], made.effect[a, :n] = state[rows], effect[rows]
            made.reward[a, :n], made.terminated[a, :n] = reward[rows], terminated[rows]
            if n > 0:
                made.block_low[a, :, : len(first)] = np.minimum.reduceat(state[rows], first).T
                made.block_high[a, :, : len(first)] = np.maximum.reduceat(state[rows], first).T
        return made

    @classmethod
    def from_rows(cls, n_actions: int, rows: np.ndarray, periodic: Sequence[bool] | np.ndarray | None = None) -> "Instances":
        """Build them from :meth:`rows`, in the same order for each action; ``periodic``: see :meth:`empty`."""
        d = (rows.shape[1] - 3) // 2
        actions = np.clip(rows[:, 0], 0, n_actions - 1).astype(np.int64)
        states, effects = rows[:, 1 : 1 + d], rows[:, 1 + d : 1 + 2 * d]
        return cls.of_rows(n_actions, actions, states, effects, rows[:, -2], rows[:, -1] > 0.5, periodic)

    def rows(self) -> np.ndarray:
        """Action, state, effect, reward and terminated of each instance, by action: float64, shape (n, 2 n_variables + 3)."""
        columns = self.state, self.effect, self.reward, self.terminated
        sizes = enumerate(self.size.tolist())
        return np.vstack([np.column_stack([np.full(n, a), *(column[a, :n] for column in columns)]) for a, n in sizes])

    @property
    def capacity(self) -> int:
        """Instances of one action for which there is room."""
        return self.state.shape[1]

    def enlarged(self, capacity: int) -> "Instances":
        """The same, or itself, with room for at least so many instances of each action."""
        n_actions, room, n_variables = self.state.shape
        if room >= capacity:
            return self
        while room < capacity:
            room *= 2
        larger = Instances.empty(n_actions, n_variables, room)
        for old, new in zip(self, larger, strict=True):
            new[tuple(slice(n) for n in old.shape)] = old
        return larger


@inlined
def put_instance(instances, transition):
    """Write one instance to its slot, at or before the end of its action's instances.

    :param transition: (action, slot, state, next_state, reward, terminated)
    """
    action, slot, state, next_state, reward, terminated = transition
    block = slot // BLOCK
    for k in range(len(state)):
        at = state[k]
        if instances.periodic[k]:
            at -= np.floor(at)
        instances.state[action, slot, k] = at
        instances.effect[action, slot, k] = difference(next_state[k], state[k], instances.periodic[k])
        instances.block_low[action, k, block] = min(instances.block_low[action, k, block], at)
        instances.block_high[action, k, block] = max(instances.block_high[action, k, block], at)
    instances.reward[action, slot] = reward
    instances.terminated[action, slot] = terminated
    if slot == instances.size[action]:
        instances.size[action] += 1


put_instance_at = EntryPoint(put_instance)


def along_curve(states: np.ndarray) -> np.ndarray:
    """Where each state lies along a curve that fills the space (Morton's): neighbours along it are near each other.

    :param states: unit coordinates, shape (n, n_variables)
    :return: int64, shape (n,)
    """
    d = states.shape[1]
    n_bits = min(16, 62 // d)
    cell = (np.clip(states, 0.0, 1.0) * (2**n_bits - 1)).astype(np.int64)
    key = np.zeros(len(states), dtype=np.int64)
    for bit in reversed(range(n_bits)):
        for k in range(d):
            key = key << 1 | cell[:, k] >> bit & 1
    return key
