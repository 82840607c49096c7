"""Fitted R-Max's kernel model: T and R of every state-action pair of the grid, from instances."""

import numpy as np

from sb3_combrel.common.instances import InstanceArrays, put_instance
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.pool import Pool
from sb3_combrel.common.supply import Supply
from sb3_combrel.fitted_rmax.grid import StateGrid
from sb3_combrel.fitted_rmax.model_kernels import (
    ModelArrays,
    Scratch,
    enter_lists,
    extend_reach,
    leave_lists,
    points_in_reach,
    settle,
)
from sb3_combrel.transfer.base import Transfer

MOST_PAIRS_AT_ONCE = 4096


class KernelModel:
    """The model of Jong & Stone (2007), one for each action, kept up to date instance by instance.

    Everything is in unit coordinates. A pair is *known* once the kernel weights of its own kept instances reach the
    threshold, and stays known: a nearer instance can shorten the list (``min_fraction``), which is a better
    model, not less knowledge. A pair that is not known can be *settled* by transferred instances; if it is not, it
    is optimistic.

    :param grid: the finite sample of states
    :param n_actions: number of actions
    :param model_breadth: kernel breadth b in exp(-d^2 / b^2)
    :param min_weight: instances with less weight do not count
    :param min_fraction: nearest first, an instance counts while it has this part of the weight before it
    :param exploration_threshold: weight that makes a pair known
    :param gamma: discount factor
    :param transfer: where to get instances for pairs that are not known
    :param max_instances: of one action; beyond it the instance that stands in the fewest lists gives way
    """

    def __init__(
        self,
        grid: StateGrid,
        n_actions: int,
        *,
        model_breadth: float,
        min_weight: float,
        min_fraction: float,
        exploration_threshold: float,
        gamma: float,
        transfer: Transfer | None = None,
        max_instances: int | None = None,
    ):
        n_pairs = n_actions * grid.n_points
        self.grid = grid
        self.n_actions = n_actions
        self.model_breadth = model_breadth
        self.min_weight = min_weight
        self.min_fraction = min_fraction
        self.exploration_threshold = exploration_threshold
        self.gamma = gamma
        self.transfer = transfer
        self.max_instances = max_instances
        self.instances = InstanceArrays.empty(n_actions, grid.n_variables)
        self.arrays = ModelArrays(
            lists=Pool.empty(n_pairs, 1 << 12),
            rows=Pool.empty(n_pairs, 1 << 14),
            entry=np.zeros(n_pairs),
            total=np.zeros(n_pairs),
            known=np.zeros(n_pairs, dtype=np.bool_),
            settled=np.zeros(n_pairs, dtype=np.bool_),
            reward=np.zeros(n_pairs),
            n_optimistic=np.full(grid.n_points, n_actions, dtype=np.int64),
            members=np.zeros((n_actions, self.instances.capacity), dtype=np.int32),
        )
        self.reach_low = np.zeros(grid.n_variables, dtype=np.int64)
        self.reach_high = np.zeros(grid.n_variables, dtype=np.int64)
        self._scratch = Scratch.for_grid(grid)
        self._no_supply = Supply.none(MOST_PAIRS_AT_ONCE, grid.n_variables)
        self.list_room = list_room(min_fraction)

    @property
    def n_instances(self) -> int:
        """Instances held, of all actions."""
        return int(self.instances.count.sum())

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        """Take up one transition.

        :param state: unit coordinates, shape (n_variables,)
        :param next_state: the same
        :param terminated: the episode ended in a terminal state; a time limit is none
        :return: the pairs whose model changed, int64
        """
        slot, without = self._slot_for(action)
        put_instance(self.instances, action, slot, state, next_state, reward, terminated)
        self._extend_reach(next_state - state)
        changed = self._enter(state, action, slot)
        return changed if len(without) == 0 else np.union1d(without, changed)

    def _slot_for(self, action: int) -> tuple[int, np.ndarray]:
        """Where a new instance goes, and the pairs that lost one to make room."""
        count = int(self.instances.count[action])
        if self.max_instances is not None and count >= self.max_instances:
            slot = int(self.arrays.members[action, :count].argmin())
            return slot, self._leave(action, slot)
        self.instances = self.instances.with_room(action)
        if self.arrays.members.shape[1] < self.instances.capacity:
            members = np.zeros((self.n_actions, self.instances.capacity), dtype=np.int32)
            members[:, : self.arrays.members.shape[1]] = self.arrays.members
            self.arrays = self.arrays._replace(members=members)
        return count, np.empty(0, dtype=np.int64)

    def _enter(self, state: np.ndarray, action: int, slot: int) -> np.ndarray:
        n_points = self.grid.n_points
        entry = self.arrays.entry[action * n_points : (action + 1) * n_points]
        found = points_in_reach(state, self.model_breadth, self.min_weight, self.grid.arrays, entry, self._scratch)
        done = 0
        while True:
            done = enter_lists(
                self.arrays, action, slot, found, done, self.min_fraction, self.exploration_threshold, self._scratch
            )
            if done == found:
                return self._scratch.point[:found] + action * n_points
            self.arrays = self.arrays._replace(lists=self.arrays.lists.grown())

    def _leave(self, action: int, slot: int) -> np.ndarray:
        if self.arrays.members[action, slot] == 0:
            return np.empty(0, dtype=np.int64)
        state = self.instances.state[action, slot]
        anywhere = np.zeros(self.grid.n_points)
        found = points_in_reach(state, self.model_breadth, self.min_weight, self.grid.arrays, anywhere, self._scratch)
        changed = leave_lists(self.arrays, action, slot, found, self.min_fraction, self._scratch)
        return self._scratch.point[:changed] + action * self.grid.n_points

    def _extend_reach(self, effect: np.ndarray) -> None:
        extend_reach(effect, self.grid.arrays.cells, self.reach_low, self.reach_high)

    def settle(self, pairs: np.ndarray) -> None:
        """Bring the rows of ``pairs`` up to date: with their lists, and with what transfer has for them."""
        for first in range(0, len(pairs), MOST_PAIRS_AT_ONCE):
            some = pairs[first : first + MOST_PAIRS_AT_ONCE]
            supply = self._supply_for(some)
            done = 0
            while done < len(some):
                done = settle(
                    self.arrays,
                    self.instances,
                    self.grid.arrays,
                    self.gamma,
                    some,
                    done,
                    supply,
                    self.reach_low,
                    self.reach_high,
                    self._scratch,
                )
                if done < len(some):
                    self.arrays = self.arrays._replace(rows=self.arrays.rows.grown())

    def _supply_for(self, pairs: np.ndarray) -> Supply:
        if self.transfer is None:
            return self._no_supply
        return self.transfer.supply(pairs, self.arrays.total[pairs], self.arrays.known[pairs])

    def restore(self, known: np.ndarray) -> None:
        """Rebuild lists and rows after instances were written to :attr:`instances` directly.

        :param known: the pairs that were known when the instances were saved, bool, shape (n_pairs,)
        """
        arrays = self.arrays
        self.arrays = arrays._replace(members=np.zeros((self.n_actions, self.instances.capacity), dtype=np.int32))
        for action in range(self.n_actions):
            for slot in range(self.instances.count[action]):
                self._enter(self.instances.state[action, slot], action, slot)
            if self.instances.count[action]:
                effects = self.instances.effect[action, : self.instances.count[action]]
                self._extend_reach(effects.min(axis=0))
                self._extend_reach(effects.max(axis=0))
        self.arrays.known[:] |= known & (self.arrays.lists.length > 0)
        self.settle(np.arange(len(known)))
