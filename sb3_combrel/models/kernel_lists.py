"""Compiled loops of the kernel model: which instances stand behind each state-action pair, and what they predict."""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import compiled, inlined, inner, part
from sb3_combrel.common.instances import put_instance
from sb3_combrel.common.kernels import corners_of, cut_by_fraction, insert_by_weight
from sb3_combrel.common.list_store import Pool, reserve


class ModelArrays(ArrayStruct):
    """The state of the kernel model; pair ``action * n_points + point`` is one state-action pair of the grid.

    :param lists: kept instances of each pair, heaviest first, with their kernel weights
    :param rows: what each settled pair leads to: grid points, with discounted probabilities (see ``build_row``)
    :param predecessors: for each grid point those whose rows have led to it, with a bound on that probability
    :param entry: float64, shape (n_pairs,): the weight that a further instance needs to enter the pair's list
    :param total: float64, shape (n_pairs,): sum of the kept weights
    :param known: bool, shape (n_pairs,): the target's own instances settle the pair
    :param settled: bool, shape (n_pairs,): the pair has a row, from its own or with transferred instances
    :param reward: float64, shape (n_pairs,): reward of the pair until its state is left
    :param heard: float64, shape (n_pairs,): what ``total`` was when the row was brought up to date
    :param n_optimistic: int64, shape (n_points,): actions of a grid point without a row
    :param members: int32, shape (n_actions, capacity): in how many lists each instance stands
    :param corner_low: int32, shape (n_actions, capacity, n_variables): the effect of each instance in cells, rounded down
    :param corner_offset: int32, shape (n_actions, capacity, 2 ** n_variables): where, counted from a grid point that it
        is applied to, the grid points around the place lie that the effect leads to; ``corner_weight``: float64, same
        shape, their multilinear weights
    """

    lists: Pool
    rows: Pool
    predecessors: Pool
    entry: np.ndarray
    total: np.ndarray
    known: np.ndarray
    settled: np.ndarray
    reward: np.ndarray
    heard: np.ndarray
    n_optimistic: np.ndarray
    members: np.ndarray
    corner_low: np.ndarray
    corner_offset: np.ndarray
    corner_weight: np.ndarray


class Scratch(ArrayStruct):
    """Work space of the compiled loops, allocated once.

    :param kernel: float64, shape (n_variables, largest axis of the grid): one-dimensional kernel factors
    :param first: int64, shape (n_variables,): first grid coordinate within reach; ``last``: one past the last
    :param at: int64, shape (n_variables,): a grid coordinate
    :param position: float64, shape (n_variables,)
    :param corner_index: int64, shape (2 ** n_variables,); ``corner_weight``: float64, same shape
    :param dense: float64, shape (n_points,), all 0 between calls
    :param touched: int64, shape (2 * n_points,)
    :param told: float64, shape (n_points,), all 0 between calls
    :param point: int64, shape (n_points,); ``weight``: float64, same shape: pairs that an instance reaches
    """

    kernel: np.ndarray
    first: np.ndarray
    last: np.ndarray
    at: np.ndarray
    position: np.ndarray
    corner_index: np.ndarray
    corner_weight: np.ndarray
    dense: np.ndarray
    touched: np.ndarray
    told: np.ndarray
    point: np.ndarray
    weight: np.ndarray

    @classmethod
    def for_grid(cls, grid) -> "Scratch":
        """Work space for a :class:`StateGrid`."""
        d, n_points = grid.n_variables, grid.n_points
        return cls(
            kernel=np.empty((d, int(grid.arrays.shape.max()))),
            first=np.empty(d, dtype=np.int64),
            last=np.empty(d, dtype=np.int64),
            at=np.empty(d, dtype=np.int64),
            position=np.empty(d),
            corner_index=np.empty(2**d, dtype=np.int64),
            corner_weight=np.empty(2**d),
            dense=np.zeros(n_points),
            touched=np.empty(2 * n_points, dtype=np.int64),
            told=np.zeros(n_points),
            point=np.empty(n_points, dtype=np.int64),
            weight=np.empty(n_points),
        )


