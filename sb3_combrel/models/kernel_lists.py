"""Compiled loops of the kernel average: which instances are near each state-action pair, and what they predict."""

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.instances import Instances, put_instance
from sb3_combrel.common.kernels import cut_by_fraction, insert_by_weight
from sb3_combrel.common.list_store import ListStore, reserve
from sb3_combrel.common.periodic import difference
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.compiled_model import add_to_row, total_weight
from sb3_combrel.planning.grid import GridArrays
from sb3_combrel.planning.mdp import RowScratch, add_successor, as_mdp, coordinates_of, finish_row, set_modelled


class KernelLists(NamedTuple):
    """The kept instances of each pair of the grid (pair ``action * n_points + point``)."""

    lists: ListStore  # kept instances of each pair, heaviest first, with their kernel weights
    entry: np.ndarray  # float64, (n_pairs,): the weight that a further instance needs to enter the pair's list
    total: np.ndarray  # float64, (n_pairs,): sum of the kept weights
    last_total: np.ndarray  # float64, (n_pairs,): what ``total`` was when the pair's row was updated
    known: np.ndarray  # bool, (n_pairs,): the target's own instances suffice
    n_lists: np.ndarray  # int32, (n_actions, capacity): how many lists each instance is in
    # The effect of each instance in cells, rounded down; relative to a grid point, the points around where it leads; their
    # multilinear weights.
    corner_low: np.ndarray  # int32, (n_actions, capacity, n_variables)
    corner_offset: np.ndarray  # int32, (n_actions, capacity, 2 ** n_variables)
    corner_weight: np.ndarray  # float64, the same

    def plain(self) -> tuple[Any, ...]:
        """The same as plain tuples (see ``common.compiled``)."""
        return tuple(self.lists), *self[1:]


@inlined
def as_lists(plain):
    """:class:`KernelLists` from plain tuples."""
    lists = ListStore(*plain[0])
    return KernelLists(lists, plain[1], plain[2], plain[3], plain[4], plain[5], plain[6], plain[7], plain[8])


class ReachScratch(NamedTuple):
    """Work space for the grid points that an instance reaches."""

    kernel: np.ndarray  # float64, (n_variables, largest axis of the grid): one-dimensional kernel factors
    # First grid coordinate within reach, one past the last (which may come before the first), the present one.
    at: np.ndarray  # int64, (3, n_variables)
    point: np.ndarray  # int64, (n_points,): points within reach
    weight: np.ndarray  # float64, the same: the instance's weight there


@part
def factors_in_reach(state, kernel, grid, scratch):
    """Write the kernel's factors and what grid coordinates are within reach; whether there are any along every variable."""
    breadth, min_weight, _ = kernel
    first, last, at = scratch.at[0], scratch.at[1], scratch.at[2]
    reach = breadth * np.sqrt(-np.log(min_weight)) * (1 + 1e-12)
    for k in range(len(state)):
        begin = int(np.ceil((state[k] - reach) * grid.cells[k] + grid.margin[k]))
        beyond = int(np.floor((state[k] + reach) * grid.cells[k] + grid.margin[k])) + 1
        n = grid.shape[k]
        if not grid.periodic[k]:
            begin = max(0, begin)
            beyond = min(n, beyond)
        elif beyond - begin >= n:
            begin, beyond = 0, n
        else:
            turns = begin // n
            begin -= turns * n
            beyond -= turns * n
        if begin >= beyond:
            return False
        for j in range(begin, beyond):
            point = j if j < n else j - n
            apart = difference((point - grid.margin[k]) / grid.cells[k], state[k], grid.periodic[k]) / breadth
            scratch.kernel[k, point] = np.exp(-apart * apart)
        first[k] = begin
        # Beyond the last point of a periodic variable come the first ones.
        last[k] = beyond if beyond <= n else beyond - n
        at[k] = begin
    return True


