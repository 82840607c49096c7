"""Fitted R-Max's kernel model: T and R of every state-action pair of the grid, from instances."""

from typing import Any

import numpy as np

from sb3_combrel.common.compiled import SameTypes
from sb3_combrel.common.instances import InstanceArrays
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.list_store import Pool
from sb3_combrel.common.transferred import Supply
from sb3_combrel.models.kernel_lists import (
    ModelArrays,
    Scratch,
    enter,
    leave_lists,
    renew_predecessors,
    settle,
)
from sb3_combrel.models.refilling import in_neighbourhoods, note_effects, refill_lists
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.transfer.base import Transfer

MOST_PAIRS_AT_ONCE = 4096
NO_PAIRS = np.empty(0, dtype=np.int64)
# Part of the threshold by which own weight must have changed before a pair that draws on transferred instances is settled
# anew within an episode: an instance that hardly counts among them would have hundreds of pairs translated and planned.
NEWS = 0.5
# A time limit reached this often is taken as it comes; each further time the threshold shrinks by the factor.
EPISODES_OF_PATIENCE = 10
IMPATIENCE = 0.98


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
        self.full_threshold = self.exploration_threshold = float(exploration_threshold)
        self.gamma = float(gamma)
        self.transfer = transfer
        self.max_instances = max_instances
        self.instances = InstanceArrays.empty(n_actions, grid.n_variables)
        self.arrays = ModelArrays(
            lists=Pool.empty(n_pairs, 1 << 12),
            rows=Pool.empty(n_pairs, 1 << 14),
            predecessors=Pool.empty(grid.n_points, 1 << 14),
            entry=np.zeros(n_pairs),
            total=np.zeros(n_pairs),
            known=np.zeros(n_pairs, dtype=np.bool_),
            settled=np.zeros(n_pairs, dtype=np.bool_),
            reward=np.zeros(n_pairs),
            heard=np.zeros(n_pairs),
            n_optimistic=np.full(grid.n_points, n_actions, dtype=np.int64),
            **self._of_instances(),
        )
        self._kernel = (float(model_breadth), float(min_weight), float(min_fraction))
        self.scratch = Scratch.for_grid(grid)
        self._enter_lists, self._settle = SameTypes(enter), SameTypes(settle)
        self._progress = np.empty(3, dtype=np.int64)
        self._no_supply = Supply.empty(MOST_PAIRS_AT_ONCE, grid.n_variables)
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
        :return: the pairs to be settled anew, int64: those whose lists changed, but with a transfer method only known ones
            and those with news; the others may wait (see :meth:`waiting`)
        """
        slot, without = self._slot_for(action)
        changed = self._enter(action, slot, state, next_state, reward, terminated)
        return changed if len(without) == 0 else np.union1d(without, changed)

    def _slot_for(self, action: int) -> tuple[int, np.ndarray]:
        """Where a new instance goes, and the pairs that lost one to make room."""
        count = int(self.instances.count[action])
        if self.max_instances is not None and count >= self.max_instances:
            slot = int(self.arrays.members[action, :count].argmin())
            return slot, self._leave(action, slot)
        self.instances = self.instances.with_room(action)
        room = self.arrays.members.shape[1]
        if room < self.instances.capacity:
            larger = self._of_instances()
            for name, array in larger.items():
                array[:, :room] = getattr(self.arrays, name)
            self.arrays = self.arrays.replace(**larger)
        return count, NO_PAIRS

    def _of_instances(self) -> dict[str, Any]:
        """Those of the model's arrays that have a place for each instance, empty."""
        d, places = self.grid.n_variables, (self.n_actions, self.instances.capacity)
        return dict(
            members=np.zeros(places, dtype=np.int32),
            corner_low=np.zeros((*places, d), dtype=np.int32),
            corner_offset=np.zeros((*places, 2**d), dtype=np.int32),
            corner_weight=np.zeros((*places, 2**d)),
        )

    def _enter(
        self, action: int, slot: int, state: np.ndarray, next_state: np.ndarray, reward: float, terminated: bool
    ) -> np.ndarray:
        """Put an instance into its slot and into the lists it reaches; of these pairs, those to be settled anew."""
        threshold = self.exploration_threshold
        news = 0.0 if self.transfer is None else NEWS * threshold
        self._progress[:] = -1, 0, 0
        while not self._enter_lists(
            self.instances,
            self.arrays,
            self.grid.arrays,
            self._kernel,
            (threshold, news),
            action,
            slot,
            state,
            next_state,
            reward,
            terminated,
            self.scratch,
            self._progress,
        ):
            self.make_room()
        return self.scratch.point[: self._progress[2]] + action * self.grid.n_points

    def make_room(self) -> None:
        """Grow the pools that were too small for what was last asked of them."""
        pools = {name: getattr(self.arrays, name).with_room() for name in ("lists", "rows", "predecessors")}
        self.arrays = self.arrays.replace(**pools)

    def _leave(self, action: int, slot: int) -> np.ndarray:
        if self.arrays.members[action, slot] == 0:
            return NO_PAIRS
        rest = (self._kernel, action, slot, np.zeros(self.grid.n_points), self.scratch)
        changed = leave_lists(self.instances, self.arrays, self.grid.arrays, *rest)
        return self.scratch.point[:changed] + action * self.grid.n_points

    def lower_threshold(self, n_truncated: int) -> np.ndarray:
        """Be content with less weight after so many episodes that ran into their time limit.

        Where the kernel is so narrow that all that is within an episode's reach cannot become known, exploration would
        otherwise go on for ever. In the end any instance that counts at all will do.

        :return: the pairs that become known by that, to be settled anew
        """
        lowered = self.full_threshold * IMPATIENCE ** max(0, n_truncated - EPISODES_OF_PATIENCE)
        self.exploration_threshold = max(lowered, min(self.full_threshold, self.min_weight))
        newly_known = np.flatnonzero(~self.arrays.known & (self.arrays.total >= self.exploration_threshold))
        self.arrays.known[newly_known] = True
        return newly_known

    def waiting(self) -> np.ndarray:
        """The pairs that are not known and whose own weight has changed since they were settled."""
        arrays = self.arrays
        return np.flatnonzero(~arrays.known & (arrays.total != arrays.heard))

    def settle(self, pairs: np.ndarray) -> None:
        """Bring the rows of ``pairs`` up to date: with their lists, and with what transfer has for them."""
        for first in range(0, len(pairs), MOST_PAIRS_AT_ONCE):
            some = pairs[first : first + MOST_PAIRS_AT_ONCE]
            supply = self.supply_for(some)
            done = 0
            while done < len(some):
                done = self._settle(
                    self.arrays,
                    self.instances,
                    self.grid.arrays,
                    self.gamma,
                    some,
                    done,
                    supply,
                    self.scratch,
                )
                if done < len(some):
                    self.make_room()

    def supply_for(self, pairs: np.ndarray) -> Supply:
        """Transferred instances for ``pairs``, at most ``MOST_PAIRS_AT_ONCE``."""
        if self.transfer is None:
            return self._no_supply
        known = self.arrays.known[pairs]
        if known.all():
            return self._no_supply
        supply = self.transfer.supply(pairs, self.arrays.total[pairs], known)
        supply.check(len(pairs), self.grid.n_variables, self.transfer)
        return supply

    def renew_predecessors(self) -> None:
        """Forget predecessors that no row needs any more."""
        while not renew_predecessors(self.arrays):
            self.make_room()

    def restore(self, listed: np.ndarray, known: np.ndarray, total: np.ndarray) -> None:
        """Rebuild lists and rows after instances were written to :attr:`instances` directly.

        :param listed: the instances that stood in any list, bool, shape (n_instances,), by action
        :param known: the pairs that were known when the instances were saved, bool, shape (n_pairs,)
        :param total: the sums of their weights, shape (n_pairs,); used where they differ from the new ones by rounding only
        """
        self.arrays = self.arrays.replace(**self._of_instances())
        note_effects(self.instances, self.arrays, self.grid.arrays)
        scratch = np.empty(self.grid.n_variables), np.empty(self.list_room, np.int32), np.empty(self.list_room)
        search = (
            *in_neighbourhoods(self.instances, listed),
            self.grid.arrays,
            self._kernel,
            self.exploration_threshold,
            *scratch,
        )
        pair = 0
        while (pair := refill_lists(self.arrays, *search, pair)) < len(known):
            self.make_room()
        arrays = self.arrays
        same = np.abs(total - arrays.total) <= 1e-9 * arrays.total
        arrays.total[same] = total[same]
        listed = np.flatnonzero(arrays.lists.length > 0)
        last = arrays.lists.weight[arrays.lists.start[listed] + arrays.lists.length[listed] - 1]
        arrays.entry[listed] = np.minimum(last, self.min_fraction * arrays.total[listed])
        arrays.known[listed] |= known[listed]
        self.settle(np.arange(len(known)))
