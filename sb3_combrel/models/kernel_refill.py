"""The lists of a kernel model from its instances alone, pair by pair: the result of entering them one by one, in less time."""

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled
from sb3_combrel.common.instances import Instances, along_curve
from sb3_combrel.common.kernels import difference, insert_by_weight, near_instances
from sb3_combrel.common.list_store import reserve
from sb3_combrel.models.kernel_lists import note_corners

# The search measures distances in another way than the lists: what lies on the very edge must not get lost between them.
SLACK = 1 - 1e-9


@compiled
def refill_lists(arrays, instances, slots, grid, kernel, threshold, scratch, pair):
    """Fill the lists of all pairs, from ``pair`` on, which are empty at first (and nothing known); all but ``entry``.

    :param instances: the model's, but in an order in which neighbours lie close together
    :param slots: int64, shape (n_actions, max instances of an action): the slot of each in the model
    :param kernel: (breadth, min_weight, min_fraction)
    :param scratch: unit coordinates, float64, shape (n_variables,); items, int32, and weights, float64, shape (list room,)
    :return: number of pairs; or the pair at which another call goes on when the lists have grown
    """
    breadth, min_weight, min_fraction = kernel
    at, item, weight = scratch
    wider = (breadth, min_weight * SLACK, min_fraction * SLACK)
    lists = arrays.lists
    n_points = grid.shape[0] * grid.strides[0]
    found = np.int64(0)
    while pair < len(arrays.total):
        action = pair // n_points
        unit_coordinates_of(pair - action * n_points, grid, at)
        # Neighbouring points have most of their instances in common: the last ones found are looked at first.
        found, _ = near_instances(instances, action, at, wider, item, weight, found)
        if found > 0 and not reserve(lists, pair, found + 1):
            return pair
        length = np.int64(0)
        total = 0.0
        for f in range(found):
            w = kernel_weight(instances.state[action, item[f]], at, instances.periodic, breadth)
            if w >= min_weight:
                slot = slots[action, item[f]]
                start = lists.start[pair]
                length, total = insert_by_weight(lists.item, lists.weight, start, length, total, slot, w, min_fraction)
        if length > 0:
            for k in range(lists.start[pair], lists.start[pair] + length):
                arrays.n_lists[action, lists.item[k]] += 1
            arrays.known[pair] = total >= threshold
        lists.length[pair] = length
        arrays.total[pair] = total
        pair += 1
    return pair


def in_neighbourhoods(instances: Instances, listed: np.ndarray) -> tuple[Instances, np.ndarray]:
    """Those instances that stand in any list, in an order in which a search passes over most blocks.

    :param listed: whether each instance does, bool, those of one action after those of another
    :return: they, and the place that each had, int64, shape (n_actions, most instances of an action)
    """
    slots = np.zeros((len(instances.size), max(1, int(instances.size.max()))), dtype=np.int64)
    rows = []
    for action, of_action in enumerate(np.split(listed, np.cumsum(instances.size)[:-1])):
        there = np.flatnonzero(of_action)
        n = len(there)
        slots[action, :n] = order = there[np.argsort(along_curve(instances.state[action, there]), kind="stable")]
        kept = (instances.state, instances.effect, instances.reward, instances.terminated)
        rows.append((np.full(n, action), *(column[action, order] for column in kept)))
    actions, states, effects, rewards, ends = map(np.concatenate, zip(*rows, strict=True))
    return Instances.of_rows(len(instances.size), actions, states, effects, rewards, ends, instances.periodic), slots


@compiled
def unit_coordinates_of(point, grid, at):
    """Write the unit coordinates of a grid point to ``at``."""
    for k in range(len(at)):
        along = point // grid.strides[k]
        point -= along * grid.strides[k]
        at[k] = (along - grid.margin[k]) / grid.cells[k]


@compiled
def kernel_weight(state, at, periodic, breadth):
    """The weight of an instance at a grid point, to the last bit what ``points_in_reach`` says."""
    weight = 1.0
    for k in range(len(at)):
        apart = difference(at[k], state[k], periodic[k]) / breadth
        weight *= np.exp(-apart * apart)
    return weight


@compiled
def note_effects(instances, arrays, grid):
    """Compute what the arrays hold of the effect of each instance."""
    for action in range(len(instances.size)):
        for slot in range(instances.size[action]):
            note_corners(arrays, instances.effect[action, slot], grid, action, slot)


refill_all_lists, note_all_effects = EntryPoint(refill_lists), EntryPoint(note_effects)