@part
def points_in_reach(state, breadth, min_weight, grid, entry, scratch):
    """Grid points at which an instance at ``state`` weighs at least ``min_weight`` and ``entry``.

    The kernel is a product of one factor a variable, so the exponentials are few: one for each grid coordinate.

    :param entry: float64, shape (n_points,)
    :return: how many; they and the weights are in ``scratch.point`` and ``scratch.weight``
    """
    d = len(state)
    reach = breadth * np.sqrt(-np.log(min_weight)) * (1 + 1e-12)
    for k in range(d):
        scratch.first[k] = max(0, int(np.ceil((state[k] - reach) * grid.cells[k] + grid.margin[k])))
        beyond = int(np.floor((state[k] + reach) * grid.cells[k] + grid.margin[k])) + 1
        scratch.last[k] = min(grid.shape[k], beyond)
        if scratch.first[k] >= scratch.last[k]:
            return 0
        for j in range(scratch.first[k], scratch.last[k]):
            apart = ((j - grid.margin[k]) / grid.cells[k] - state[k]) / breadth
            scratch.kernel[k, j] = np.exp(-apart * apart)
        scratch.at[k] = scratch.first[k]
    found = 0
    inner = d - 1
    while True:
        outer_weight = 1.0
        base = 0
        for k in range(inner):
            outer_weight *= scratch.kernel[k, scratch.at[k]]
            base += scratch.at[k] * grid.strides[k]
        if outer_weight >= min_weight:
            for j in range(scratch.first[inner], scratch.last[inner]):
                w = outer_weight * scratch.kernel[inner, j]
                if w >= entry[base + j] and w >= min_weight:
                    scratch.point[found] = base + j
                    scratch.weight[found] = w
                    found += 1
        k = inner - 1
        while k >= 0:
            scratch.at[k] += 1
            if scratch.at[k] < scratch.last[k]:
                break
            scratch.at[k] = scratch.first[k]
            k -= 1
        if k < 0:
            return found


@compiled
def enter(instances, arrays, grid, kernel, thresholds, action, slot, state, next_state, reward, terminated, scratch, progress):
    """Write an instance to its slot, and put it into the lists of all pairs that it reaches.

    :param kernel: (breadth, min_weight, min_fraction)
    :param thresholds: (weight that makes a pair known, change of its weight that makes another one worth settling anew)
    :param progress: int64, shape (3,): pairs in reach, how many of them are done, and how many of these are worth settling
        anew, whose points are moved to the front of ``scratch.point``; {-1, 0, 0} at first
    :return: False if the lists' pool must grow before another call goes on
    """
    breadth, min_weight, min_fraction = kernel
    threshold, news = thresholds
    n_points = len(arrays.n_optimistic)
    first_pair = action * n_points
    if progress[0] < 0:
        put_instance(instances, action, slot, state, next_state, reward, terminated)
        note_corners(arrays, instances.effect[action, slot], grid, action, slot)
        entry = arrays.entry[first_pair : first_pair + n_points]
        progress[0] = points_in_reach(instances.state[action, slot], breadth, min_weight, grid, entry, scratch)
    lists = arrays.lists
    while progress[1] < progress[0]:
        point = scratch.point[progress[1]]
        pair = first_pair + point
        length = np.int64(lists.length[pair])
        if not reserve(lists, pair, length + 1):
            return False
        start = lists.start[pair]
        weight = scratch.weight[progress[1]]
        kept, total = insert_by_weight(
            lists.index, lists.weight, start, length, arrays.total[pair], slot, weight, min_fraction
        )
        arrays.members[action, slot] += 1
        for k in range(start + kept, start + length + 1):
            arrays.members[action, lists.index[k]] -= 1
        lists.length[pair] = kept
        arrays.total[pair] = total
        arrays.entry[pair] = min(lists.weight[start + kept - 1], min_fraction * total)
        if total >= threshold:
            arrays.known[pair] = True
        if arrays.known[pair] or abs(total - arrays.heard[pair]) >= news:
            scratch.point[progress[2]] = point
            progress[2] += 1
        progress[1] += 1
    return True


@compiled
def leave_lists(instances, arrays, grid, kernel, action, slot, anywhere, scratch):
    """Take an instance out of the lists in which it stands.

    :param kernel: (breadth, min_weight, min_fraction)
    :param anywhere: zeros, shape (n_points,)
    :return: how many lists changed; their points are moved to the front of ``scratch.point``
    """
    breadth, min_weight, min_fraction = kernel
    n_found = points_in_reach(instances.state[action, slot], breadth, min_weight, grid, anywhere, scratch)
    first_pair = action * len(arrays.n_optimistic)
    lists = arrays.lists
    changed = 0
    for f in range(n_found):
        point = scratch.point[f]
        pair = first_pair + point
        start = lists.start[pair]
        length = lists.length[pair]
        k = 0
        while k < length and lists.index[start + k] != slot:
            k += 1
        if k == length:
            continue
        for j in range(start + k, start + length - 1):
            lists.index[j] = lists.index[j + 1]
            lists.weight[j] = lists.weight[j + 1]
        lists.length[pair] = length - 1
        _, arrays.total[pair] = cut_by_fraction(lists.weight, start, length - 1, min_fraction)
        if length == 1:
            arrays.known[pair] = False
            arrays.entry[pair] = 0.0
        else:
            arrays.entry[pair] = min(lists.weight[start + length - 2], min_fraction * arrays.total[pair])
        scratch.point[changed] = point
        changed += 1
    arrays.members[action, slot] = 0
    return changed


