"""The finite sample of states on which Fitted R-Max plans: a grid over the unit box."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined
from sb3_combrel.common.periodic import flag_array
from sb3_combrel.common.user_warnings import warn_user

# More variables are interpolated between by simplices.
MAX_MULTILINEAR = 4
# In parts of a cell.
ON_LINE = 1e-9


class GridArrays(NamedTuple):
    """What compiled code needs to know of a grid.

    A state with unit coordinates u has *grid coordinates*, whole numbers at the grid points: u * cells + margin in an even
    grid, otherwise in proportion between the grid lines around it.
    """

    shape: np.ndarray  # int64, (n_variables,): points along each variable
    strides: np.ndarray  # int64, (n_variables,): what one step along a variable adds to a point's number
    cells: np.ndarray  # float64, (n_variables,): cells per unit
    margin: np.ndarray  # float64, (n_variables,): cells beyond either end of the unit box
    # The last point along a periodic variable is a cell away from the first; it has no margin.
    periodic: np.ndarray  # bool, (n_variables,)
    # float64, (n_variables, most points + 1): unit coordinates of the grid lines; of a periodic variable once more the first.
    lines: np.ndarray
    even: bool  # the lines of each variable are equally far from each other


@inlined
def unit_of_line(line, k, grid):
    """The unit coordinate of a grid line of variable ``k``."""
    return (line - grid.margin[k]) / grid.cells[k] if grid.even else grid.lines[k, line]


@inlined
def cell_width(line, above, k, grid):
    """The width, unit coordinates, of the cell of variable ``k`` above or below a grid line; infinite where there is none."""
    if grid.even:
        return 1.0 / grid.cells[k]
    n = grid.shape[k]
    if not grid.periodic[k] and line == (n - 1 if above else 0):
        return np.inf
    lower = line if above else (line - 1) % n
    return grid.lines[k, lower + 1] - grid.lines[k, lower]


@compiled
def between_lines(unit, k, grid):
    """The grid coordinate of a unit coordinate of variable ``k``, by the grid lines around it, or the nearest two."""
    low, high, turns = np.int64(0), grid.shape[k] - 1, 0.0
    if grid.periodic[k]:
        high += 1
        turns = np.floor(unit)
        unit -= turns
    turns *= high
    while high - low > 1:
        middle = (low + high) // 2
        if unit < grid.lines[k, middle]:
            high = middle
        else:
            low = middle
    return turns + low + (unit - grid.lines[k, low]) / (grid.lines[k, high] - grid.lines[k, low])


@inlined
def grid_coordinate(unit, k, grid):
    """The grid coordinate of a unit coordinate of variable ``k``."""
    return unit * grid.cells[k] + grid.margin[k] if grid.even else between_lines(unit, k, grid)


@inlined
def cells_away(line, away, k, grid):
    """How many cells of variable ``k`` a state is from a grid line, being ``away`` from it in unit coordinates."""
    return away * grid.cells[k] if grid.even else between_lines(grid.lines[k, line] + away, k, grid) - line


@inlined
def coordinates_of(point, grid, at):
    """Write the whole-numbered grid coordinates of a point to ``at``."""
    rest = point
    for k in range(len(grid.shape)):
        at[k] = rest // grid.strides[k]
        rest -= at[k] * grid.strides[k]


@inlined
def unit_coordinates_of(at, grid, state):
    """Write the unit coordinates of a grid point to ``state``, from its grid coordinates ``at``."""
    for k in range(len(at)):
        state[k] = unit_of_line(at[k], k, grid)


@inlined
def next_row(at, first, last):
    """Move ``at`` on to the next row of a box of grid points, a row being along the last variable; whether there is one.

    :param first: int64, shape (n_variables,): the box's first grid coordinate of each variable; ``last``: one past its last
    """
    k = len(at) - 2
    while k >= 0:
        at[k] += 1
        if at[k] < last[k]:
            break
        at[k] = first[k]
        k -= 1
    return k >= 0


def n_corners(n_variables: int) -> int:
    """Grid points between which is interpolated: those of a cell, or of a simplex of it for more than four variables."""
    return int(2**n_variables if n_variables <= MAX_MULTILINEAR else n_variables + 1)


@inlined
def cell_of(at, k, grid):
    """The cell of a grid coordinate along variable ``k``, wrapped or clipped into the grid; and the part of it beyond."""
    last = grid.shape[k] - 1
    if grid.periodic[k]:
        at += ON_LINE
        at -= grid.shape[k] * np.floor(at / grid.shape[k])
        # A tiny negative one is rounded up to the number of points.
        at = (at if at < grid.shape[k] else 0.0) - ON_LINE
    else:
        at = min(max(at, 0.0), float(last))
    # On a grid line but for rounding: half the corners, and half the work of planning.
    low = int(at + ON_LINE)
    part = at - low
    return low, part if part > ON_LINE else 0.0


@inlined
def step_along(low, k, grid):
    """What the next grid point along variable ``k`` adds to a point's number."""
    # Beyond the last point there is something between the points of a periodic variable only.
    return grid.strides[k] if low < grid.shape[k] - 1 else -(grid.shape[k] - 1) * grid.strides[k]


