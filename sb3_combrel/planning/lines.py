"""Where the lines of a coarse grid are: where values between them are wrong."""

import numpy as np

from sb3_combrel.common.constants import BINS_A_CELL, EVENLY, LINE_STEP
from sb3_combrel.planning.grid import StateGrid


def moved_lines(grid: StateGrid, states: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Move the lines of a grid without margin towards where each cell of a variable has the same share of errors.

    That is where a mesh is best (de Boor 1973), for each variable apart from the others, as a grid has to be. Its ends stay,
    and its middle, where things are often at rest. Errors depend on where lines are: the whole way would lead too far.

    :param states: unit coordinates, shape (n, n_variables)
    :param errors: of the interpolated values there, at least 0, not all of them 0, shape (n,)
    :return: for :meth:`StateGrid.with_lines`
    """
    lines = grid.arrays.lines.copy()
    for k, at in enumerate(np.clip(states, 0.0, 1.0).T):
        n_cells = 2 ** grid.resolution[k]
        edges = np.linspace(0.0, 1.0, BINS_A_CELL * n_cells + 1)
        in_bins, _ = np.histogram(at, edges, weights=errors)
        share = (1.0 - EVENLY) * np.append(0.0, np.cumsum(in_bins) / in_bins.sum()) + EVENLY * edges
        below, half = np.interp(0.5, edges, share), np.linspace(0.0, 1.0, n_cells // 2 + 1)
        wanted = np.concatenate([below * half, below + (1.0 - below) * half[1:]])
        aims = np.interp(wanted, share, edges)
        aims[[0, n_cells // 2, n_cells]] = 0.0, 0.5, 1.0
        lines[k, : n_cells + 1] += LINE_STEP * (aims - lines[k, : n_cells + 1])
    return lines
