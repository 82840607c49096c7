"""Compiled inner loops shared by model and transfer: arrays in, arrays out, all in unit coordinates."""

import numpy as np

from sb3_combrel.common.compiled import inlined, inner
from sb3_combrel.common.instances import BLOCK
from sb3_combrel.common.periodic import difference


@inlined
def insert_by_weight(indices, weights, start, length, total, index, weight, min_fraction):
    """Put an instance into a list sorted by falling weight, then cut the list where ``min_fraction`` ends it.

    An instance is kept while its weight is at least ``min_fraction`` of the sum of the weights before it. That sum
    only grows, so an instance cut once would be cut for ever: the list needs no memory of what it dropped. Of equal
    weights that of the instance in the lower slot comes first.

    :param total: sum of the weights so far
    :return: new length, sum of the kept weights
    """
    k = start + length
    while k > start and (weights[k - 1] < weight or (weights[k - 1] == weight and indices[k - 1] > index)):
        weights[k] = weights[k - 1]
        indices[k] = indices[k - 1]
        k -= 1
    weights[k] = weight
    indices[k] = index
    last = weights[start + length]
    if length == 0 or last > min_fraction * (total + weight - last) * (1 + 1e-12):
        return length + 1, total + weight
    return cut_by_fraction(weights, start, length + 1, min_fraction)


@inlined
def cut_by_fraction(weights, start, length, min_fraction):
    """How many of the sorted weights ``min_fraction`` keeps, and their sum."""
    total = 0.0
    kept = 0
    while kept < length:
        w = weights[start + kept]
        if kept > 0 and w < min_fraction * total:
            break
        total += w
        kept += 1
    return kept, total


@inlined
def any_periodic(periodic):
    """Whether a variable is periodic, for :func:`squared_distance`: asked once for many distances."""
    found = False
    for k in range(len(periodic)):
        found = found or periodic[k]
    return found


@inlined
def squared_distance(state, other, periodic, wraps):
    """Of two states; ``wraps``: whether any variable is periodic."""
    distance = 0.0
    for k in range(len(state)):
        along = state[k] - other[k]
        if wraps:
            along = difference(along, 0.0, periodic[k])
        distance += along * along
    return distance


@inlined
def measure_gaps(state, low, high, periodic, n_blocks, gap):
    """Squared distances from a state to boxes, variable by variable: many boxes at once in vector registers."""
    gap[:n_blocks] = 0.0
    for k in range(len(state)):
        at = state[k]
        low_k = low[k]
        high_k = high[k]
        if periodic[k]:
            measure_gaps_around(at - np.floor(at), low_k, high_k, n_blocks, gap)
            continue
        for block in range(n_blocks):
            below = low_k[block] - at
            above = at - high_k[block]
            outside = below if below > above else above
            outside = outside if outside > 0.0 else 0.0
            gap[block] += outside * outside


@inner
def measure_gaps_around(at, low, high, n_blocks, gap):
    """Add the squared distances along one periodic variable: a box is as far as its nearer end, on either way around."""
    for block in range(n_blocks):
        below = low[block] - at
        above = at - high[block]
        outside = below if below > above else above
        around = 1.0 + (above if below > above else below)
        outside = outside if outside < around else around
        outside = outside if outside > 0.0 else 0.0
        gap[block] += outside * outside


@inlined
def measure_blocks(instances, action, at):
    """Measure how far the blocks of an action's instances are; how many blocks there are."""
    n_blocks = (instances.size[action] + BLOCK - 1) // BLOCK
    measure_gaps(at, instances.block_low[action], instances.block_high[action], instances.periodic, n_blocks, instances.gap)
    return n_blocks


@inlined
def near_instances(instances, action, state, kernel, indices, weights):
    """The instances of ``action`` that the kernel keeps at ``state``, nearest first; how many, and the sum of their weights.

    :param kernel: (breadth, min_weight, min_fraction)
    :param indices: int32, receives them, at least ``list_room(min_fraction)`` long; ``weights``: exp(-d^2 / breadth^2)
    """
    breadth, min_weight, min_fraction = kernel
    scale = -1.0 / (breadth * breadth)
    farthest = np.log(min_weight) / scale
    start = np.int64(0)
    length = np.int64(0)
    total = 0.0
    count = instances.size[action]
    wraps = any_periodic(instances.periodic)
    for block in range(measure_blocks(instances, action, state)):
        if instances.gap[block] > farthest:
            continue
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            distance = squared_distance(state, instances.state[action, i], instances.periodic, wraps)
            if distance > farthest:
                continue
            w = np.exp(distance * scale)
            if w < min_weight:
                continue
            length, total = insert_by_weight(indices, weights, start, length, total, i, w, min_fraction)
            farthest = farthest_to_enter(weights[length - 1], total, min_weight, min_fraction, scale)
    total = 0.0
    for k in range(length):
        total += weights[k]
    return length, total


@inlined
def farthest_to_enter(last, total, min_weight, min_fraction, scale):
    """The squared distance beyond which no instance enters a list, ``last`` being its least weight."""
    return np.log(max(min_weight, min(last, min_fraction * total))) / scale * (1 + 1e-12)


def list_room(min_fraction: float) -> int:
    """Entries that a list needs while one is inserted: 1 + 1/min_fraction equal ones are kept, and one is cut."""
    return int(np.floor(1.0 / min_fraction)) + 3


@inlined
def insert_by_distance(items, distances, length, item, distance):
    """Put an instance into a full or growing list sorted by distance; its length. Of equal ones the lower number is first."""
    room = len(items)
    if length == room:
        last = distances[room - 1]
        if distance > last or (distance == last and item > items[room - 1]):
            return length
        length -= 1
    k = length
    while k > 0 and (distances[k - 1] > distance or (distances[k - 1] == distance and items[k - 1] > item)):
        distances[k] = distances[k - 1]
        items[k] = items[k - 1]
        k -= 1
    items[k] = item
    distances[k] = distance
    return length + 1


@inner
def nearest_instances(instances, action, state, farthest, items, distances):
    """The nearest instances of ``action``, nearest first, as many as ``items`` has room for; how many.

    :param farthest: squared distance beyond which none counts
    :param items: int32, receives them; ``distances``: their squared distances
    """
    count = instances.size[action]
    room = len(items)
    wraps = any_periodic(instances.periodic)
    length = np.int64(0)
    for block in range(measure_blocks(instances, action, state)):
        if instances.gap[block] > farthest * (1 + 1e-12):
            continue
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            distance = squared_distance(state, instances.state[action, i], instances.periodic, wraps)
            if distance > farthest:
                continue
            length = insert_by_distance(items, distances, length, i, distance)
            if length == room:
                farthest = distances[room - 1]
    return length
