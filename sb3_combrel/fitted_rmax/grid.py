"""The finite sample of states on which Fitted R-Max plans: a uniform grid over the unit box."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.kernels import interpolate


class GridArrays(NamedTuple):
    """What compiled code needs to know of a grid.

    :param shape: int64, shape (n_variables,): points along each variable
    :param strides: int64, same shape: what one step along a variable adds to a point's number
    :param cells: float64, same shape: cells per unit
    """

    shape: np.ndarray
    strides: np.ndarray
    cells: np.ndarray


class StateGrid:
    """A uniform grid of 2**resolution cells along each variable of the unit box (C order, corners included).

    :param n_variables: number of state variables
    :param resolution: one number for all variables, or one for each
    """

    def __init__(self, n_variables: int, resolution: int | Sequence[int]):
        per_variable = np.broadcast_to(np.asarray(resolution, dtype=np.int64), (n_variables,))
        shape = 2**per_variable + 1
        strides = np.concatenate([np.cumprod(shape[:0:-1])[::-1], [1]]).astype(np.int64)
        self.n_variables = n_variables
        self.resolution = tuple(int(r) for r in per_variable)
        self.n_points = int(np.prod(shape))
        self.arrays = GridArrays(shape=shape, strides=strides, cells=(2.0**per_variable))
        self._corner_index = np.empty(2**n_variables, dtype=np.int64)
        self._corner_weight = np.empty(2**n_variables)

    def points(self) -> np.ndarray:
        """All grid points, unit coordinates, shape (n_points, n_variables)."""
        axes = [np.linspace(0.0, 1.0, n) for n in self.arrays.shape]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.n_variables)

    def interpolate(self, values: np.ndarray, state: np.ndarray) -> float:
        """Multilinear interpolation.

        :param values: at the grid points, shape (n_points,)
        :param state: unit coordinates, shape (n_variables,); outside the box the nearest point of it counts
        """
        position = state * self.arrays.cells
        return interpolate(
            values, position, self.arrays.shape, self.arrays.strides, self._corner_index, self._corner_weight
        )


def default_resolution(n_variables: int, reach: float) -> int:
    """The coarsest resolution of use: at least 3, and a cell's diagonal must not exceed the kernel's reach.

    A grid point farther than the reach from every state that can be visited in its cell would stay optimistic for
    ever; and below eight cells a unit the interpolated values are too rough to act on.

    :param reach: distance at which the kernel falls to ``min_weight``, unit coordinates
    """
    return max(3, int(np.ceil(np.log2(np.sqrt(n_variables) / reach))))