@part
def note_corners(arrays, effect, grid, action, slot):
    """Work out ``corner_low``, ``corner_offset`` and ``corner_weight`` of an instance: the same for all grid points."""
    low = arrays.corner_low[action, slot]
    offset = arrays.corner_offset[action, slot]
    weight = arrays.corner_weight[action, slot]
    offset[0] = 0
    weight[0] = 1.0
    n_corners = 1
    for k in range(len(effect)):
        moved = effect[k] * grid.cells[k]
        low[k] = int(np.floor(moved))
        part = moved - low[k]
        for c in range(n_corners):
            offset[c] += low[k] * grid.strides[k]
            offset[n_corners + c] = offset[c] + grid.strides[k]
            weight[n_corners + c] = weight[c] * part
            weight[c] *= 1.0 - part
        n_corners *= 2


@part
def scatter_instance(p, arrays, instances, action, i, point, scratch, grid, n_touched):
    """Spread probability ``p`` of the effect of an instance from a grid point, at ``scratch.at``, over grid points."""
    for k in range(len(grid.shape)):
        low = scratch.at[k] + arrays.corner_low[action, i, k]
        if low < 0 or low + 1 >= grid.shape[k]:
            return scatter(p, instances.effect[action, i], scratch, grid, n_touched)
    for c in range(arrays.corner_offset.shape[2]):
        weight = arrays.corner_weight[action, i, c]
        if weight > 0.0:
            to = point + arrays.corner_offset[action, i, c]
            if scratch.dense[to] == 0.0:
                scratch.touched[n_touched] = to
                n_touched += 1
            scratch.dense[to] += p * weight
    return n_touched


@inner
def scatter(p, effect, scratch, grid, n_touched):
    """Spread probability ``p`` of moving by ``effect`` from the grid coordinate ``scratch.at`` over grid points."""
    for k in range(len(effect)):
        scratch.position[k] = scratch.at[k] + effect[k] * grid.cells[k]
    n_corners = corners_of(scratch.position, grid.shape, grid.strides, scratch.corner_index, scratch.corner_weight)
    for c in range(n_corners):
        point = scratch.corner_index[c]
        if scratch.dense[point] == 0.0:
            scratch.touched[n_touched] = point
            n_touched += 1
        scratch.dense[point] += p * scratch.corner_weight[c]
    return n_touched


@inlined
def next_power(weight):
    """The least power of two that is not below ``weight``."""
    return 2.0 ** np.ceil(np.log2(weight))


@inner
def note_predecessor(predecessors, to, point, weight):
    """Enter ``point`` among those that lead ``to`` a point with a probability of ``weight``; False if the pool must grow.

    The next power of two is noted, so that a little more of the same is no news: to find one among the predecessors
    takes longer than to work out an entry of a row.
    """
    weight = next_power(weight)
    start = predecessors.start[to]
    length = predecessors.length[to]
    for k in range(start, start + length):
        if predecessors.index[k] == point:
            predecessors.weight[k] = max(predecessors.weight[k], weight)
            return True
    if not reserve(predecessors, to, length + 1):
        return False
    end = predecessors.start[to] + length
    predecessors.index[end] = point
    predecessors.weight[end] = weight
    predecessors.length[to] = length + 1
    return True


@part
def store_row(arrays, pair, point, n_touched, discount, scratch):
    """Write the probabilities in ``scratch.dense``, discounted, to a pair's row, and have predecessors noted.

    :param discount: 0: the row is left empty
    :return: False if the predecessors' pool must grow; the row is empty then
    """
    slot = arrays.rows.start[pair]
    n_old = arrays.rows.length[pair]
    for k in range(n_old):
        to = arrays.rows.index[slot + k]
        scratch.told[to] = arrays.rows.weight[slot + k]
        scratch.touched[n_touched + k] = to
    length = 0
    room = True
    for t in range(n_touched):
        to = scratch.touched[t]
        if to != point and discount > 0.0:
            weight = scratch.dense[to] * discount
            told = scratch.told[to]
            if weight > told and (told == 0.0 or weight > next_power(told)):
                room = room and note_predecessor(arrays.predecessors, to, point, weight)
            arrays.rows.index[slot + length] = to
            arrays.rows.weight[slot + length] = weight
            length += 1
        scratch.dense[to] = 0.0
    for t in range(n_touched, n_touched + n_old):
        scratch.told[scratch.touched[t]] = 0.0
    arrays.rows.length[pair] = length if room else 0
    return room


