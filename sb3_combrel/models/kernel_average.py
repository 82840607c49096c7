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
from sb3_combrel.models.kernel_lists import IN_ITS_SLOT, TO_BE_PUT, KernelLists, ReachScratch, enter, leave_lists, update_rows
from sb3_combrel.models.kernel_prediction import NearLists, join_transferred, predict_own
from sb3_combrel.planning.mdp import FiniteMDP

_enter, _leave_lists, _update_rows = EntryPoint(enter), EntryPoint(leave_lists), EntryPoint(update_rows)
_predict_own, _join_transferred = EntryPoint(predict_own), EntryPoint(join_transferred)


class KernelAverage(CompiledModel):
    """The model of Jong & Stone (2007), one for each action, incremental.

    An instance at distance d (unit coordinates) weighs exp(-d^2 / breadth^2). Instances that weigh less than ``min_weight``
    do not count; of the others, nearest first, one counts while its weight is at least ``min_fraction`` of the sum of those
    before it. A nearer instance can so shorten the list of a known pair, which is a better model, not less knowledge: the
    pair stays known. With ``max_instances``, the instance in the fewest lists is replaced.

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        d, n_points = self.grid.n_variables, self.grid.n_points
        lists = KernelLists(
            lists=ListStore.empty(len(self.known), 1 << 12),
            entry=np.zeros(len(self.known)),
            total=self.own_weight,
            last_total=self.last_weight,
            known=self.known,
            **self._of_instances(),
        )
        self._set_arrays(lists)
        self._kernel = (float(settings.model_breadth), float(settings.min_weight), float(settings.min_fraction))
        self._scratch = ReachScratch(
            kernel=np.empty((d, int(self.grid.arrays.shape.max()))),
            at=np.empty((3, d), dtype=np.int64),
            point=np.empty(n_points, dtype=np.int64),
            weight=np.empty(n_points),
        )
        self._plain_scratch = tuple(self._scratch)
        self._progress = np.empty(3, dtype=np.int64)
        self._own_room = room = list_room(settings.min_fraction)
        near = NearLists(
            item=np.empty((self.n_actions, room), dtype=np.int32),
            weight=np.empty((self.n_actions, room)),
            length=np.zeros(self.n_actions, dtype=np.int64),
        )
        self._plain_near = tuple(near)
        self._make_prediction(room)

    def _set_arrays(self, arrays: KernelLists) -> None:
        self.arrays, self._plain_arrays = arrays, arrays.plain()

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        """As :meth:`Model.add`; with a transfer method, pairs of low weight that changed little may wait (``outdated``)."""
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
            larger = self._of_instances()
            for name, array in larger.items():
                array[:, : instances.capacity] = getattr(self.arrays, name)
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

    def _enter(self, transition: tuple[Any, ...], begin: int = TO_BE_PUT) -> np.ndarray:
        """Put an instance into the lists that it reaches; the pairs whose rows are to be updated."""
        threshold = self.exploration_threshold
        thresholds = threshold, 0.0 if self.transfer is None else MIN_CHANGE * threshold
        self._progress[:] = begin, 0, 0
        instances, grid, scratch = self._plain_instances, self.grid.plain, self._plain_scratch
        while not _enter.call(
            instances, self._plain_arrays, grid, self._kernel, thresholds, transition, scratch, self._progress
        ):
            self._set_arrays(self.arrays._replace(lists=self.arrays.lists.with_room()))
        return self._scratch.point[: self._progress[2]] + transition[0] * self.grid.n_points

    def _leave(self, action: int, slot: int) -> np.ndarray:
        if self.arrays.n_lists[action, slot] == 0:
            return NO_PAIRS
        anywhere, grid = np.zeros(self.grid.n_points), self.grid.arrays
        changed = _leave_lists.call(self.instances, self.arrays, grid, self._kernel, action, slot, anywhere, self._scratch)
        return self._scratch.point[:changed] + action * self.grid.n_points

    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        mdp, own = self.mdp, (self._plain_arrays, self._plain_instances)
        return int(_update_rows.call(*own, mdp.plain, self.grid.plain, mdp.gamma, pairs, transferred, mdp.plain_scratch))

    def _predict_own(self, state: np.ndarray) -> float:
        near, prediction = self._plain_near, self._plain_prediction
        threshold = self.exploration_threshold
        return float(_predict_own.call(self._plain_instances, state, self._kernel, threshold, near, prediction))

    def _join_transferred(self, given: TransferredInstances) -> None:
        near, prediction = self._plain_near, self._plain_prediction
        _join_transferred.call(self._plain_instances, near, tuple(given), self.exploration_threshold, prediction)

    def get_state(self) -> dict[str, np.ndarray]:
        state = super().get_state()
        listed = [self.arrays.n_lists[action, :size] > 0 for action, size in enumerate(self.instances.size.tolist())]
        state["instances"][:, -1] = np.concatenate(listed)
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Rebuild all from the instances; saved weights that differ by rounding only are used, and what was known stays so."""
        rows, known, total = state["instances"], state["known"] > 0.5, state["total"]
        rows = rows[np.argsort(np.clip(rows[:, 0], 0, self.n_actions - 1), kind="stable")]
        self.instances = instances = Instances.from_rows(self.n_actions, rows[:, :-1], self.grid.arrays.periodic)
        self._set_arrays(self.arrays._replace(**self._of_instances()))
        slots = [(action, slot) for action, size in enumerate(instances.size.tolist()) for slot in range(size)]
        for (action, slot), listed in zip(slots, rows[:, -1] > 0.5, strict=True):
            if listed:
                at = instances.state[action, slot]
                self._enter((action, slot, at, at, 0.0, False), IN_ITS_SLOT)
        arrays = self.arrays
        same = np.abs(total - arrays.total) <= 1e-9 * arrays.total
        arrays.total[same] = total[same]
        listed_pairs = np.flatnonzero(arrays.lists.length > 0)
        last = arrays.lists.weight[arrays.lists.start[listed_pairs] + arrays.lists.length[listed_pairs] - 1]
        arrays.entry[listed_pairs] = np.minimum(last, self.settings.min_fraction * arrays.total[listed_pairs])
        arrays.known[:] = (arrays.lists.length > 0) & (known | (arrays.total >= self.exploration_threshold))
        self.update_all_rows()
