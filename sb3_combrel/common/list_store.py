"""A compiled store of many short, growing lists of (index, weight) entries in two flat arrays.

The kernel model keeps such a list for every state-action pair of the grid: hundreds of thousands of lists, most of
them empty, few of them long. One slab with slots of doubling size keeps them compact and lets compiled code walk
them without pointers.
"""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import inner

SMALLEST_SLOT = 4
N_SIZE_CLASSES = 26


class Pool(ArrayStruct):
    """Lists of (index, weight); list ``p`` is ``index[start[p] : start[p] + length[p]]`` and the same of ``weight``.

    :param index: int32, shape (capacity,)
    :param weight: float64, shape (capacity,)
    :param start: int64, shape (n_lists,): first entry of each list's slot, -1 while it has none
    :param length: int32, shape (n_lists,)
    :param size_class: int8, shape (n_lists,): the slot holds ``SMALLEST_SLOT << size_class`` entries
    :param free: int64, shape (N_SIZE_CLASSES,): head of the chain of free slots of each class, -1 if none
    :param used: int64, shape (1,): entries of the slab handed out so far
    :param full: bool, shape (1,): the slab was too small for what was last asked of it
    """

    index: np.ndarray
    weight: np.ndarray
    start: np.ndarray
    length: np.ndarray
    size_class: np.ndarray
    free: np.ndarray
    used: np.ndarray
    full: np.ndarray

    @classmethod
    def empty(cls, n_lists: int, capacity: int) -> "Pool":
        """A pool of ``n_lists`` empty lists with room for ``capacity`` entries before it has to grow."""
        return cls(
            index=np.empty(capacity, dtype=np.int32),
            weight=np.empty(capacity, dtype=np.float64),
            start=np.full(n_lists, -1, dtype=np.int64),
            length=np.zeros(n_lists, dtype=np.int32),
            size_class=np.zeros(n_lists, dtype=np.int8),
            free=np.full(N_SIZE_CLASSES, -1, dtype=np.int64),
            used=np.zeros(1, dtype=np.int64),
            full=np.zeros(1, dtype=np.bool_),
        )

    def with_room(self) -> "Pool":
        """Itself, or the same lists with twice the room if it was full."""
        if not self.full[0]:
            return self
        self.full[0] = False
        more = len(self.index)
        return self.replace(
            index=np.concatenate([self.index, np.empty(more, dtype=np.int32)]),
            weight=np.concatenate([self.weight, np.empty(more, dtype=np.float64)]),
        )

    def entries(self, p: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices and weights of list ``p``, as views."""
        first = int(self.start[p])
        last = first + int(self.length[p])
        return self.index[first:last], self.weight[first:last]


@inner
def reserve(pool: Pool, p: int, n_entries: int) -> bool:
    """Make room for ``n_entries`` in list ``p``, keeping what it holds; False if the slab must grow first."""
    old_start = pool.start[p]
    if old_start >= 0 and n_entries <= SMALLEST_SLOT << pool.size_class[p]:
        return True
    size_class = 0
    while SMALLEST_SLOT << size_class < n_entries:
        size_class += 1
    slot = pool.free[size_class]
    if slot >= 0:
        pool.free[size_class] = pool.index[slot]
    else:
        slot = pool.used[0]
        if slot + (SMALLEST_SLOT << size_class) > len(pool.index):
            pool.full[0] = True
            return False
        pool.used[0] = slot + (SMALLEST_SLOT << size_class)
    if old_start >= 0:
        for k in range(pool.length[p]):
            pool.index[slot + k] = pool.index[old_start + k]
            pool.weight[slot + k] = pool.weight[old_start + k]
        old_class = pool.size_class[p]
        pool.index[old_start] = np.int32(pool.free[old_class])
        pool.free[old_class] = old_start
    pool.start[p] = slot
    pool.size_class[p] = size_class
    return True
