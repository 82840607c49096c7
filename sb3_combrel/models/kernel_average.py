"""The kernel average of Jong & Stone (2007): reward and relative effects as weighted means of the instances near a state."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_combrel.common.compiled import EntryPoint
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.list_store import ListStore
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import NO_PAIRS, InstanceTransfer, ModelSettings
from sb3_combrel.models.compiled_model import MIN_CHANGE, CompiledModel
from sb3_combrel.models.kernel_lists import (
    KernelLists,
    ReachScratch,
    enter_plain,
    leave_lists,
    update_rows_plain,
)
from sb3_combrel.models.kernel_prediction import NearLists, join_transferred_plain, predict_own_plain
from sb3_combrel.models.kernel_refill import in_neighbourhoods, note_all_effects, refill_all_lists
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.q_values import Prediction

_enter, _leave_lists, _update_rows = EntryPoint(enter_plain), EntryPoint(leave_lists), EntryPoint(update_rows_plain)
_predict_own, _join_transferred = EntryPoint(predict_own_plain), EntryPoint(join_transferred_plain)


class KernelAverage(CompiledModel):
    """
    The model of Jong & Stone (2007), one for each action, incremental.

    An instance at distance d (unit coordinates) weighs exp(-d^2 / breadth^2). Instances that weigh less than ``min_weight``
    do not count; of the others, nearest first, one counts while its weight is at least ``min_fraction`` of the sum of those
    before it. A nearer instance can so shorten the list of a known pair, which is a better model, not less knowledge: the
    pair stays known. With ``max_instances``, the instance in the fewest lists is replaced.

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        grid = self.grid
        d, n_points, n_pairs = grid.n_variables, grid.n_points, self.n_actions * grid.n_points
        lists = KernelLists(
            lists=ListStore.empty(n_pairs, 1 << 12),
            entry=np.zeros(n_pairs),
            total=self.own_weight,
            last_total=np.zeros(n_pairs),
            known=self.known,
            **self._of_instances(),
        )
        self._set_arrays(lists)
        self._kernel = (float(settings.model_breadth), float(settings.min_weight), float(settings.min_fraction))
        self._scratch = scratch = ReachScratch(
            kernel=np.empty((d, int(grid.arrays.shape.max()))),
            at=np.empty((3, d), dtype=np.int64),
            point=np.empty(n_points, dtype=np.int64),
            weight=np.empty(n_points),
        )
        self._plain_scratch = tuple(scratch)
        self._progress = np.empty(3, dtype=np.int64)
        self._list_room = room = list_room(settings.min_fraction)
        self._near = NearLists(
            item=np.empty((self.n_actions, room), dtype=np.int32),
            weight=np.empty((self.n_actions, room)),
            length=np.zeros(self.n_actions, dtype=np.int64),
        )
        self._plain_near = tuple(self._near)
        self._make_prediction(room)

    # Plain tuples for compiled code are made once, not at every step (see ``common.compiled``).

    def _set_arrays(self, arrays: KernelLists) -> None:
        self.arrays, self._plain_arrays = arrays, arrays.plain()

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        """
        Add one transition (see :meth:`Model.add`).

        :return: the pairs whose lists changed, but with a transfer method only known ones and those whose weight has changed
            enough; the others may wait (see :meth:`outdated`)
        """
        slot, without = self._slot_for(action)
        changed = self._enter((action, slot, state, next_state, reward, terminated))
        return changed if len(without) == 0 else np.union1d(without, changed)

    def _slot_for(self, action: int) -> tuple[int, np.ndarray]:
        """Where a new instance goes, and the pairs that lost one to make room."""
        instances = self._instances
        size = int(instances.size[action])
        if self.settings.max_instances is not None and size >= self.settings.max_instances:
            slot = int(self.arrays.n_lists[action, :size].argmin())
            return slot, self._leave(action, slot)
        if size == instances.capacity:
            self.instances = instances.with_room(action)
            room = self.arrays.n_lists.shape[1]
            larger = self._of_instances()
            for name, array in larger.items():
                array[:, :room] = getattr(self.arrays, name)
            self._set_arrays(self.arrays._replace(**larger))
        return size, NO_PAIRS

    def _of_instances(self) -> dict[str, Any]:
        """Those of the arrays that have an entry for each instance, empty."""
        d, shape = self.grid.n_variables, (self.n_actions, self.instances.capacity)
        return dict(
            n_lists=np.zeros(shape, dtype=np.int32),
            corner_low=np.zeros((*shape, d), dtype=np.int32),
            corner_offset=np.zeros((*shape, 2**d), dtype=np.int32),
            corner_weight=np.zeros((*shape, 2**d)),
        )

    def _enter(self, transition: tuple[Any, ...]) -> np.ndarray:
        """Put an instance into its slot and into the lists that it reaches; the pairs whose rows are to be updated."""
        threshold = self.exploration_threshold
        thresholds = threshold, 0.0 if self.transfer is None else MIN_CHANGE * threshold
        self._progress[:] = -1, 0, 0
        instances, grid, scratch = self._plain_instances, self.grid.plain, self._plain_scratch
        while not _enter.call(
            instances, self._plain_arrays, grid, self._kernel, thresholds, transition, scratch, self._progress
        ):
            self._make_room()
        return self._scratch.point[: self._progress[2]] + transition[0] * self.grid.n_points

    def _make_room(self) -> None:
        self._set_arrays(self.arrays._replace(lists=self.arrays.lists.with_room()))

    def _leave(self, action: int, slot: int) -> np.ndarray:
        if self.arrays.n_lists[action, slot] == 0:
            return NO_PAIRS
        anywhere = np.zeros(self.grid.n_points)
        grid = self.grid.arrays
        changed = _leave_lists.call(self.instances, self.arrays, grid, self._kernel, action, slot, anywhere, self._scratch)
        return self._scratch.point[:changed] + action * self.grid.n_points

    def outdated(self) -> np.ndarray:
        arrays = self.arrays
        return np.flatnonzero(~arrays.known & (arrays.total != arrays.last_total))

    def update_rows(self, pairs: np.ndarray) -> None:
        mdp, instances, arrays = self.mdp, self._instances, self._plain_arrays
        transferred = tuple(self._transferred_to(pairs))
        outcomes = instances.effect, instances.reward, instances.terminated
        done = 0
        while done < len(pairs):
            query, grid, scratch = (pairs, done), self.grid.plain, mdp.plain_scratch
            done = _update_rows.call(arrays, outcomes, mdp.plain, grid, mdp.gamma, query, transferred, scratch)
            if done < len(pairs):
                mdp.make_room()

    def _predict_own(self, state: np.ndarray) -> float:
        """Fill the prediction from the own instances; the least weight that an action has."""
        near, prediction = self._plain_near, self._plain_prediction
        threshold = self.exploration_threshold
        return float(_predict_own.call(self._plain_instances, state, self._kernel, threshold, near, prediction))

    def predict_at(self, state: np.ndarray) -> tuple[Prediction, TransferredInstances | None]:
        if self._predict_own(state) >= self.exploration_threshold or self.transfer is None:
            return self._prediction, None
        actions = np.arange(self.n_actions)
        states = np.repeat(state[None], self.n_actions, axis=0)
        given = self.transfer.transferred(states, actions, self._prediction.weight)
        self._check(given, self._prediction.weight)
        room = self._list_room + given.weight.shape[1]
        if room > self._prediction.probability.shape[1]:
            self._make_prediction(room)
            self._predict_own(state)
        near, prediction = self._plain_near, self._plain_prediction
        _join_transferred.call(self._plain_instances, near, tuple(given), self.exploration_threshold, prediction)
        return self._prediction, given

    def get_state(self) -> dict[str, np.ndarray]:
        state = super().get_state()
        listed = [self.arrays.n_lists[action, :size] > 0 for action, size in enumerate(self.instances.size.tolist())]
        state["instances"][:, -1] = np.concatenate(listed)
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """
        Rebuild lists and rows from the instances.

        The saved weights are used where they differ from the new ones by rounding only, and pairs that were known stay known.
        """
        rows, known, total = state["instances"], state["known"] > 0.5, state["total"]
        rows = rows[np.argsort(np.clip(rows[:, 0], 0, self.n_actions - 1), kind="stable")]
        self.instances = Instances.from_rows(self.n_actions, rows[:, :-1], self.grid.arrays.periodic)
        self._set_arrays(self.arrays._replace(**self._of_instances()))
        grid, arrays = self.grid.arrays, self.arrays
        note_all_effects.call(self.instances, arrays, grid)
        neighbours, slots = in_neighbourhoods(self.instances, rows[:, -1] > 0.5)
        scratch = np.empty(grid.shape.size), np.empty(self._list_room, np.int32), np.empty(self._list_room)
        threshold, pair = self.exploration_threshold, 0
        while (
            pair := refill_all_lists.call(self.arrays, neighbours, slots, grid, self._kernel, threshold, scratch, pair)
        ) < len(known):
            self._make_room()
        arrays = self.arrays
        same = np.abs(total - arrays.total) <= 1e-9 * arrays.total
        arrays.total[same] = total[same]
        listed = np.flatnonzero(arrays.lists.length > 0)
        last = arrays.lists.weight[arrays.lists.start[listed] + arrays.lists.length[listed] - 1]
        arrays.entry[listed] = np.minimum(last, self.settings.min_fraction * arrays.total[listed])
        arrays.known[listed] |= known[listed]
        self.update_all_rows()
