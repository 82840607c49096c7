"""Visits to cells of the grid where all is known end the optimism of grid points that the agent cannot get nearer to.

One of the grid points around a state may stay optimistic for ever, because nothing leads there, and would draw the agent to
that state again and again. So a grid point around which the agent was often enough, with every action known where it was,
counts as known from what instances it has.
"""

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled
from sb3_combrel.planning.grid import GridArrays, corners_of, grid_coordinates

ENOUGH_VISITS = 3


@compiled
def note_visit(state, weight, threshold, n_optimistic, visits, grid, scratch):
    """Count a visit to the grid points around ``state`` that have an optimistic action, if every action is known there.

    Of how many that was often enough; they are moved to the front of ``corner_index``. See :meth:`Visits.note`.
    """
    for action in range(len(weight)):
        if weight[action] < threshold:
            return 0
    grid = GridArrays(*grid)
    position, corner_index, corner_weight = scratch
    grid_coordinates(state, grid, position)
    found = 0
    for c in range(corners_of(position, grid, corner_index, corner_weight)):
        point = corner_index[c]
        if n_optimistic[point] > 0:
            visits[point] += 1
            if visits[point] >= ENOUGH_VISITS:
                corner_index[found] = point
                found += 1
    return found


_note_visit = EntryPoint(note_visit)


class Visits:
    """Counts visits to grid points that have an optimistic action."""

    def __init__(self, n_variables: int, n_points: int):
        self.counts = np.zeros(n_points, dtype=np.int32)
        self._corner_index = np.empty(2**n_variables, dtype=np.int64)
        self._scratch = np.empty(n_variables), self._corner_index, np.empty(2**n_variables)

    def note(
        self, state: np.ndarray, weight: np.ndarray, threshold: float, n_optimistic: np.ndarray, grid: tuple
    ) -> np.ndarray:
        """:param state: unit coordinates, shape (n_variables,)
        :param weight: of the own instances of each action there, shape (n_actions,); ``threshold``: what makes one known
        :param n_optimistic: optimistic actions of each grid point, shape (n_points,)
        :param grid: ``StateGrid.plain``
        :return: grid points that have an optimistic action and have been visited often enough, int64
        """
        n = _note_visit.call(state, weight, threshold, n_optimistic, self.counts, grid, self._scratch)
        return self._corner_index[:n]
