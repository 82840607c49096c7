"""Corrections of the interpolated value function where the agent makes no progress, in the manner of LRTA*.

Between grid points the interpolated value can be far too high, as at a wall, and keep a greedy agent in place for ever. At a
state to which it has returned ``MAX_VISITS`` times within an episode the best action value is stored, and caps the value of
states in the same small cell; each further visit lowers the cap, until another action looks better. Elsewhere nothing is
corrected: values that are right along the path taken and too high beside it would make every other path look better.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined, part
from sb3_combrel.planning.grid import grid_coordinates, interpolate, wrapped

CELLS_PER_GRID_CELL = 3
# States lie on round numbers: on a cell's edge one would be stored on one side of it and looked up on the other.
CELL_OFFSET = 0.4142
MAX_VISITS = 10
VISIT_TABLE_SIZE = 1 << 14


class CorrectionArrays(NamedTuple):
    """Corrected states, found by an open-addressing hash table of the small cells they lie in."""

    table: np.ndarray  # int32, (power of two,): number of a corrected state, -1 for none
    key: np.ndarray  # int64, (capacity,): the cell of each corrected state
    state: np.ndarray  # float64, (capacity, n_variables), unit coordinates: the last state visited in the cell
    value: np.ndarray  # float64, (capacity,): the best action value there
    n_states: np.ndarray  # int64, (1,): how many there are
    visit_key: np.ndarray  # int64, (VISIT_TABLE_SIZE,): cells visited lately, hashed with the number of the episode
    visits: np.ndarray  # int32, (VISIT_TABLE_SIZE,): how often

    @classmethod
    def empty(cls, n_variables: int, capacity: int = 256) -> "CorrectionArrays":
        """Make room for ``capacity`` corrections, a power of two."""
        return cls(
            table=np.full(4 * capacity, -1, dtype=np.int32),
            key=np.empty(capacity, dtype=np.int64),
            state=np.empty((capacity, n_variables)),
            value=np.empty(capacity),
            n_states=np.zeros(1, dtype=np.int64),
            visit_key=np.full(VISIT_TABLE_SIZE, -1, dtype=np.int64),
            visits=np.zeros(VISIT_TABLE_SIZE, dtype=np.int32),
        )

    @classmethod
    def of_rows(cls, rows: np.ndarray) -> "CorrectionArrays":
        """Build them from :meth:`rows`; of rows with the same key the last one is found."""
        n = len(rows)
        capacity = 256
        while capacity < n:
            capacity *= 2
        made = cls.empty(rows.shape[1] - 2, capacity)
        made.key[:n], made.value[:n], made.state[:n] = rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 2:]
        made.n_states[0] = n
        _enter_all.call(made)
        return made

    def rows(self) -> np.ndarray:
        """Key, value and state of each corrected state, float64, shape (n_states, 2 + n_variables)."""
        n = int(self.n_states[0])
        return np.column_stack([self.key[:n], self.value[:n], self.state[:n]])

    def with_room(self) -> "CorrectionArrays":
        """Itself, or a copy with twice the room if one more state would not fit."""
        capacity, n = len(self.key), int(self.n_states[0])
        if n < capacity:
            return self
        larger = CorrectionArrays.empty(self.state.shape[1], 2 * capacity)
        larger.key[:n], larger.state[:n], larger.value[:n] = self.key, self.state, self.value
        larger.n_states[0] = n
        larger = larger._replace(visit_key=self.visit_key, visits=self.visits)
        _enter_all.call(larger)
        return larger


class ValueScratch(NamedTuple):
    """Work space for values between grid points."""

    position: np.ndarray  # float64, (n_variables,): grid coordinates
    corrected: np.ndarray  # float64, (n_variables,): those of a corrected state
    corner_index: np.ndarray  # int64, (2 ** n_variables,)
    corner_weight: np.ndarray  # float64, (2 ** n_variables,)

    @classmethod
    def for_variables(cls, n_variables: int) -> "ValueScratch":
        """Make work space for so many state variables."""
        return cls(
            position=np.empty(n_variables),
            corrected=np.empty(n_variables),
            corner_index=np.empty(2**n_variables, dtype=np.int64),
            corner_weight=np.empty(2**n_variables),
        )


@inlined
def cell_key(position, grid):
    """The number of the small cell around a position in grid coordinates."""
    key = 0
    for k in range(len(position)):
        if grid.periodic[k]:
            n_cells = grid.shape[k] * CELLS_PER_GRID_CELL
            cell = int(wrapped(position[k], grid.shape[k]) * CELLS_PER_GRID_CELL + CELL_OFFSET) % n_cells
        else:
            last = grid.shape[k] - 1
            n_cells = last * CELLS_PER_GRID_CELL + 1
            cell = int(min(max(position[k], 0.0), float(last)) * CELLS_PER_GRID_CELL + CELL_OFFSET)
        key = key * n_cells + cell
    return key


@inlined
def find_cell(table, keys, key):
    """Where in the table ``key`` stands, or the free place where it would."""
    mask = len(table) - 1
    at = (key * 0x9E3779B1 >> 7) & mask
    while table[at] >= 0 and keys[table[at]] != key:
        at = (at + 1) & mask
    return at


@compiled
def enter_all(corrections):
    """Enter all corrected states in the table."""
    for m in range(corrections.n_states[0]):
        corrections.table[find_cell(corrections.table, corrections.key, corrections.key[m])] = m


_enter_all = EntryPoint(enter_all)


@inlined
def corrected_value(values, corrections, grid, scratch):
    """The value at ``scratch.position``: interpolated, and capped if the cell has been corrected."""
    value = interpolate(values, scratch.position, grid, scratch.corner_index, scratch.corner_weight)
    if corrections.n_states[0] > 0:
        m = corrections.table[find_cell(corrections.table, corrections.key, cell_key(scratch.position, grid))]
        if m >= 0:
            value = cap_value(value, m, values, corrections, grid, scratch)
    return value


@part
def cap_value(value, m, values, corrections, grid, scratch):
    """``value``, lowered by as much as the interpolated value at corrected state ``m`` is too high."""
    grid_coordinates(corrections.state[m], grid, scratch.corrected)
    there = interpolate(values, scratch.corrected, grid, scratch.corner_index, scratch.corner_weight)
    return value + min(0.0, corrections.value[m] - there)


@part
def count_visit(corrections, key, episode):
    """How often the cell was visited in this episode; where two cells share a place, the later one begins at 1."""
    tagged = key * 1000003 + episode
    at = (tagged * 0x9E3779B1 >> 7) & (VISIT_TABLE_SIZE - 1)
    if corrections.visit_key[at] != tagged:
        corrections.visit_key[at] = tagged
        corrections.visits[at] = 0
    corrections.visits[at] += 1
    return corrections.visits[at]


@part
def visit(values, corrections, state, best_q, visitor, grid, scratch):
    """Count a visit to ``state``, whose largest action value is ``best_q``; renew the correction of its cell, or add one.

    :param visitor: (number of the episode, of all environments, excess that is not corrected, visits in an episode before
        which nothing is)
    """
    grid_coordinates(state, grid, scratch.position)
    key = cell_key(scratch.position, grid)
    at = find_cell(corrections.table, corrections.key, key)
    m = corrections.table[at]
    episode, tolerance, max_visits = visitor
    visits = count_visit(corrections, key, episode)
    if m < 0:
        if visits <= max_visits:
            return
        value = interpolate(values, scratch.position, grid, scratch.corner_index, scratch.corner_weight)
        if value - best_q <= tolerance:
            return
        m = corrections.n_states[0]
        corrections.n_states[0] = m + 1
        corrections.table[at] = m
        corrections.key[m] = key
    corrections.value[m] = best_q
    for k in range(len(state)):
        corrections.state[m, k] = state[k]