@compiled
def corners_of(position, grid, corner_index, corner_weight):
    """Write the grid points around ``position`` and their weights; how many have a weight above 0.

    Multilinear weights for up to four variables; for more those of Kuhn's simplices (Munos & Moore 2002), d + 1 corners.

    :param position: float64, shape (n_variables,): grid coordinates; wrapped or clipped into the grid
    :param corner_index: int64, shape (2 ** n_variables,); ``corner_weight``: float64, same shape
    """
    if len(position) > MAX_MULTILINEAR:
        return simplex_of(position, grid, corner_index, corner_weight)
    corner_index[0] = 0
    corner_weight[0] = 1.0
    n = 1
    for k in range(len(position)):
        low, part = cell_of(position[k], k, grid)
        for c in range(n):
            corner_index[c] += low * grid.strides[k]
        if part > 0.0:
            step = step_along(low, k, grid)
            for c in range(n):
                corner_index[n + c] = corner_index[c] + step
                corner_weight[n + c] = corner_weight[c] * part
                corner_weight[c] *= 1.0 - part
            n *= 2
    return n


@inlined
def simplex_of(position, grid, corner_index, corner_weight):
    """:func:`corners_of` for many variables: from the lowest corner of the cell on, the longest way first."""
    d = len(position)
    # Beyond the d + 1 corners there is room: the parts of a cell, and the steps along it, longest first.
    parts, steps = d + 1, d + 1
    base = np.int64(0)
    for k in range(d):
        low, part = cell_of(position[k], k, grid)
        base += low * grid.strides[k]
        step = step_along(low, k, grid)
        j = k
        while j > 0 and corner_weight[parts + j - 1] < part:
            corner_weight[parts + j] = corner_weight[parts + j - 1]
            corner_index[steps + j] = corner_index[steps + j - 1]
            j -= 1
        corner_weight[parts + j] = part
        corner_index[steps + j] = step
    corner_index[0] = base
    corner_weight[0] = 1.0
    n = 1
    for j in range(d):
        part = corner_weight[parts + j]
        if part > 0.0:
            corner_weight[n - 1] -= part
            corner_index[n] = corner_index[n - 1] + corner_index[steps + j]
            corner_weight[n] = part
            n += 1
    return n


@inlined
def grid_coordinates(state, grid, position):
    """Write the grid coordinates of a state to ``position``."""
    for k in range(len(state)):
        position[k] = grid_coordinate(state[k], k, grid)


@inlined
def interpolate(values, position, grid, corner_index, corner_weight):
    """The value at ``position`` (see :func:`corners_of`), multilinear between the grid points."""
    value = 0.0
    for c in range(corners_of(position, grid, corner_index, corner_weight)):
        value += corner_weight[c] * values[corner_index[c]]
    return value


