"""The effects that a prior predicts between the grid points, compiled."""

from sb3_combrel.common.compiled import compiled
from sb3_combrel.planning.grid import GridArrays, corners_of


@compiled
def interpolate_prior_plain(prior, grid, states, actions, corners, found):
    """Write the effects that a prior predicts of states and actions, multilinear between the grid points.

    :param prior: float64, shape (n_pairs, n_variables + 2), as in ``LinearFits``
    :param grid: GridArrays, a plain tuple
    :param states: unit coordinates, float64, shape (n, n_variables); beyond the grid the nearest point of it counts
    :param actions: int64, shape (n,)
    :param corners: work space: position on the grid, float64, shape (n_variables,); corners around it, int64, shape
        (2 ** n_variables,), and their weights, float64
    :param found: float64, shape (n, n_variables): receives them
    """
    grid = GridArrays(*grid)
    position, corner, weight = corners
    d = len(position)
    n_points = grid.shape[0] * grid.strides[0]
    for i in range(len(actions)):
        for k in range(d):
            position[k] = states[i, k] * grid.cells[k] + grid.margin[k]
            found[i, k] = 0.0
        first_pair = actions[i] * n_points
        for c in range(corners_of(position, grid, corner, weight)):
            for k in range(d):
                found[i, k] += weight[c] * prior[first_pair + corner[c], k]
