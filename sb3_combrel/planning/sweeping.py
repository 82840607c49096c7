"""Dynamic programming on the grid: changes are passed on to predecessors, with a bound on the work of each step."""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import SameTypes, compiled, inlined, inner, part
from sb3_combrel.common.kernels import corners_of
from sb3_combrel.models.kernel_average import MOST_PAIRS_AT_ONCE, KernelModel
from sb3_combrel.planning.exploitation import exploitation_sweep

EXPLOITATION_SWEEPS = 300
NOWHERE = np.empty(0)


class SweepQueue(ArrayStruct):
    """Grid points that wait for a backup, in a ring, and what is known of each point's actions without one.

    :param ring: int32, shape (n_points,)
    :param ends: int64, shape (2,): where in the ring the first waits, and how many wait
    :param waiting: bool, shape (n_points,)
    :param announced: float64, shape (n_points,): the value that the point's predecessors were last told
    :param pending: float64, shape (n_points,): what has been announced to the point since its last backup, each change
        times its probability: a bound on the change that a backup would make
    :param greedy: int16, shape (n_points,): the action that gave the point its value, -1 if none did
    :param q: float64, shape (n_points, n_actions): Q of each pair when it was last worked out
    :param slack: float64, same shape: how far Q may have moved since, besides ``pending``; inf: by any amount
    """

    ring: np.ndarray
    ends: np.ndarray
    waiting: np.ndarray
    announced: np.ndarray
    pending: np.ndarray
    greedy: np.ndarray
    q: np.ndarray
    slack: np.ndarray

    @classmethod
    def empty(cls, values: np.ndarray, n_actions: int) -> "SweepQueue":
        """Nothing waits, and everybody knows ``values``."""
        n_points = len(values)
        return cls(
            ring=np.empty(n_points, dtype=np.int32),
            ends=np.zeros(2, dtype=np.int64),
            waiting=np.zeros(n_points, dtype=np.bool_),
            announced=values.copy(),
            pending=np.zeros(n_points),
            greedy=np.full(n_points, -1, dtype=np.int16),
            q=np.zeros((n_points, n_actions)),
            slack=np.full((n_points, n_actions), np.inf),
        )


@inlined
def push(queue, point):
    """Let ``point`` wait for a backup."""
    end = queue.ends[0] + queue.ends[1]
    queue.ring[end - len(queue.ring) if end >= len(queue.ring) else end] = point
    queue.ends[1] += 1
    queue.waiting[point] = True


@inlined
def pop(queue):
    """The point that has waited longest, -1 if none waits."""
    if queue.ends[1] == 0:
        return np.int64(-1)
    point = np.int64(queue.ring[queue.ends[0]])
    queue.ends[0] = queue.ends[0] + 1 if queue.ends[0] + 1 < len(queue.ring) else 0
    queue.ends[1] -= 1
    queue.waiting[point] = False
    return point


@inlined
def work_out(values, arrays, queue, point, action):
    """Q of a pair that is settled, from its row."""
    pair = point + action * len(values)
    q = arrays.reward[pair]
    start = arrays.rows.start[pair]
    for k in range(start, start + arrays.rows.length[pair]):
        q += arrays.rows.weight[k] * values[arrays.rows.index[k]]
    queue.q[point, action] = q
    queue.slack[point, action] = 0.0
    return q


@inner
def back_up(values, arrays, queue, point, bounds, tolerance):
    """V(point) = max over a of Q(point, a), Fitted R-Max's backup; ``max_value`` while an action is optimistic.

    Starts with the action that was best. Of the others, only those are worked out that can have become better: rows
    lie all over the memory, and to read them takes most of the time of planning.
    """
    pending = queue.pending[point]
    greedy = np.int64(queue.greedy[point])
    queue.pending[point] = 0.0
    queue.greedy[point] = -1
    if arrays.n_optimistic[point] > 0:
        values[point] = bounds[1]
        return
    best = bounds[0]
    if greedy >= 0:
        q = work_out(values, arrays, queue, point, greedy)
        if q > best:
            best = q
            queue.greedy[point] = greedy
    for action in range(queue.q.shape[1]):
        if action == greedy:
            continue
        # What nobody was told of adds up to two tolerances.
        if queue.q[point, action] + queue.slack[point, action] + pending + 2.0 * tolerance <= best:
            queue.slack[point, action] += pending
            continue
        q = work_out(values, arrays, queue, point, action)
        if q > best:
            best = q
            queue.greedy[point] = action
    values[point] = min(best, bounds[1])


@part
def take_over(values, arrays, queue, pair, bounds, tolerance):
    """Bring V of the pair's point up to date when nothing but the pair's row has changed."""
    action = pair // len(values)
    point = pair - action * len(values)
    greedy = np.int64(queue.greedy[point])
    queue.slack[point, action] = np.inf
    if greedy < 0 or greedy == action or arrays.n_optimistic[point] > 0:
        back_up(values, arrays, queue, point, bounds, tolerance)
    elif work_out(values, arrays, queue, point, action) >= values[point]:
        values[point] = min(queue.q[point, action], bounds[1])
        queue.greedy[point] = action


