"""Corrections of the interpolated value function at visited states, in the manner of LRTA*.

Between grid points the interpolated value can promise a way that does not exist: at a joint limit or a wall the grid
points beyond were fitted to instances that moved freely. Acting greedily on such a promise can hold an agent in place
for ever. Whenever the interpolated value at a visited state exceeds the best action value there, that action value is
remembered, and caps the value of states in the same small cell. Each return to a place without progress lowers its
cap, until another way looks better.
"""

from typing import NamedTuple

import numpy as np
from sb3_combrel.common.compiled import compiled

from sb3_combrel.common.kernels import interpolate

CELLS_PER_GRID_CELL = 3


class CorrectionArrays(NamedTuple):
    """Remembered states, found by an open-addressing hash table of the cells they lie in.

    :param table: int32, shape (power of two,): number of a remembered state, -1 for none
    :param key: int64, shape (capacity,): the cell of each remembered state
    :param state: float64, shape (capacity, n_variables), unit coordinates: the last state visited in the cell
    :param value: float64, shape (capacity,): the best action value there
    :param count: int64, shape (1,)
    """

    table: np.ndarray
    key: np.ndarray
    state: np.ndarray
    value: np.ndarray
    count: np.ndarray

    @classmethod
    def empty(cls, n_variables: int, capacity: int = 256) -> "CorrectionArrays":
        """Nothing remembered yet."""
        return cls(
            table=np.full(4 * capacity, -1, dtype=np.int32),
            key=np.empty(capacity, dtype=np.int64),
            state=np.empty((capacity, n_variables)),
            value=np.empty(capacity),
            count=np.zeros(1, dtype=np.int64),
        )

    def with_room(self) -> "CorrectionArrays":
        """Itself, or a copy of twice the size if one more state would not fit."""
        capacity = len(self.key)
        n = int(self.count[0])
        if n < capacity:
            return self
        larger = CorrectionArrays.empty(self.state.shape[1], 2 * capacity)
        larger.key[:n], larger.state[:n], larger.value[:n] = self.key, self.state, self.value
        larger.count[0] = n
        for m in range(n):
            larger.table[find_cell(larger, larger.key[m])] = m
        return larger


@compiled
def cell_key(position, shape):
    """The number of the small cell around a position in grid coordinates."""
    key = 0
    for k in range(len(position)):
        last = shape[k] - 1
        at = min(max(position[k], 0.0), float(last))
        key = key * (last * CELLS_PER_GRID_CELL + 1) + int(at * CELLS_PER_GRID_CELL)
    return key


@compiled
def find_cell(corrections, key):
    """Where in the table ``key`` stands, or the free place where it would."""
    mask = len(corrections.table) - 1
    at = (key * 0x9E3779B1 >> 7) & mask
    while corrections.table[at] >= 0 and corrections.key[corrections.table[at]] != key:
        at = (at + 1) & mask
    return at


@compiled
def corrected_value(values, corrections, position, grid, scratch):
    """The value at ``position`` (unit coordinates times cells): interpolated, and cut by what is remembered there."""
    value = interpolate(values, position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
    if corrections.count[0] == 0:
        return value
    m = corrections.table[find_cell(corrections, cell_key(position, grid.shape))]
    if m < 0:
        return value
    for k in range(len(position)):
        scratch.there[k] = corrections.state[m, k] * grid.cells[k]
    there = interpolate(values, scratch.there, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
    return value + min(0.0, corrections.value[m] - there)


@compiled
def remember(values, corrections, state, best_q, grid, tolerance, scratch):
    """Renew what is remembered of the cell of ``state``; start where the value there exceeds ``best_q``."""
    for k in range(len(state)):
        scratch.position[k] = state[k] * grid.cells[k]
    key = cell_key(scratch.position, grid.shape)
    at = find_cell(corrections, key)
    m = corrections.table[at]
    if m < 0:
        value = interpolate(
            values, scratch.position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight
        )
        if value - best_q <= tolerance:
            return
        m = corrections.count[0]
        corrections.count[0] = m + 1
        corrections.table[at] = m
        corrections.key[m] = key
    corrections.value[m] = best_q
    for k in range(len(state)):
        corrections.state[m, k] = state[k]