class StateGrid:
    """A grid of 2**resolution cells along each variable of the unit box, and a margin around it (C order).

    In the margin a predicted successor outside the box has a value of its own; beyond that it counts as the nearest point.
    Along a periodic variable there are 2**resolution points and no margin.

    :param n_variables: number of state variables
    :param resolution: one number for all variables, or one for each
    :param margin: cells beyond either end of the box, along the variables that are not periodic
    :param periodic: one bool for each state variable; None: none is periodic
    :param lines: unit coordinates of the grid lines, ascending, shape (n_variables, most points + 1), only without a margin;
        None: those of an even grid
    """

    def __init__(
        self,
        n_variables: int,
        resolution: int | Sequence[int],
        margin: int = 0,
        periodic: Sequence[bool] | np.ndarray | None = None,
        lines: np.ndarray | None = None,
    ):
        per_variable = np.broadcast_to(np.asarray(resolution, dtype=np.int64), (n_variables,))
        flags = flag_array(periodic, n_variables)
        margins = np.where(flags, 0, margin)
        shape = np.where(flags, 2**per_variable, 2**per_variable + 1 + 2 * margins)
        strides = np.concatenate([np.cumprod(shape[:0:-1])[::-1], [1]]).astype(np.int64)
        self.n_variables = n_variables
        self.resolution = tuple(int(r) for r in per_variable)
        self.margin = margin
        self.n_points = int(np.prod(shape))
        cells, outside = 2.0**per_variable, margins.astype(np.float64)
        #: Where the lines of an even grid are, unit coordinates, shape (n_variables, most points + 1).
        self.even_lines = (np.arange(int(shape.max()) + 1) - outside[:, None]) / cells[:, None]
        lines = self.even_lines if lines is None else lines
        even = np.array_equal(lines, self.even_lines)
        self.arrays = GridArrays(shape, strides, cells, outside, flags, lines, even)
        # The same as a plain tuple (see ``common.compiled``).
        self.plain = tuple(self.arrays)

    def points(self) -> np.ndarray:
        """All grid points, unit coordinates, shape (n_points, n_variables)."""
        return self.states_of(np.arange(self.n_points))

    def states_of(self, points: np.ndarray) -> np.ndarray:
        """Unit coordinates, shape (n, n_variables), of grid points given by their numbers."""
        along = np.unravel_index(points, tuple(self.arrays.shape))
        return np.stack([self.arrays.lines[k, at] for k, at in enumerate(along)], axis=-1)

    def with_lines(self, lines: np.ndarray) -> StateGrid:
        """The same grid with other grid lines; an even one if a damaged file says some that do not ascend."""
        ascending = bool((np.diff(lines) > 0.0).all())
        return StateGrid(self.n_variables, self.resolution, self.margin, self.arrays.periodic, lines if ascending else None)

    def finer(self) -> StateGrid:
        """A grid of twice as many cells along each variable: its lines, and others in the middle between them."""
        finer = StateGrid(self.n_variables, [r + 1 for r in self.resolution], self.margin, self.arrays.periodic)
        if self.arrays.even:
            return finer
        lines = finer.even_lines.copy()
        for k, r in enumerate(self.resolution):
            n = 2**r
            lines[k, : 2 * n + 1] = np.interp(np.arange(2 * n + 1) / 2.0, np.arange(n + 1), self.arrays.lines[k, : n + 1])
        return finer.with_lines(lines)

    @property
    def diagonal(self) -> float:
        """Of the largest cell there could be, unit coordinates."""
        return float((np.diff(self.arrays.lines, axis=1).max(axis=1) ** 2).sum()) ** 0.5

    def coordinates(self, states: np.ndarray) -> np.ndarray:
        """Grid coordinates of states, unit coordinates, shape (n, n_variables)."""
        if self.arrays.even:
            return states * self.arrays.cells + self.arrays.margin
        return np.array([[between_lines(unit, k, self.arrays) for k, unit in enumerate(state)] for state in states])

    def interpolate(self, values: np.ndarray, state: np.ndarray) -> float:
        """Multilinear interpolation of values at the grid points at a state; outside the grid its nearest point counts."""
        position, n_corners = self.coordinates(state[None])[0], 2**self.n_variables
        return interpolate(values, position, self.arrays, np.empty(n_corners, dtype=np.int64), np.empty(n_corners))

    def cells_around(self, states: np.ndarray) -> np.ndarray:
        """The numbers of the corners of the cells that states are in, or of the nearest ones, shape (n, 2 ** n_variables)."""
        shape, strides, periodic = self.arrays.shape, self.arrays.strides, self.arrays.periodic
        below = np.floor(self.coordinates(states))
        low = np.where(periodic, below % shape, np.clip(below, 0, shape - 2)).astype(np.int64)
        high = np.where(periodic, (low + 1) % shape, low + 1)
        corners = np.zeros((len(states), 1), dtype=np.int64)
        for k in range(self.n_variables):
            corners = np.hstack([corners + side[:, k : k + 1] * strides[k] for side in (low, high)])
        return corners


