"""Where the lines of a coarse grid are: where values between them are wrong."""

import numpy as np

from sb3_combrel.planning.grid import StateGrid


def moved_lines(grid: StateGrid, states: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Move the lines of a grid without margin half of the way to where each cell of a variable has the same share of errors.

    That is where a mesh is best (de Boor 1973), for each variable apart from the others, as a grid has to be. Its ends stay,
    and its middle, where things are often at rest. Errors depend on where lines are: the whole way would lead too far. Within
    a cell as it is they are taken as even.

    :param states: unit coordinates, shape (n, n_variables)
    :param errors: of the interpolated values there, at least 0, not all of them 0, shape (n,)
    :return: for :meth:`StateGrid.with_lines`
    """
    moved = grid.arrays.lines.copy()
    for k, at in enumerate(np.clip(states, 0.0, 1.0).T):
        half = 2 ** grid.resolution[k] // 2
        for first in (0, half):
            lines = grid.arrays.lines[k, first : first + half + 1]
            in_cells, _ = np.histogram(at, lines, weights=errors)
            up_to = np.append(0.0, np.cumsum(in_cells))
            if up_to[-1] > 0.0:
                aims = np.interp(np.linspace(0.0, up_to[-1], half + 1), up_to, lines)
                moved[k, first + 1 : first + half] = (lines[1:-1] + aims[1:-1]) / 2.0
    return moved
