"""Dynamic programming on the grid: plain Gauss-Seidel sweeps of Bellman backups, up and down in turn."""

from typing import Any

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, entry_point, inlined
from sb3_combrel.planning.grid import GridArrays, coordinates_of, next_row
from sb3_combrel.planning.mdp import FiniteMDP


@inlined
def backed_up(values, mdp, upper, worth, lowest, searching, point):
    """V(point) = max over a of Q(point, a), Fitted R-Max's backup.

    :param mdp: the first arrays of ``MDPArrays``
    :param upper: upper bound of each value
    :param worth: value of an optimistic action at each point; while the agent is searching, of being there
    """
    to, weight, length, reward, modelled, n_optimistic = mdp
    best = worth[point] if searching or n_optimistic[point] > 0 else lowest
    if best < upper[point]:
        for action in range(reward.shape[1]):
            if modelled[action * len(values) + point]:
                q = reward[point, action]
                for k in range(length[point, action]):
                    q += weight[point, action, k] * values[to[point, action, k]]
                best = max(best, q)
        best = min(best, upper[point])
    return best


@entry_point
def sweep(values, mdp, upper, worth, lowest, searching, downwards):
    """Back up all grid points; the largest change. Parameters: see :func:`backed_up`.

    :param values: updated in place
    """
    n_points = len(values)
    largest = 0.0
    for step in range(n_points):
        point = n_points - 1 - step if downwards else step
        best = backed_up(values, mdp, upper, worth, lowest, searching, point)
        largest = max(largest, abs(best - values[point]))
        values[point] = best
    return largest


@inlined
def mark_around(point, span, grid, marks, scratch):
    """Mark the grid points from which a pair may lead to ``point``, those within ``span`` of it; how many they are."""
    first, last, at = scratch[0], scratch[1], scratch[2]
    n_marked, inner = 1, len(span) - 1
    coordinates_of(point, grid, at)
    for k in range(len(span)):
        first[k], last[k] = max(0, at[k] - span[k]), min(grid.shape[k], at[k] + span[k] + 1)
        if grid.periodic[k] and last[k] - first[k] <= 2 * span[k]:
            # The way around.
            first[k], last[k] = 0, grid.shape[k]
        at[k] = first[k]
        n_marked *= last[k] - first[k]
    while True:
        base = 0
        for k in range(inner):
            base += at[k] * grid.strides[k]
        marks[base + first[inner] : base + last[inner]] = True
        if not next_row(at, first, last):
            return n_marked


@entry_point
def sweep_changes(values, mdp, upper, worth, lowest, searching, tolerance, told, changed, span, grid, scratch, downwards):
    """Back up the grid points on which changes of rows and values bear; the largest change. See :func:`backed_up`.

    A value that has changed by more than ``tolerance`` bears on the points from which a pair may lead there. When as many have
    been marked as there are points, all are backed up.

    :param told: each value when its change was last passed on
    :param changed: bool, shape (n_points,): points to be backed up; in place
    :param span: see ``MDPArrays``; plain tuple for ``grid``
    :param scratch: int64, shape (3, n_variables): work space
    """
    grid = GridArrays(*grid)
    n_points = len(values)
    largest, n_marked = 0.0, 0
    for step in range(n_points):
        point = n_points - 1 - step if downwards else step
        if not changed[point]:
            continue
        changed[point] = n_marked >= n_points
        values[point] = backed_up(values, mdp, upper, worth, lowest, searching, point)
        change = abs(values[point] - told[point])
        if change > tolerance:
            largest = max(largest, change)
            told[point] = values[point]
            if n_marked < n_points:
                n_marked += mark_around(point, span, grid, changed, scratch)
                if n_marked >= n_points:
                    changed[:] = True
    return largest