def coarsest_in_reach(n_variables: int, reach: float) -> int:
    """The coarsest resolution at which a cell's diagonal does not exceed ``reach``."""
    return max(1, int(np.ceil(np.log2(np.sqrt(n_variables) / reach))))


# What the arrays of a pair and of a point may take, from the sizes of PairArrays, LinearArrays and MDPArrays.
BYTES_PER_PAIR = 1000
BYTES_PER_POINT = 200
MAX_PAIRS_BY_DEFAULT = 1_000_000
# Of more state variables than these a grid is coarse in any case.
MAX_VARIABLES = 6
FEWER_VARIABLES = (
    "fewer variables, chosen with a gymnasium.ObservationWrapper, and fewer actions are learned in fewer steps; for more "
    "there are DQN and PPO of Stable-Baselines3"
)


def fitting_grid(
    n_variables: int,
    n_actions: int,
    resolution: int | Sequence[int] | None,
    model_breadth: float,
    min_weight: float,
    periodic: Sequence[bool] | None = None,
) -> StateGrid:
    """The grid for a task: of the given resolution, or of one that suits the kernel; for up to two variables with a margin.

    :raises ValueError: if the grid would not fit in memory
    """
    reach = model_breadth * np.sqrt(-np.log(min_weight))
    margin = 1 if n_variables <= 2 else 0
    if resolution is None:
        # As fine as is cheap, and a cell's diagonal no longer than the reach, or points may stay optimistic for ever.
        resolution = max({1: 6, 2: 6, 3: 4}.get(n_variables, 3), coarsest_in_reach(n_variables, reach))
        while resolution > 1 and _n_points(n_variables, resolution, margin, periodic) * n_actions > MAX_PAIRS_BY_DEFAULT:
            resolution -= 1
    n_points, of_point = _n_points(n_variables, resolution, margin, periodic), n_actions * BYTES_PER_PAIR + BYTES_PER_POINT
    if n_points * of_point > _memory() / 2:
        fits = int(np.max(resolution))
        while fits > 0 and _n_points(n_variables, fits, margin, periodic) * of_point > _memory() / 2:
            fits -= 1
        raise ValueError(
            f"resolution={resolution} with {n_variables} state variables and {n_actions} actions means {n_points:,} grid "
            f"points and about {n_points * of_point / 2**30:,.1f} GiB of memory, more than half of what this machine has; "
            + (f"resolution={fits} fits" if fits > 0 else f"no resolution fits: {FEWER_VARIABLES}")
        )
    if n_variables <= MAX_VARIABLES:
        _warn_if_too_coarse(n_variables, resolution, reach, model_breadth)
    return StateGrid(n_variables, resolution, margin, periodic)


def _n_points(n_variables: int, resolution: int | Sequence[int], margin: int, periodic: Sequence[bool] | None) -> int:
    axes = np.broadcast_to(np.asarray(resolution), (n_variables,))
    ends = [0 if wraps else 1 + 2 * margin for wraps in flag_array(periodic, n_variables)]
    return int(np.prod([2 ** int(r) + end for r, end in zip(axes, ends, strict=True)], dtype=object))


def _memory() -> float:
    """Physical memory in bytes."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return 8 * 2.0**30


def _warn_if_too_coarse(n_variables: int, resolution: int | Sequence[int], reach: float, model_breadth: float) -> None:
    sides = 0.5 ** np.broadcast_to(np.asarray(resolution, dtype=np.float64), (n_variables,))
    diagonal = float(np.linalg.norm(sides))
    if diagonal > reach:
        warn_user(
            f"resolution={resolution} is coarse for model_breadth={model_breadth:g}: a grid cell's diagonal is "
            f"{diagonal:.3g}, but an instance reaches only {reach:.3g}, so some grid points may stay optimistic for "
            f"ever; resolution={coarsest_in_reach(n_variables, reach)} or model_breadth="
            f"{model_breadth * diagonal / reach:.3g} would be enough"
        )
