"""A compiled store of many short, growing lists of (item, weight) entries in two flat arrays: slots of doubling size."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import inner

MIN_SLOT = 4
N_SIZE_CLASSES = 26
# Where the allocator keeps what it needs besides the free slots.
USED, FULL = N_SIZE_CLASSES, N_SIZE_CLASSES + 1


class ListStore(NamedTuple):
    """Lists of (item, weight); list ``p`` is ``item[start[p] : start[p] + length[p]]`` and the same of ``weight``."""

    item: np.ndarray  # int32, (capacity,)
    weight: np.ndarray  # float64, (capacity,)
    start: np.ndarray  # int64, (n_lists,): first entry of each list's slot, -1 while it has none
    length: np.ndarray  # int32, (n_lists,)
    size_class: np.ndarray  # int8, (n_lists,): the slot has room for MIN_SLOT << size_class entries
    # Head of each class's chain of free slots, or -1; entries in slots (USED); 1 if there was no room for the last (FULL).
    allocator: np.ndarray  # int64, (N_SIZE_CLASSES + 2,)

    @classmethod
    def empty(cls, n_lists: int, capacity: int) -> "ListStore":
        """Make empty lists with room for ``capacity`` entries before the store has to grow."""
        return cls(
            item=np.empty(capacity, dtype=np.int32),
            weight=np.empty(capacity, dtype=np.float64),
            start=np.full(n_lists, -1, dtype=np.int64),
            length=np.zeros(n_lists, dtype=np.int32),
            size_class=np.zeros(n_lists, dtype=np.int8),
            allocator=np.array([-1] * N_SIZE_CLASSES + [0, 0], dtype=np.int64),
        )

    def with_room(self) -> "ListStore":
        """Itself, or, if it is full, a store with the same lists and twice the room."""
        if not self.allocator[FULL]:
            return self
        self.allocator[FULL] = 0
        more = len(self.item)
        return self._replace(
            item=np.concatenate([self.item, np.empty(more, dtype=np.int32)]),
            weight=np.concatenate([self.weight, np.empty(more, dtype=np.float64)]),
        )

    def entries(self, p: int) -> tuple[np.ndarray, np.ndarray]:
        """Items and weights of list ``p``, as views."""
        first = int(self.start[p])
        last = first + int(self.length[p])
        return self.item[first:last], self.weight[first:last]


@inner
def reserve(store, p, n_entries):
    """Make room for ``n_entries`` in list ``p``, keeping its entries; False if the store must grow first."""
    old_start = store.start[p]
    if old_start >= 0 and n_entries <= MIN_SLOT << store.size_class[p]:
        return True
    size_class = 0
    while MIN_SLOT << size_class < n_entries:
        size_class += 1
    slot = store.allocator[size_class]
    if slot >= 0:
        store.allocator[size_class] = store.item[slot]
    else:
        slot = store.allocator[USED]
        if slot + (MIN_SLOT << size_class) > len(store.item):
            store.allocator[FULL] = 1
            return False
        store.allocator[USED] = slot + (MIN_SLOT << size_class)
    if old_start >= 0:
        for k in range(store.length[p]):
            store.item[slot + k] = store.item[old_start + k]
            store.weight[slot + k] = store.weight[old_start + k]
        old_class = store.size_class[p]
        store.item[old_start] = np.int32(store.allocator[old_class])
        store.allocator[old_class] = old_start
    store.start[p] = slot
    store.size_class[p] = size_class
    return True