class Planner:
    """The value function at the grid points, kept near the fixed point of the MDP's Bellman backups.

    :param mdp: the finite MDP
    :param max_value: value of an optimistic pair, and upper bound of all values; lower ones: see :meth:`set_upper`
    :param min_value: lower bound of all values, reached only by states that lead nowhere
    :param tolerance: sweeps end when no value changes by more
    :param follows_changes: whether sweeps leave points out on which no change bears that is larger than the tolerance
    """

    def __init__(self, mdp: FiniteMDP, *, max_value: float, min_value: float, tolerance: float, follows_changes: bool = False):
        self.mdp = mdp
        self.follows_changes = follows_changes
        self.tolerance = float(tolerance)
        self.bounds = (float(min_value), float(max_value))
        #: Upper bound of the value of each grid point.
        self.upper = np.full(mdp.grid.n_points, float(max_value))
        #: What an optimistic action is worth at each: its upper bound, or less while the agent is searching.
        self.worth = self.upper
        #: Whether the values of some grid points are bounded by less than ``max_value``.
        self.is_bounded = False
        self.values = self.upper.copy()
        # For sweeps that follow changes: each value when it was last passed on, what all values depend on, and work space.
        self._told, self._rules = self.values.copy(), (self.bounds[0], False)
        self._scratch = np.empty((3, mdp.grid.n_variables), dtype=np.int64)

    def sweep(self, max_sweeps: int) -> int:
        """Back up the points, up and down the grid in turn, until little changes; the sweeps that this took."""
        lowest, searching = rules = self.bounds[0], self.worth is not self.upper
        *rows, span, changed = self.mdp.arrays
        given = self.values, tuple(rows), self.upper, self.worth, lowest, searching
        if not self.follows_changes:
            return self._repeat(sweep, given, max_sweeps)
        if rules != self._rules:
            self._rules = rules
            changed[:] = True
        more = self.tolerance, self._told, changed, span, self.mdp.grid.plain, self._scratch
        return self._repeat(sweep_changes, given + more, max_sweeps)

    def cautious_values(self, max_sweeps: int) -> np.ndarray:
        """Values at the grid points without optimism, from below: of ways that exist, however few sweeps there are."""
        values = np.full(len(self.values), self.bounds[0])
        # What nobody has seen is worth the least there is.
        self._repeat(sweep, (values, self.mdp.arrays[:-2], self.upper, values.copy(), self.bounds[0], False), max_sweeps)
        return values

    def _repeat(self, sweep_once: EntryPoint, given: tuple[Any, ...], max_sweeps: int) -> int:
        """Sweep until little changes, up and down in turn; how often."""
        for n in range(max_sweeps):
            if sweep_once.call(*given, n % 2 == 1) <= self.tolerance:
                return n + 1
        return max_sweeps

    def set_worth(self, worth: np.ndarray | None) -> None:
        """Give points a worth of their own, which the agent may go there for.

        :param worth: shape (n_points,), no more than the upper bounds; None: none, optimistic actions have the upper bounds
        """
        worth = self.upper if worth is None else np.maximum(worth, self.bounds[0])
        if self.follows_changes and worth is not self.worth:
            self.mdp.arrays.changed[worth != self.worth] = True
        self.worth = worth

    def set_max_value(self, max_value: float) -> None:
        """Change the value of what is optimistic; the others follow by sweeps."""
        before, self.bounds = self.bounds[1], (self.bounds[0], float(max_value))
        self.upper[:] = np.where(self.upper == before, max_value, np.minimum(self.upper, max_value))
        self._bound_values()

    def set_upper(self, upper: np.ndarray | None) -> None:
        """Bound the values of grid points, and so what is optimistic, by less than ``max_value``.

        :param upper: shape (n_points,), no more than ``max_value`` counts; None: ``max_value`` everywhere
        :raises ValueError: if there is not one number for each grid point
        """
        if upper is not None and (np.shape(upper) != self.upper.shape or not np.isfinite(upper).all()):
            raise ValueError(
                f"value_bound() must return None or a finite number for each of the {len(self.upper)} states of the sample, "
                f"got an array of shape {np.shape(upper)} with {int(np.isfinite(upper).sum())} finite numbers"
            )
        self.upper[:] = self.bounds[1] if upper is None else np.clip(upper, *self.bounds)
        self.is_bounded = bool((self.upper < self.bounds[1]).any())
        self._bound_values()

    def _bound_values(self) -> None:
        """Take over other upper bounds: optimistic points have them, unless the agent is searching, and are worth less."""
        optimistic = (self.mdp.arrays.n_optimistic > 0) & (self.worth is self.upper)
        self.restore(np.where(optimistic, self.upper, self.values))

    def restore(self, values: np.ndarray) -> None:
        """Replace the values by saved ones."""
        self.values[:] = np.clip(values, self.bounds[0], self.upper)
        self._told[:] = self.values
        self.mdp.arrays.changed[:] = True

    def get_state(self) -> dict[str, np.ndarray]:
        """Values, float64, and what sweeps that follow changes have not passed on yet: to be saved."""
        state, arrays = {"values": self.values.copy(), "lowest_value": np.array([self.bounds[0]])}, self.mdp.arrays
        if self.follows_changes:
            changed = arrays.changed | (self._rules != (self.bounds[0], self.worth is not self.upper))
            state["passed_on"] = np.column_stack([self._told, changed])
            state["span"] = arrays.span.astype(np.float64)
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned; the rows of the finite MDP are what they were then."""
        self.restore(state["values"])
        if self.follows_changes:
            arrays = self.mdp.arrays
            self._told[:], arrays.changed[:] = state["passed_on"][:, 0], state["passed_on"][:, 1] > 0.5
            arrays.span[:] = np.maximum(arrays.span, state["span"].astype(np.int64))
            self._rules = self.bounds[0], self.worth is not self.upper
