"""Corrections of the interpolated value function where the agent makes no progress, in the manner of LRTA*.

Between grid points the interpolated value can promise a way that does not exist: at a joint limit or a wall the grid
points beyond were fitted to instances that moved freely. Acting greedily on such a promise can hold an agent in place
for ever. A state to which the agent has come back ``PATIENCE`` times within an episode is such a place. There, when
the interpolated value exceeds the best action value, that action value is remembered and caps the value of states in
the same small cell. Each further visit lowers the cap, until another way looks better.

Where the agent does make progress nothing is corrected: values that are true along the path taken and too hopeful
beside it would make every other path look better than the one that works.
"""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.kernels import interpolate

CELLS_PER_GRID_CELL = 3
# Box edges, joint limits and round step lengths lie on round numbers. A state on a cell's edge would be remembered on one
# side of it and looked for, one rounding error later, on the other: for ever without effect.
CELL_OFFSET = 0.4142
PATIENCE = 10
VISIT_TABLE_SIZE = 1 << 14


class CorrectionArrays(ArrayStruct):
    """Remembered states, found by an open-addressing hash table of the cells they lie in.

    :param table: int32, shape (power of two,): number of a remembered state, -1 for none
    :param key: int64, shape (capacity,): the cell of each remembered state
    :param state: float64, shape (capacity, n_variables), unit coordinates: the last state visited in the cell
    :param value: float64, shape (capacity,): the best action value there
    :param count: int64, shape (1,)
    :param visit_key: int64, shape (VISIT_TABLE_SIZE,): cells visited lately, hashed with what tells episodes apart
    :param visits: int32, same shape: how often
    """

    table: np.ndarray
    key: np.ndarray
    state: np.ndarray
    value: np.ndarray
    count: np.ndarray
    visit_key: np.ndarray
    visits: np.ndarray

    @classmethod
    def empty(cls, n_variables: int, capacity: int = 256) -> "CorrectionArrays":
        """Nothing remembered yet."""
        return cls(
            table=np.full(4 * capacity, -1, dtype=np.int32),
            key=np.empty(capacity, dtype=np.int64),
            state=np.empty((capacity, n_variables)),
            value=np.empty(capacity),
            count=np.zeros(1, dtype=np.int64),
            visit_key=np.full(VISIT_TABLE_SIZE, -1, dtype=np.int64),
            visits=np.zeros(VISIT_TABLE_SIZE, dtype=np.int32),
        )

    @classmethod
    def of_rows(cls, key: np.ndarray, value: np.ndarray, state: np.ndarray) -> "CorrectionArrays":
        """Those given one a row; of rows with the same key the last one is found."""
        n = len(key)
        capacity = 256
        while capacity < n:
            capacity *= 2
        held = cls.empty(state.shape[1], capacity)
        held.key[:n], held.value[:n], held.state[:n] = key, value, state
        held.count[0] = n
        note_all(held)
        return held

    def with_room(self) -> "CorrectionArrays":
        """Itself, or a copy of twice the size if one more state would not fit."""
        capacity = len(self.key)
        n = int(self.count[0])
        if n < capacity:
            return self
        larger = CorrectionArrays.empty(self.state.shape[1], 2 * capacity)
        larger.key[:n], larger.state[:n], larger.value[:n] = self.key, self.state, self.value
        larger.count[0] = n
        larger = larger.replace(visit_key=self.visit_key, visits=self.visits)
        note_all(larger)
        return larger


@inlined
def cell_key(position, shape):
    """The number of the small cell around a position in grid coordinates."""
    key = 0
    for k in range(len(position)):
        last = shape[k] - 1
        at = min(max(position[k], 0.0), float(last))
        key = key * (last * CELLS_PER_GRID_CELL + 1) + int(at * CELLS_PER_GRID_CELL + CELL_OFFSET)
    return key


@inlined
def find_cell(corrections, key):
    """Where in the table ``key`` stands, or the free place where it would."""
    mask = len(corrections.table) - 1
    at = (key * 0x9E3779B1 >> 7) & mask
    while corrections.table[at] >= 0 and corrections.key[corrections.table[at]] != key:
        at = (at + 1) & mask
    return at


@compiled
def note_all(corrections):
    """Enter all remembered states in the table."""
    for m in range(corrections.count[0]):
        corrections.table[find_cell(corrections, corrections.key[m])] = m


@inlined
def corrected_value(values, corrections, position, grid, scratch):
    """The value at ``position`` (unit coordinates times cells): interpolated, and cut by what is remembered there."""
    value = interpolate(values, position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
    if corrections.count[0] > 0:
        m = corrections.table[find_cell(corrections, cell_key(position, grid.shape))]
        if m >= 0:
            value = cut_value(value, m, values, corrections, grid, scratch)
    return value


@part
def cut_value(value, m, values, corrections, grid, scratch):
    """``value`` cut by what is remembered as number ``m``: as much as the value there was too large."""
    for k in range(len(scratch.there)):
        scratch.there[k] = corrections.state[m, k] * grid.cells[k] + grid.margin[k]
    there = interpolate(values, scratch.there, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
    return value + min(0.0, corrections.value[m] - there)


@part
def count_visit(corrections, key, episode):
    """How often the cell was visited in this episode, this visit included.

    A direct-mapped table: where two cells share a place, the later one starts afresh.
    """
    tagged = key * 1000003 + episode
    at = (tagged * 0x9E3779B1 >> 7) & (VISIT_TABLE_SIZE - 1)
    if corrections.visit_key[at] != tagged:
        corrections.visit_key[at] = tagged
        corrections.visits[at] = 0
    corrections.visits[at] += 1
    return corrections.visits[at]


@part
def visit(values, corrections, state, best_q, visitor, grid, scratch):
    """Count a visit to ``state``; renew what is remembered of its cell, or start to remember it (see the module).

    :param best_q: the largest action value at ``state``
    :param visitor: (episode, tolerance, patience): a number that tells episodes (of all environments) apart; the excess
        of the interpolated value that is not yet a wrong promise; visits in an episode that do not count
    """
    for k in range(len(state)):
        scratch.position[k] = state[k] * grid.cells[k] + grid.margin[k]
    key = cell_key(scratch.position, grid.shape)
    at = find_cell(corrections, key)
    m = corrections.table[at]
    episode, tolerance, patience = visitor
    visits = count_visit(corrections, key, episode)
    if m < 0:
        if visits <= patience:
            return
        value = interpolate(values, scratch.position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
        if value - best_q <= tolerance:
            return
        m = corrections.count[0]
        corrections.count[0] = m + 1
        corrections.table[at] = m
        corrections.key[m] = key
    corrections.value[m] = best_q
    for k in range(len(state)):
        corrections.state[m, k] = state[k]