@part
def points_in_reach(state, kernel, grid, entry, scratch):
    """How many grid points an instance at ``state`` weighs ``min_weight`` at, and ``entry``, shape (n_points,), or more.

    They and the weights are in ``scratch.point`` and ``scratch.weight``. The kernel is a product of one factor a variable.
    """
    _, min_weight, _ = kernel
    first, last, at = scratch.at[0], scratch.at[1], scratch.at[2]
    if not factors_in_reach(state, kernel, grid, scratch):
        return 0
    found = 0
    inner = len(state) - 1
    n_runs = 1 if first[inner] < last[inner] else 2
    while True:
        outer_weight = 1.0
        base = 0
        for k in range(inner):
            outer_weight *= scratch.kernel[k, at[k]]
            base += at[k] * grid.strides[k]
        if outer_weight >= min_weight:
            for run in range(n_runs):
                begin = first[inner] if run == 0 else 0
                end = grid.shape[inner] if run + 1 < n_runs else last[inner]
                for j in range(begin, end):
                    w = outer_weight * scratch.kernel[inner, j]
                    if w >= entry[base + j] and w >= min_weight:
                        scratch.point[found] = base + j
                        scratch.weight[found] = w
                        found += 1
        k = inner - 1
        while k >= 0:
            at[k] += 1
            if at[k] != last[k]:
                if at[k] == grid.shape[k]:
                    at[k] = 0
                break
            at[k] = first[k]
            k -= 1
        if k < 0:
            return found


# What ``progress`` of :func:`enter` begins with: the instance is to be written to its slot first, or stands there.
TO_BE_PUT, IN_ITS_SLOT = -1, -2


@compiled
def enter(instances, arrays, grid, kernel, thresholds, transition, scratch, progress):
    """Write an instance to its slot, and put it into the lists of all pairs that it reaches; plain tuples.

    :param kernel: (breadth, min_weight, min_fraction)
    :param thresholds: (weight that makes a pair known, change of the weight of another pair that has its row updated)
    :param transition: (action, slot, state, next_state, reward, terminated)
    :param progress: int64, shape (3,): pairs in reach, how many of them are done, and how many of these are to be updated,
        whose points are moved to the front of ``scratch.point``; TO_BE_PUT or IN_ITS_SLOT, 0, 0 at first
    :return: False if there is no room for the lists: they must grow before another call goes on
    """
    instances, arrays, grid, scratch = Instances(*instances), as_lists(arrays), GridArrays(*grid), ReachScratch(*scratch)
    _, _, min_fraction = kernel
    threshold, min_change = thresholds
    action, slot, _, _, _, _ = transition
    n_points = grid.shape[0] * grid.strides[0]
    first_pair = action * n_points
    if progress[0] == TO_BE_PUT:
        put_instance(instances, transition)
    if progress[0] < 0:
        note_corners(arrays, instances.effect[action, slot], grid, action, slot)
        entry = arrays.entry[first_pair : first_pair + n_points]
        progress[0] = points_in_reach(instances.state[action, slot], kernel, grid, entry, scratch)
    lists = arrays.lists
    while progress[1] < progress[0]:
        point = scratch.point[progress[1]]
        pair = first_pair + point
        length = np.int64(lists.length[pair])
        if not reserve(lists, pair, length + 1):
            return False
        start = lists.start[pair]
        weight = scratch.weight[progress[1]]
        kept, total = insert_by_weight(lists.item, lists.weight, start, length, arrays.total[pair], slot, weight, min_fraction)
        arrays.n_lists[action, slot] += 1
        for k in range(start + kept, start + length + 1):
            arrays.n_lists[action, lists.item[k]] -= 1
        lists.length[pair] = kept
        arrays.total[pair] = total
        arrays.entry[pair] = min(lists.weight[start + kept - 1], min_fraction * total)
        if total >= threshold:
            arrays.known[pair] = True
        if arrays.known[pair] or abs(total - arrays.last_total[pair]) >= min_change:
            scratch.point[progress[2]] = point
            progress[2] += 1
        progress[1] += 1
    return True


@compiled
def leave_lists(instances, arrays, grid, kernel, action, slot, anywhere, scratch):
    """Take an instance out of the lists that it is in; how many changed, whose points are moved to ``scratch.point``."""
    _, _, min_fraction = kernel
    n_found = points_in_reach(instances.state[action, slot], kernel, grid, anywhere, scratch)
    first_pair = action * grid.shape[0] * grid.strides[0]
    lists = arrays.lists
    changed = 0
    for f in range(n_found):
        point = scratch.point[f]
        pair = first_pair + point
        start = lists.start[pair]
        length = lists.length[pair]
        k = 0
        while k < length and lists.item[start + k] != slot:
            k += 1
        if k == length:
            continue
        for j in range(start + k, start + length - 1):
            lists.item[j] = lists.item[j + 1]
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
    arrays.n_lists[action, slot] = 0
    return changed