@inner
def announce(values, arrays, queue, point, tolerance):
    """Tell the predecessors of ``point`` how far its value has moved; who may move by more than ``tolerance`` waits."""
    change = abs(values[point] - queue.announced[point])
    if change <= tolerance:
        return
    queue.announced[point] = values[point]
    start = arrays.predecessors.start[point]
    for k in range(start, start + arrays.predecessors.length[point]):
        before = np.int64(arrays.predecessors.index[k])
        queue.pending[before] += change * arrays.predecessors.weight[k]
        if queue.pending[before] > tolerance and not queue.waiting[before] and arrays.n_optimistic[before] == 0:
            push(queue, before)


@part
def back_up_around(values, arrays, queue, state, grid, bounds, tolerance, scratch):
    """Back up the grid points around ``state`` that have been announced a change; backups done.

    Where the agent is, a wrong promise must not wait its turn: it would wait with it.
    """
    for k in range(len(state)):
        scratch.position[k] = state[k] * grid.cells[k] + grid.margin[k]
    backups = 0
    for c in range(corners_of(scratch.position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)):
        point = scratch.corner_index[c]
        if queue.pending[point] > 0.0 and arrays.n_optimistic[point] == 0:
            back_up(values, arrays, queue, point, bounds, tolerance)
            announce(values, arrays, queue, point, tolerance)
            backups += 1
    return backups


@compiled
def sweep(values, arrays, queue, changed, grid, bounds, tolerance, max_backups, around, scratch):
    """Take over the pairs ``changed``, then back up the points that wait, in the order of their coming.

    With the largest change first, states from which no known way leads on would be backed up again and again, their
    values falling by a step's reward each time, before any other.

    :param values: float64, shape (n_points,), updated in place
    :param bounds: (min_value, max_value)
    :param max_backups: of those that wait; the rest waits for the next call
    :param around: a state around which all is backed up, unit coordinates; or nothing, shape (0,)
    :return: backups done
    """
    for c in range(len(changed)):
        take_over(values, arrays, queue, changed[c], bounds, tolerance)
        announce(values, arrays, queue, changed[c] % len(values), tolerance)
    backups = len(changed)
    most = backups + max_backups
    while backups < most:
        point = pop(queue)
        if point < 0:
            break
        if arrays.n_optimistic[point] > 0 and values[point] == bounds[1]:
            continue
        back_up(values, arrays, queue, point, bounds, tolerance)
        backups += 1
        announce(values, arrays, queue, point, tolerance)
    if len(around) > 0:
        backups += back_up_around(values, arrays, queue, around, grid, bounds, tolerance, scratch)
    return backups


@compiled
def sweep_all(values, arrays, queue, bounds, tolerance, most_passes):
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
                queue.slack[point] = np.inf
                back_up(values, arrays, queue, point, bounds, tolerance)
                largest = max(largest, abs(values[point] - before))
                backups += 1
        if largest <= tolerance:
            for point in range(n_points):
                queue.announced[point] = values[point]
                queue.pending[point] = 0.0
                queue.waiting[point] = False
            queue.ends[1] = 0
            return backups
    for point in range(n_points):
        announce(values, arrays, queue, point, tolerance)
        queue.slack[point] = np.inf
    return backups


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
        self.queue = SweepQueue.empty(self.values, model.n_actions)
        self._sweep = SameTypes(sweep)
        self._sweep_all = SameTypes(sweep_all)
        self._exploitation: np.ndarray | None = None

    def update(self, pairs: np.ndarray, max_backups: int, around: np.ndarray = NOWHERE) -> int:
        """Bring the rows of ``pairs`` up to date, then back up these points and what waits.

        :param pairs: pairs whose model changed
        :param max_backups: of the points that wait; the others wait for the next call
        :param around: a state, unit coordinates: the grid points around it need not wait
        :return: backups done
        """
        self._exploitation = None
        backups = 0
        while len(pairs) > MOST_PAIRS_AT_ONCE:
            backups += self._settle_and_sweep(pairs[:MOST_PAIRS_AT_ONCE], 0, NOWHERE)
            pairs = pairs[MOST_PAIRS_AT_ONCE:]
        return backups + self._settle_and_sweep(pairs, max_backups, around)

    def _settle_and_sweep(self, pairs: np.ndarray, max_backups: int, around: np.ndarray) -> int:
        model = self.model
        model.settle(pairs)
        backups: int = self._sweep(
            self.values,
            model.arrays,
            self.queue,
            pairs,
            model.grid.arrays,
            self.bounds,
            self.tolerance,
            max_backups,
            around,
            model.scratch,
        )
        return backups

    def sweep_all(self, most_passes: int) -> int:
        """Back up all points up to ``most_passes`` times, where most of the model is new; backups done."""
        self._exploitation = None
        arguments = (self.values, self.model.arrays, self.queue, self.bounds, self.tolerance, most_passes)
        return int(self._sweep_all(*arguments))

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
        self.queue = queue = SweepQueue.empty(self.values, self.model.n_actions)
        points = np.flatnonzero(self.model.arrays.n_optimistic == 0)
        queue.ring[: len(points)] = points
        queue.ends[1] = len(points)
        queue.waiting[points] = True

    def start_anew(self) -> None:
        """Forget how the values came about, as if they and the model had been restored."""
        self.model.renew_predecessors()
        self.restore(self.values)

    @property
    def n_waiting(self) -> int:
        """Grid points that wait for a backup."""
        return int(self.queue.ends[1])
