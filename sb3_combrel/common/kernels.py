"""Compiled inner loops shared by model and transfer: arrays in, arrays out, all in unit coordinates."""

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined
from sb3_combrel.common.instances import BLOCK
from sb3_combrel.common.periodic import difference


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


@compiled
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


@compiled
def measure_blocks(instances, action, state):
    """Squared distances from a state to the boxes of an action's blocks, into :attr:`Instances.gap`; how many there are.

    Variable by variable: many boxes at once in vector registers.
    """
    n_blocks = (instances.size[action] + BLOCK - 1) // BLOCK
    gap = instances.gap
    gap[:n_blocks] = 0.0
    for k in range(len(state)):
        at = state[k]
        low = instances.block_low[action, k]
        high = instances.block_high[action, k]
        if instances.periodic[k]:
            measure_gaps_around(at - np.floor(at), low, high, n_blocks, gap)
            continue
        for block in range(n_blocks):
            below = low[block] - at
            above = at - high[block]
            outside = below if below > above else above
            outside = outside if outside > 0.0 else 0.0
            gap[block] += outside * outside
    return n_blocks


def list_room(min_fraction: float) -> int:
    """The most instances that a list may have: 1 + 1/min_fraction equal ones are kept."""
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


@compiled
def measure_block(instances, action, block, state):
    """Measure the squared distances of the instances of a block, all at once: :attr:`Instances.apart`."""
    apart, first = instances.apart, block * BLOCK
    for j in range(BLOCK):
        apart[j] = 0.0
    for k in range(len(state)):
        at = state[k]
        if instances.periodic[k]:
            for j in range(BLOCK):
                along = difference(at, instances.state[action, first + j, k], True)
                apart[j] += along * along
        else:
            for j in range(BLOCK):
                along = at - instances.state[action, first + j, k]
                apart[j] += along * along


@inlined
def scan_block(instances, action, block, state, farthest, length, items, distances):
    """Put the instances of a block that are no farther than squared ``farthest`` into the list: its length, and farthest."""
    measure_block(instances, action, block, state)
    for j in range(min(instances.size[action] - block * BLOCK, BLOCK)):
        if instances.apart[j] > farthest:
            continue
        length = insert_by_distance(items, distances, length, block * BLOCK + j, instances.apart[j])
        if length == len(items):
            farthest = distances[length - 1]
    return length, farthest


@inlined
def take_nearest_block(gap, n_blocks):
    """The nearest block that has not been taken, -1 for none; its gap becomes NaN, which is near nothing."""
    nearest, least = np.int64(-1), np.inf
    for block in range(n_blocks):
        if gap[block] < least:
            nearest, least = np.int64(block), gap[block]
    if nearest >= 0:
        gap[nearest] = np.nan
    return nearest


@compiled
def nearest_instances(instances, action, state, farthest, items, distances):
    """The nearest instances of ``action``, nearest first, as many as ``items`` has room for; how many.

    :param farthest: squared distance beyond which none counts
    :param items: int32, receives them; ``distances``: their squared distances
    """
    length = np.int64(0)
    n_blocks = measure_blocks(instances, action, state)
    if farthest == np.inf:
        # The nearest blocks first: then most of the others are too far.
        for _ in range(0, len(items), BLOCK):
            block = take_nearest_block(instances.gap, n_blocks)
            if block >= 0:
                length, farthest = scan_block(instances, action, block, state, farthest, length, items, distances)
    for block in range(n_blocks):
        if instances.gap[block] <= farthest * (1 + 1e-12):
            length, farthest = scan_block(instances, action, block, state, farthest, length, items, distances)
    return length


@inlined
def near_instances(instances, action, state, farthest, kernel, indices, weights):
    """The instances of ``action`` that the kernel keeps at ``state``, nearest first; how many, and the sum of their weights.

    One is kept while its weight is at least ``min_fraction`` of the sum of those before it.

    :param farthest: squared distance beyond which none is kept, no more than that at which one weighs ``min_weight``
    :param kernel: (breadth, min_weight, min_fraction)
    :param indices: int32, receives them, ``list_room(min_fraction)`` long; ``weights``: exp(-d^2 / breadth^2)
    """
    breadth, _, min_fraction = kernel
    scale = -1.0 / (breadth * breadth)
    near = nearest_instances(instances, action, state, farthest, indices, weights)
    total = 0.0
    for k in range(near):
        weights[k] = np.exp(weights[k] * scale)
        if k > 0 and weights[k] < min_fraction * total:
            return k, total
        total += weights[k]
    return near, total