@part
def build_row(arrays, instances, grid, gamma, pair, supply, s, scratch):
    """Turn a pair's instances into its row: R and discounted probabilities of the *other* grid points.

    A grid point is often its own successor. Staying is summed as the geometric series it is: reward and
    probabilities are divided by 1 - gamma * P(stay), which leaves the fixed point of the value function as it was
    and saves most of the sweeps. A pair that never leaves gets an infinite reward (of the reward's sign), which the
    planner cuts to its bounds; so does one whose instances are all that is known of a terminal reward of 0.

    :param s: row of ``supply`` that belongs to the pair; counts only while the pair is not known
    :return: False if a pool must grow first
    """
    n_points = len(arrays.n_optimistic)
    action = pair // n_points
    point = pair - action * n_points
    start = arrays.lists.start[pair]
    n_own = arrays.lists.length[pair]
    n_supplied = 0 if arrays.known[pair] else supply.count[s]
    total = arrays.total[pair] if n_own > 0 else 0.0
    for j in range(n_supplied):
        total += supply.weight[s, j]
    rest = point
    for k in range(len(grid.shape)):
        scratch.at[k] = rest // grid.strides[k]
        rest -= scratch.at[k] * grid.strides[k]
    reward = 0.0
    n_touched = np.int64(0)
    for k in range(start, start + n_own):
        i = arrays.lists.index[k]
        p = arrays.lists.weight[k] / total
        reward += p * instances.reward[action, i]
        if not instances.terminated[action, i]:
            n_touched = scatter_instance(p, arrays, instances, action, i, point, scratch, grid, n_touched)
    for j in range(n_supplied):
        p = supply.weight[s, j] / total
        reward += p * supply.reward[s, j]
        if not supply.terminated[s, j]:
            n_touched = scatter(p, supply.effect[s, j], scratch, grid, n_touched)
    if not reserve(arrays.rows, pair, n_touched):
        for t in range(n_touched):
            scratch.dense[scratch.touched[t]] = 0.0
        return False
    leave = 1.0 - gamma * scratch.dense[point]
    stays_for_ever = leave < 1e-9
    discount = 0.0 if stays_for_ever else gamma / leave
    if not store_row(arrays, pair, point, n_touched, discount, scratch):
        return False
    if stays_for_ever:
        arrays.reward[pair] = 0.0 if reward == 0.0 else np.inf * reward
    else:
        arrays.reward[pair] = reward / leave
    return True


@compiled
def settle(arrays, instances, grid, gamma, pairs, done, supply, scratch):
    """Bring the rows of ``pairs`` up to date with their lists and the supply of transferred instances.

    :return: how many of them are done; fewer than all if a pool must grow first
    """
    n_points = len(arrays.n_optimistic)
    while done < len(pairs):
        pair = pairs[done]
        has_row = arrays.known[pair] or supply.count[done] > 0
        if has_row and not build_row(arrays, instances, grid, gamma, pair, supply, done, scratch):
            return done
        arrays.heard[pair] = arrays.total[pair]
        if has_row != arrays.settled[pair]:
            if not has_row:
                arrays.rows.length[pair] = 0
                arrays.reward[pair] = 0.0
            arrays.settled[pair] = has_row
            arrays.n_optimistic[pair % n_points] += -1 if has_row else 1
        done += 1
    return done


@compiled
def renew_predecessors(arrays):
    """Forget predecessors that no row needs any more; False if their pool must grow before another call."""
    arrays.predecessors.length[:] = np.int32(0)
    n_points = len(arrays.n_optimistic)
    for pair in range(len(arrays.reward)):
        if arrays.settled[pair]:
            start = arrays.rows.start[pair]
            for k in range(start, start + arrays.rows.length[pair]):
                to = np.int64(arrays.rows.index[k])
                if not note_predecessor(arrays.predecessors, to, pair % n_points, arrays.rows.weight[k]):
                    return False
    return True
