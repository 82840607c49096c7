"""Dynamic programming on the grid: prioritised sweeping, with a bound on the work of each step."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined, part
from sb3_combrel.planning.grid import GridArrays, corners_of, grid_coordinates
from sb3_combrel.planning.mdp import FiniteMDP, RowScratch, as_mdp

EXPLOITATION_SWEEPS = 300
NOWHERE = np.empty(0)


class SweepQueue(NamedTuple):
    """Grid points that are due for a backup, in a ring, and bounds on what a backup of the others would change."""

    ring: np.ndarray  # int32, (n_points,)
    ends: np.ndarray  # int64, (2,): where in the ring the first point is, and how many are queued
    queued: np.ndarray  # bool, (n_points,)
    propagated: np.ndarray  # float64, (n_points,): the value of a point that was last propagated to its predecessors
    # Changes propagated to a point since its last backup, each times its probability: a bound on what a backup would change.
    priority: np.ndarray  # float64, (n_points,)
    greedy: np.ndarray  # int16, (n_points,): the action that gave the point its value, -1 if none did
    q: np.ndarray  # float64, (n_points, n_actions): Q of each pair when it was last computed
    slack: np.ndarray  # float64, the same: how far Q may have moved since, besides ``priority``; inf: by any amount
    upper: np.ndarray  # float64, (n_points,): upper bound of each point's value, its value while an action is optimistic

    @classmethod
    def empty(cls, values: np.ndarray, n_actions: int, upper: np.ndarray) -> "SweepQueue":
        """Make a queue of no points; ``values`` count as propagated, ``upper`` is not copied."""
        n_points = len(values)
        return cls(
            ring=np.empty(n_points, dtype=np.int32),
            ends=np.zeros(2, dtype=np.int64),
            queued=np.zeros(n_points, dtype=np.bool_),
            propagated=values.copy(),
            priority=np.zeros(n_points),
            greedy=np.full(n_points, -1, dtype=np.int16),
            q=np.zeros((n_points, n_actions)),
            slack=np.full((n_points, n_actions), np.inf),
            upper=upper,
        )


@inlined
def push(queue, point):
    """Append ``point`` to the queue."""
    end = queue.ends[0] + queue.ends[1]
    queue.ring[end - len(queue.ring) if end >= len(queue.ring) else end] = point
    queue.ends[1] += 1
    queue.queued[point] = True


@inlined
def pop(queue):
    """Take the first point from the queue; -1 if it is empty."""
    if queue.ends[1] == 0:
        return np.int64(-1)
    point = np.int64(queue.ring[queue.ends[0]])
    queue.ends[0] = queue.ends[0] + 1 if queue.ends[0] + 1 < len(queue.ring) else 0
    queue.ends[1] -= 1
    queue.queued[point] = False
    return point


@inlined
def value_of_row(values, mdp, pair):
    """Reward of a pair that has a model, and the values of its successors."""
    q = mdp.reward[pair]
    start = mdp.rows.start[pair]
    for k in range(start, start + mdp.rows.length[pair]):
        q += mdp.rows.weight[k] * values[mdp.rows.item[k]]
    return q


@inlined
def compute_q(values, mdp, queue, point, action):
    """Compute Q of a pair that has a model from its row."""
    q = value_of_row(values, mdp, point + action * len(values))
    queue.q[point, action] = q
    queue.slack[point, action] = 0.0
    return q


@inlined
def bellman_backup(values, mdp, queue, point, bounds, tolerance):
    """V(point) = max over a of Q(point, a), Fitted R-Max's backup; the upper bound while an action is optimistic.

    Starts with the action that was best; of the others, only those are computed that can have become better.
    """
    priority = queue.priority[point]
    greedy = np.int64(queue.greedy[point])
    queue.priority[point] = 0.0
    queue.greedy[point] = -1
    if mdp.n_optimistic[point] > 0:
        values[point] = queue.upper[point]
        return
    best = bounds[0]
    if greedy >= 0:
        q = compute_q(values, mdp, queue, point, greedy)
        if q > best:
            best = q
            queue.greedy[point] = greedy
    for action in range(queue.q.shape[1]):
        if action == greedy:
            continue
        # What has not been propagated adds up to two tolerances.
        if queue.q[point, action] + queue.slack[point, action] + priority + 2.0 * tolerance <= best:
            queue.slack[point, action] += priority
            continue
        q = compute_q(values, mdp, queue, point, action)
        if q > best:
            best = q
            queue.greedy[point] = action
    values[point] = min(best, queue.upper[point])


@part
def backup_after_change(values, mdp, queue, pair, bounds, tolerance):
    """Bring V of the pair's point up to date when nothing but the pair's row has changed."""
    action = pair // len(values)
    point = pair - action * len(values)
    greedy = np.int64(queue.greedy[point])
    queue.slack[point, action] = np.inf
    if greedy < 0 or greedy == action or mdp.n_optimistic[point] > 0:
        bellman_backup(values, mdp, queue, point, bounds, tolerance)
    elif compute_q(values, mdp, queue, point, action) >= values[point]:
        values[point] = min(queue.q[point, action], queue.upper[point])
        queue.greedy[point] = action


@inlined
def propagate(values, mdp, queue, point, tolerance):
    """Add the change of a point's value to its predecessors' priority; those above ``tolerance`` are queued."""
    change = abs(values[point] - queue.propagated[point])
    if change <= tolerance:
        return
    queue.propagated[point] = values[point]
    start = mdp.predecessors.start[point]
    for k in range(start, start + mdp.predecessors.length[point]):
        before = np.int64(mdp.predecessors.item[k])
        queue.priority[before] += change * mdp.predecessors.weight[k]
        if queue.priority[before] > tolerance and not queue.queued[before] and mdp.n_optimistic[before] == 0:
            push(queue, before)


@part
def backup_around(values, mdp, queue, state, grid, bounds, tolerance, scratch):
    """Back up the grid points around ``state`` that a change has been propagated to, or the agent stays; how many."""
    grid_coordinates(state, grid, scratch.position)
    backups = 0
    for c in range(corners_of(scratch.position, grid, scratch.corner_index, scratch.corner_weight)):
        point = scratch.corner_index[c]
        if queue.priority[point] > 0.0 and mdp.n_optimistic[point] == 0:
            bellman_backup(values, mdp, queue, point, bounds, tolerance)
            propagate(values, mdp, queue, point, tolerance)
            backups += 1
    return backups


@compiled
def sweep(values, mdp, queue, grid, limits, changed, around, scratch):
    """Back up the points of the pairs ``changed``, then the points in the queue, first in, first out; backups done.

    With the largest change first, states from which no known way leads on would be backed up again and again, their
    values falling by a step's reward each time, before any other.

    :param values: updated in place; plain tuples for ``mdp``, ``queue``, ``grid`` and ``scratch``
    :param limits: ((min_value, max_value), tolerance, max_backups); ``around``: see :meth:`Planner.update`
    """
    mdp, queue, grid, scratch = as_mdp(mdp), SweepQueue(*queue), GridArrays(*grid), RowScratch(*scratch)
    bounds, tolerance, max_backups = limits
    for c in range(len(changed)):
        backup_after_change(values, mdp, queue, changed[c], bounds, tolerance)
        propagate(values, mdp, queue, changed[c] % len(values), tolerance)
    backups = len(changed)
    end = backups + max_backups
    while backups < end:
        point = pop(queue)
        if point < 0:
            break
        if mdp.n_optimistic[point] > 0 and values[point] == queue.upper[point]:
            continue
        bellman_backup(values, mdp, queue, point, bounds, tolerance)
        backups += 1
        propagate(values, mdp, queue, point, tolerance)
    if len(around) > 0:
        backups += backup_around(values, mdp, queue, around, grid, bounds, tolerance, scratch)
    return backups


@compiled
def sweep_all(values, mdp, queue, bounds, tolerance, max_passes):
    """Back up all points, up and down the grid in turn, until little changes; predecessors of the rest are queued."""
    n_points = len(values)
    backups = 0
    for n in range(max_passes):
        largest = 0.0
        for step in range(n_points):
            point = step if n % 2 == 0 else n_points - 1 - step
            before = values[point]
            if mdp.n_optimistic[point] == 0 or before != queue.upper[point]:
                queue.slack[point] = np.inf
                bellman_backup(values, mdp, queue, point, bounds, tolerance)
                largest = max(largest, abs(values[point] - before))
                backups += 1
        if largest <= tolerance:
            for point in range(n_points):
                queue.propagated[point] = values[point]
                queue.priority[point] = 0.0
                queue.queued[point] = False
            queue.ends[1] = 0
            return backups
    for point in range(n_points):
        propagate(values, mdp, queue, point, tolerance)
        queue.slack[point] = np.inf
    return backups


@compiled
def exploitation_sweep(values, mdp, n_actions, grid, bounds, downwards):
    """One Gauss-Seidel sweep for evaluation, over the pairs that have a model, without optimism; the largest change.

    A grid point without any such pair takes the least value of its neighbours along the axes.
    """
    n_points = len(values)
    largest = 0.0
    for step in range(n_points):
        point = n_points - 1 - step if downwards else step
        if mdp.n_optimistic[point] == n_actions:
            best = np.inf
            rest = point
            for k in range(len(grid.shape)):
                at = rest // grid.strides[k]
                rest -= at * grid.strides[k]
                around = (grid.shape[k] - 1) * grid.strides[k]
                if at > 0:
                    best = min(best, values[point - grid.strides[k]])
                elif grid.periodic[k]:
                    best = min(best, values[point + around])
                if at < grid.shape[k] - 1:
                    best = min(best, values[point + grid.strides[k]])
                elif grid.periodic[k]:
                    best = min(best, values[point - around])
        else:
            best = bounds[0]
            for pair in range(point, len(mdp.reward), n_points):
                if mdp.modelled[pair]:
                    best = max(best, value_of_row(values, mdp, pair))
            best = min(best, bounds[1])
        largest = max(largest, abs(best - values[point]))
        values[point] = best
    return largest


_sweep, _sweep_all, _exploitation_sweep = EntryPoint(sweep), EntryPoint(sweep_all), EntryPoint(exploitation_sweep)


class Planner:
    """The value function at the grid points, kept near the fixed point of the MDP's Bellman backups.

    :param mdp: the finite MDP; pairs whose rows change are given to :meth:`update`
    :param max_value: value of an optimistic pair, and upper bound of all values; lower ones: see :meth:`set_upper`
    :param min_value: lower bound of all values, reached only by states that lead nowhere
    :param tolerance: changes up to this are not propagated
    """

    def __init__(self, mdp: FiniteMDP, *, max_value: float, min_value: float, tolerance: float):
        self.mdp = mdp
        self.tolerance = float(tolerance)
        self.bounds = (float(min_value), float(max_value))
        #: Upper bound of the value of each grid point, and its value while an action is optimistic.
        self.upper = np.full(mdp.grid.n_points, float(max_value))
        #: Whether the values of some grid points are bounded by less than ``max_value``.
        self.is_bounded = False
        self.values = self.upper.copy()
        self._set_queue(SweepQueue.empty(self.values, mdp.n_actions, self.upper))
        self._exploitation: np.ndarray | None = None

    def _set_queue(self, queue: SweepQueue) -> None:
        self.queue, self._plain_queue = queue, tuple(queue)

    def update(self, pairs: np.ndarray, max_backups: int, around: np.ndarray = NOWHERE) -> int:
        """Back up the points of pairs whose rows have changed, and points in the queue.

        :param pairs: int64
        :param max_backups: of points in the queue; the others stay there
        :param around: a state, unit coordinates: the grid points around it need not wait
        :return: backups done
        """
        self._exploitation = None
        mdp, limits = self.mdp, (self.bounds, self.tolerance, max_backups)
        changed = pairs, around, mdp.plain_scratch
        return int(_sweep.call(self.values, mdp.plain, self._plain_queue, mdp.grid.plain, limits, *changed))

    def sweep_all(self, max_passes: int) -> int:
        """Back up all points up to ``max_passes`` times, where most of the MDP is new; backups done."""
        self._exploitation = None
        return int(_sweep_all.call(self.values, self.mdp.arrays, self.queue, self.bounds, self.tolerance, max_passes))

    def exploitation_values(self) -> np.ndarray:
        """Values at the grid points without optimism, for evaluation; computed once for each state of the MDP."""
        if self._exploitation is None:
            mdp = self.mdp
            values = self.values.copy()
            for n in range(EXPLOITATION_SWEEPS):
                change = _exploitation_sweep.call(values, mdp.arrays, mdp.n_actions, mdp.grid.arrays, self.bounds, n % 2 == 1)
                if change <= self.tolerance:
                    break
            self._exploitation = values
        return self._exploitation

    def set_upper(self, upper: np.ndarray | None) -> None:
        """Bound the values of grid points, and so what is optimistic, by less than ``max_value``; every point is queued.

        :param upper: shape (n_points,), no more than ``max_value`` counts; None: ``max_value`` everywhere
        :raises ValueError: if there is not one number for each grid point
        """
        if upper is not None and (np.shape(upper) != self.upper.shape or not np.isfinite(upper).all()):
            raise ValueError(
                f"value_bound() must return None or a finite number for each of the {len(self.upper)} states of the sample, "
                f"got an array of shape {np.shape(upper)} with {int(np.isfinite(upper).sum())} finite numbers"
            )
        bounded = np.full(len(self.upper), self.bounds[1]) if upper is None else np.clip(upper, *self.bounds)
        if np.array_equal(bounded, self.upper):
            return
        self.upper[:] = bounded
        self.is_bounded = bool((bounded < self.bounds[1]).any())
        self.restore(np.where(self.mdp.arrays.n_optimistic > 0, bounded, self.values))

    def restore(self, values: np.ndarray) -> None:
        """Replace the values by saved ones; every point with a model is queued."""
        self._exploitation = None
        self.values[:] = np.clip(values, self.bounds[0], self.upper)
        queue = SweepQueue.empty(self.values, self.mdp.n_actions, self.upper)
        self._set_queue(queue)
        points = np.flatnonzero(self.mdp.arrays.n_optimistic == 0)
        queue.ring[: len(points)] = points
        queue.ends[1] = len(points)
        queue.queued[points] = True

    def restart(self) -> None:
        """Forget how the values were reached, as if they and the MDP had been restored."""
        self.mdp.renew_predecessors()
        self.restore(self.values)

    @property
    def n_queued(self) -> int:
        """Grid points in the queue."""
        return int(self.queue.ends[1])
