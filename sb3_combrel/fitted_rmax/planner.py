"""Dynamic programming on the grid: prioritized sweeping with a bound on the work of each step."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import SameTypes, compiled, inlined
from sb3_combrel.fitted_rmax.exploitation import exploitation_sweep
from sb3_combrel.fitted_rmax.model import MOST_PAIRS_AT_ONCE, KernelModel
from sb3_combrel.fitted_rmax.model_kernels import settle

N_LEVELS = 24
EXPLOITATION_SWEEPS = 300


class SweepQueue(NamedTuple):
    """Grid points that wait for a backup, in a ring for each power of two of the change that called for it.

    :param ring: int32, shape (N_LEVELS, n_points)
    :param head: int64, shape (N_LEVELS,); ``size``: int64, same shape
    :param level: int8, shape (n_points,): where a point waits, -1 if nowhere
    :param queued: bool, shape (N_LEVELS, n_points): the point stands in that ring, waiting or passed over
    :param announced: float64, shape (n_points,): the value that the point's predecessors were last told
    :param greedy: int16, shape (n_points,): the action that gave the point its value, -1 if none did
    """

    ring: np.ndarray
    head: np.ndarray
    size: np.ndarray
    level: np.ndarray
    queued: np.ndarray
    announced: np.ndarray
    greedy: np.ndarray

    @classmethod
    def empty(cls, values: np.ndarray) -> "SweepQueue":
        """Nothing waits, and everybody knows ``values``."""
        n_points = len(values)
        return cls(
            ring=np.empty((N_LEVELS, n_points), dtype=np.int32),
            head=np.zeros(N_LEVELS, dtype=np.int64),
            size=np.zeros(N_LEVELS, dtype=np.int64),
            level=np.full(n_points, -1, dtype=np.int8),
            queued=np.zeros((N_LEVELS, n_points), dtype=np.bool_),
            announced=values.copy(),
            greedy=np.full(n_points, -1, dtype=np.int16),
        )


@inlined
def push(queue, point, level):
    """Let ``point`` wait for a backup; points of higher levels come first."""
    queue.level[point] = level
    if not queue.queued[level, point]:
        n_points = queue.ring.shape[1]
        end = queue.head[level] + queue.size[level]
        queue.ring[level, end - n_points if end >= n_points else end] = point
        queue.size[level] += 1
        queue.queued[level, point] = True


@compiled
def push_all(queue, points):
    """Let ``points`` wait for a backup, after all others."""
    for p in range(len(points)):
        push(queue, points[p], 0)


@inlined
def pop(queue):
    """The point to back up next, -1 if none waits."""
    n_points = queue.ring.shape[1]
    level = N_LEVELS - 1
    while level >= 0:
        if queue.size[level] == 0:
            level -= 1
            continue
        point = queue.ring[level, queue.head[level]]
        queue.head[level] = queue.head[level] + 1 if queue.head[level] + 1 < n_points else 0
        queue.size[level] -= 1
        queue.queued[level, point] = False
        if queue.level[point] == level:
            queue.level[point] = -1
            return point
    return -1


@inlined
def forget(values, queue):
    """Nothing waits any more, and everybody knows ``values``."""
    for point in range(len(values)):
        queue.announced[point] = values[point]
        queue.level[point] = -1
        for level in range(N_LEVELS):
            queue.queued[level, point] = False
    for level in range(N_LEVELS):
        queue.size[level] = 0


@inlined
def value_of_pair(values, arrays, pair):
    """Q of a pair that is settled."""
    q = arrays.reward[pair]
    start = arrays.rows.start[pair]
    for k in range(start, start + arrays.rows.length[pair]):
        q += arrays.rows.weight[k] * values[arrays.rows.index[k]]
    return q


@compiled
def back_up(values, arrays, queue, point, bounds):
    """V(point) = max over a of Q(point, a), Fitted R-Max's backup; ``max_value`` while an action is optimistic."""
    n_points = len(values)
    queue.greedy[point] = -1
    if arrays.n_optimistic[point] > 0:
        values[point] = bounds[1]
        return
    best = bounds[0]
    for action in range(len(arrays.reward) // n_points):
        q = value_of_pair(values, arrays, point + action * n_points)
        if q > best:
            best = q
            queue.greedy[point] = action
    values[point] = min(best, bounds[1])


@inlined
def take_over(values, arrays, queue, pair, bounds):
    """Bring V of the pair's point up to date when nothing but the pair's row has changed."""
    n_points = len(values)
    action = pair // n_points
    point = pair - action * n_points
    greedy = queue.greedy[point]
    if greedy < 0 or arrays.n_optimistic[point] > 0:
        back_up(values, arrays, queue, point, bounds)
        return
    q = value_of_pair(values, arrays, pair)
    if q >= values[point]:
        values[point] = min(q, bounds[1])
        queue.greedy[point] = action
    elif greedy == action:
        back_up(values, arrays, queue, point, bounds)


@inlined
def announce(values, n_optimistic, queue, point, reach, grid, tolerance, at):
    """Have every grid point that may lead to ``point`` wait for a backup, the sooner the larger the change."""
    change = abs(values[point] - queue.announced[point])
    if change <= tolerance:
        return
    queue.announced[point] = values[point]
    level = min(N_LEVELS - 1, int(np.log2(change / tolerance)))
    d = len(grid.shape)
    inner = d - 1
    rest = point
    base = 0
    for k in range(d):
        c = rest // grid.strides[k]
        rest -= c * grid.strides[k]
        at[0, k] = max(0, c - reach[1, k])
        at[1, k] = min(grid.shape[k] - 1, c - reach[0, k])
        at[2, k] = at[0, k]
        if k < inner:
            base += at[0, k] * grid.strides[k]
    while True:
        for j in range(at[0, inner], at[1, inner] + 1):
            if queue.level[base + j] < level and n_optimistic[base + j] == 0 and base + j != point:
                push(queue, base + j, level)
        k = inner - 1
        while k >= 0:
            at[2, k] += 1
            base += grid.strides[k]
            if at[2, k] <= at[1, k]:
                break
            base -= (at[2, k] - at[0, k]) * grid.strides[k]
            at[2, k] = at[0, k]
            k -= 1
        if k < 0:
            return


@compiled
def sweep(values, arrays, queue, changed, grid, bounds, tolerance, max_backups, at):
    """Take over the pairs ``changed``, then back up the points that wait, largest change first.

    :param values: float64, shape (n_points,), updated in place
    :param bounds: (min_value, max_value)
    :param max_backups: of those that wait; the rest waits for the next call
    :param at: int64 scratch, shape (3, n_variables)
    :return: backups done
    """
    for c in range(len(changed)):
        take_over(values, arrays, queue, changed[c], bounds)
        point = changed[c] % len(values)
        announce(values, arrays.n_optimistic, queue, point, arrays.reach, grid, tolerance, at)
    backups = 0
    while backups < max_backups:
        point = pop(queue)
        if point < 0:
            break
        if arrays.n_optimistic[point] > 0 and values[point] == bounds[1]:
            continue
        back_up(values, arrays, queue, point, bounds)
        backups += 1
        announce(values, arrays.n_optimistic, queue, point, arrays.reach, grid, tolerance, at)
    return backups + len(changed)


@compiled
def sweep_all(values, arrays, queue, grid, bounds, tolerance, most_passes, at):
    """Back up all points, one after the other, up and down the grid until little changes; what is left waits.

    Points in the order in which their rows lie in memory take a fourth of the time of points here and there: where
    most of the model is new this comes to rest several times sooner than :func:`sweep`.

    :return: backups done
    """
    n_points = len(values)
    backups = 0
    for n in range(most_passes):
        largest = 0.0
        for step in range(n_points):
            point = step if n % 2 == 0 else n_points - 1 - step
            before = values[point]
            if arrays.n_optimistic[point] == 0 or before != bounds[1]:
                back_up(values, arrays, queue, point, bounds)
                largest = max(largest, abs(values[point] - before))
                backups += 1
        if largest <= tolerance:
            forget(values, queue)
            return backups
    for point in range(n_points):
        announce(values, arrays.n_optimistic, queue, point, arrays.reach, grid, tolerance, at)
    return backups


@compiled
def settle_and_sweep(
    values, arrays, instances, queue, pairs, supply, grid, gamma, bounds, tolerance, max_backups, scratch, at
):
    """``settle`` and :func:`sweep` in one call: handing over arrays takes as long as the work of a common step.

    :param pairs: at most MOST_PAIRS_AT_ONCE
    :return: backups done; -1, and nothing swept, if the rows' pool must grow first
    """
    if settle(arrays, instances, grid, gamma, pairs, 0, supply, scratch) < len(pairs):
        return -1
    return sweep(values, arrays, queue, pairs, grid, bounds, tolerance, max_backups, at)


class Planner:
    """The value function at the grid points, kept near the fixed point of the model's backups.

    :param model: the kernel model, whose pairs are all optimistic or will be announced to :meth:`update`
    :param max_value: value of an optimistic pair, and upper bound of all values
    :param min_value: lower bound of all values, reached only by states that lead nowhere
    :param tolerance: changes up to this are not passed on
    """

    def __init__(self, model: KernelModel, *, max_value: float, min_value: float, tolerance: float):
        self.model = model
        self.tolerance = float(tolerance)
        self.bounds = (float(min_value), float(max_value))
        self.values = np.full(model.grid.n_points, float(max_value))
        self.queue = SweepQueue.empty(self.values)
        self._settle_and_sweep = SameTypes(settle_and_sweep)
        self._sweep_all = SameTypes(sweep_all)
        self._sweep = SameTypes(sweep)
        self._at = np.empty((3, model.grid.n_variables), dtype=np.int64)
        self._exploitation: np.ndarray | None = None

    def update(self, pairs: np.ndarray, max_backups: int) -> int:
        """Bring the rows of ``pairs`` up to date, then back up these points and what waits, largest change first.

        :param pairs: pairs whose model changed
        :param max_backups: of the points that wait; the others wait for the next call
        :return: backups done
        """
        model = self.model
        if len(pairs) <= MOST_PAIRS_AT_ONCE:
            self._exploitation = None
            backups = self._settle_and_sweep(
                self.values,
                model.arrays,
                model.instances,
                self.queue,
                pairs,
                model.supply_for(pairs),
                model.grid.arrays,
                model.gamma,
                self.bounds,
                self.tolerance,
                max_backups,
                model.scratch,
                self._at,
            )
            if backups >= 0:
                return backups
        model.settle(pairs)
        return self.sweep(pairs, max_backups)

    def sweep(self, pairs: np.ndarray, max_backups: int) -> int:
        """Take over settled ``pairs``, then back up ``max_backups`` points of those that wait; backups done."""
        self._exploitation = None
        model = self.model
        return self._sweep(
            self.values,
            model.arrays,
            self.queue,
            pairs,
            model.grid.arrays,
            self.bounds,
            self.tolerance,
            max_backups,
            self._at,
        )

    def sweep_all(self, most_passes: int) -> int:
        """Back up all points up to ``most_passes`` times, where most of the model is new; backups done."""
        self._exploitation = None
        model = self.model
        return self._sweep_all(
            self.values,
            model.arrays,
            self.queue,
            model.grid.arrays,
            self.bounds,
            self.tolerance,
            most_passes,
            self._at,
        )

    def exploitation_values(self) -> np.ndarray:
        """Values at the grid points without optimism, for evaluation; worked out once for each state of the model.

        From the optimistic values downwards: where no known way leads anywhere the values keep falling, so the number
        of sweeps is bounded.
        """
        if self._exploitation is None:
            model = self.model
            values = self.values.copy()
            for n in range(EXPLOITATION_SWEEPS):
                change = exploitation_sweep(values, model.arrays, model.n_actions, model.grid.arrays, self.bounds, n % 2 == 1)
                if change <= self.tolerance:
                    break
            self._exploitation = values
        return self._exploitation

    def restore(self, values: np.ndarray) -> None:
        """Take over saved values; every point with a row is backed up once more when there is time."""
        self._exploitation = None
        self.values[:] = np.clip(values, *self.bounds)
        self.queue = SweepQueue.empty(self.values)
        push_all(self.queue, np.flatnonzero(self.model.arrays.n_optimistic == 0))

    @property
    def n_waiting(self) -> int:
        """Grid points that wait for a backup."""
        return int((self.queue.level >= 0).sum())