@part
def note_corners(arrays, effect, grid, action, slot):
    """Compute ``corner_low``, ``corner_offset`` and ``corner_weight`` of an instance: the same for all grid points."""
    low = arrays.corner_low[action, slot]
    offset = arrays.corner_offset[action, slot]
    weight = arrays.corner_weight[action, slot]
    offset[0] = 0
    weight[0] = 1.0
    n_corners = 1
    for k in range(len(effect)):
        moved = effect[k] * grid.cells[k]
        low[k] = int(np.floor(moved))
        fraction = moved - low[k]
        for c in range(n_corners):
            offset[c] += low[k] * grid.strides[k]
            offset[n_corners + c] = offset[c] + grid.strides[k]
            weight[n_corners + c] = weight[c] * fraction
            weight[c] *= 1.0 - fraction
        n_corners *= 2


@part
def add_instance(p, arrays, instance, effect, point, scratch, grid, n_touched):
    """Add the successors of an instance (action, number) at the grid point at ``scratch.at``, as ``add_successor``."""
    action, i = instance
    for k in range(len(grid.shape)):
        low = scratch.at[k] + arrays.corner_low[action, i, k]
        if low < 0 or low + 1 >= grid.shape[k]:
            return add_successor(p, effect, scratch, grid, n_touched)
    for c in range(arrays.corner_offset.shape[2]):
        weight = arrays.corner_weight[action, i, c]
        if weight > 0.0:
            to = point + arrays.corner_offset[action, i, c]
            if scratch.dense[to] == 0.0:
                scratch.touched[n_touched] = to
                n_touched += 1
            scratch.dense[to] += p * weight
    return n_touched


@part
def add_own(arrays, instances, pair, total, grid, scratch):
    """Add what a pair's own instances predict, all weighing ``total``; the expected reward, and see ``add_successor``."""
    n_points = grid.shape[0] * grid.strides[0]
    action = pair // n_points
    point = pair - action * n_points
    start = arrays.lists.start[pair]
    reward = 0.0
    n_touched = np.int64(0)
    for k in range(start, start + arrays.lists.length[pair]):
        i = arrays.lists.item[k]
        p = arrays.lists.weight[k] / total
        reward += p * instances.reward[action, i]
        if not instances.terminated[action, i]:
            effect = instances.effect[action, i]
            n_touched = add_instance(p, arrays, (action, i), effect, point, scratch, grid, n_touched)
    return reward, n_touched


@compiled
def update_rows(arrays, instances, mdp, grid, gamma, pairs, transferred, scratch):
    """Bring the rows of pairs up to date with their lists and with transferred instances; how many are done.

    :param pairs: (pairs, how many of them are done); plain tuples for the rest
    :param transferred: a row for each of them, which counts only while the pair is not known
    """
    arrays, instances, mdp, grid = as_lists(arrays), Instances(*instances), as_mdp(mdp), GridArrays(*grid)
    transferred, scratch = TransferredInstances(*transferred), RowScratch(*scratch)
    pairs, done = pairs
    n_points = len(mdp.n_optimistic)
    while done < len(pairs):
        pair = pairs[done]
        joined = not arrays.known[pair] and transferred.length[done] > 0
        modelled = arrays.known[pair] or joined
        if modelled:
            point = pair % n_points
            coordinates_of(point, grid, scratch.at)
            total = arrays.total[pair] if arrays.lists.length[pair] > 0 else 0.0
            if joined:
                total = total_weight(total, transferred, done)
            reward, n_touched = add_own(arrays, instances, pair, total, grid, scratch)
            if joined:
                reward, n_touched = add_to_row(reward, n_touched, transferred, done, total, scratch, grid)
            if not finish_row(mdp, gamma, pair, point, reward, n_touched, scratch):
                return done
        arrays.last_total[pair] = arrays.total[pair]
        set_modelled(mdp, pair, modelled)
        done += 1
    return done
