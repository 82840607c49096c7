"""Compiled inner loops shared by model and transfer: arrays in, arrays out, all in unit coordinates."""

import numpy as np
from sb3_combrel.common.compiled import compiled

from sb3_combrel.common.instances import BLOCK


@compiled
def insert_by_weight(indices, weights, start, length, index, weight, min_fraction):
    """Put an instance into a list sorted by falling weight, then cut the list where ``min_fraction`` ends it.

    An instance is kept while its weight is at least ``min_fraction`` of the sum of the weights before it. That sum
    only grows, so an instance cut once would be cut for ever: the list needs no memory of what it dropped.

    :return: new length, sum of the kept weights
    """
    k = start + length
    while k > start and weights[k - 1] < weight:
        weights[k] = weights[k - 1]
        indices[k] = indices[k - 1]
        k -= 1
    weights[k] = weight
    indices[k] = index
    return cut_by_fraction(weights, start, length + 1, min_fraction)


@compiled
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


@compiled
def near_instances(instances, action, state, breadth, min_weight, min_fraction, indices, weights):
    """The instances of ``action`` that the kernel keeps at ``state``, nearest first.

    :param indices: int32 scratch that receives them, at least ``list_room(min_fraction)`` long
    :param weights: float64 scratch of the same length that receives their weights exp(-d^2 / breadth^2)
    :return: how many, sum of their weights
    """
    scale = -1.0 / (breadth * breadth)
    n_variables = len(state)
    farthest = np.log(min_weight) / scale
    start = np.int64(0)
    length = np.int64(0)
    total = 0.0
    count = instances.count[action]
    for block in range((count + BLOCK - 1) // BLOCK):
        gap = 0.0
        for k in range(n_variables):
            low = instances.block_low[action, block, k] - state[k]
            high = state[k] - instances.block_high[action, block, k]
            outside = max(low, high, 0.0)
            gap += outside * outside
        if gap > farthest:
            continue
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            distance = 0.0
            for k in range(n_variables):
                along = state[k] - instances.state[action, i, k]
                distance += along * along
            if distance > farthest:
                continue
            w = np.exp(distance * scale)
            if w < min_weight:
                continue
            length, total = insert_by_weight(indices, weights, start, length, i, w, min_fraction)
            least = min(weights[length - 1], min_fraction * total)
            if least > min_weight:
                farthest = np.log(least) / scale * (1 + 1e-12)
    return length, total


def list_room(min_fraction: float) -> int:
    """Entries that a list needs while one is inserted: 1 + 1/min_fraction equal ones are kept, and one is cut."""
    return int(np.floor(1.0 / min_fraction)) + 3


@compiled
def corners_of(position, shape, strides, corner_index, corner_weight):
    """Grid points around ``position`` and their multilinear weights.

    :param position: float64, shape (n_variables,): unit coordinates times cells per unit; clipped into the grid
    :param corner_index: int64 scratch, shape (2 ** n_variables,)
    :param corner_weight: float64 scratch of the same shape
    :return: how many corners have a weight above 0
    """
    corner_index[0] = 0
    corner_weight[0] = 1.0
    n_corners = 1
    for k in range(len(position)):
        last = shape[k] - 1
        at = min(max(position[k], 0.0), float(last))
        low = int(at)
        part = at - low
        for c in range(n_corners):
            corner_index[c] += low * strides[k]
        if part > 0.0:
            for c in range(n_corners):
                corner_index[n_corners + c] = corner_index[c] + strides[k]
                corner_weight[n_corners + c] = corner_weight[c] * part
                corner_weight[c] *= 1.0 - part
            n_corners *= 2
    return n_corners


@compiled
def interpolate(values, position, shape, strides, corner_index, corner_weight):
    """The value at ``position`` (see :func:`corners_of`), multilinear between the grid points."""
    value = 0.0
    for c in range(corners_of(position, shape, strides, corner_index, corner_weight)):
        value += corner_weight[c] * values[corner_index[c]]
    return value
