"""Whether an episode ends, and what that pays, is a function of where one arrives: all arrivals of all actions decide it.

Of the arrivals near a state the nearest decide, with weights exp(-(q - q_min) / b^2): q are squared distances, and the
breadth b is no more than ``outcome_breadth`` and no more than the nearest arrival is far, so one that was made before decides
for itself. Beyond an edge at which episodes end the nearest arrivals are ends, so states there count as ended.

Where effects have noise, the mean effect alone does not say where one arrives. If the noise around a state is larger, in its
mean square, than the nearest arrival is far, the mean over where the noise of each instance would lead counts.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.instances import BLOCK, Instances, put_instance
from sb3_combrel.common.kernels import any_periodic, measure_block, measure_blocks, squared_distance

# Arrivals beyond this many squared breadths weigh less than 0.0002 of the nearest.
NEGLIGIBLE = 9.0
ROUNDING = 1e-7


class Ends(NamedTuple):
    """The arrivals that ended an episode; none where episodes end by what is done."""

    state: np.ndarray  # float64, (n_ends, n_variables)
    hint: np.ndarray  # int64 scratch, (2,): action and slot of an arrival near the last state that was asked for


@inlined
def put_arrival(instances, arrivals, action, slot):
    """Write where an instance leads to the same slot of the arrivals."""
    for k in range(len(instances.periodic)):
        at = instances.state[action, slot, k] + instances.effect[action, slot, k]
        if instances.periodic[k]:
            at -= np.floor(at)
        arrivals.state[action, slot, k] = at
        block = slot // BLOCK
        arrivals.block_low[action, k, block] = min(arrivals.block_low[action, k, block], at)
        arrivals.block_high[action, k, block] = max(arrivals.block_high[action, k, block], at)


@entry_point
def put_arrivals(instances, arrivals):
    """Write where all instances lead."""
    for action in range(len(instances.size)):
        for slot in range(instances.size[action]):
            put_arrival(instances, arrivals, action, slot)


@entry_point
def put_transition(instances, arrivals, transition, effect, measured):
    """Write an instance to its slot, and where it leads; plain tuples.

    :param transition: (action, slot, state, next_state, reward, terminated)
    :param effect: counts in place of next state minus state, if it is not empty
    :param measured: (sums of the sizes of effect, reward and perhaps end by action; the least mean sizes; both of these are
        written: what is fitted of this instance, the mean sizes of its action), see ``GridModel``
    """
    instances, arrivals = Instances(*instances), Instances(*arrivals)
    action, slot, _, _, _, _ = transition
    sums, least, numbers, size = measured
    put_instance(instances, transition)
    for k in range(len(effect)):
        instances.effect[action, slot, k] = effect[k]
    put_arrival(instances, arrivals, action, slot)
    d = len(instances.periodic)
    for k in range(d):
        numbers[k] = instances.effect[action, slot, k]
    numbers[d] = instances.reward[action, slot]
    if len(numbers) > d + 1:
        numbers[d + 1] = instances.terminated[action, slot]
    for v in range(len(numbers)):
        sums[action, v] += abs(numbers[v])
        size[v] = max(sums[action, v] / instances.size[action], least[v])


@compiled
def squared_distance_of_end(state, ends, periodic):
    """The squared distance of the nearest arrival that ended an episode; infinite without any."""
    nearest = np.inf
    wraps = any_periodic(periodic)
    for e in range(len(ends.state)):
        nearest = min(nearest, squared_distance(state, ends.state[e], periodic, wraps))
    return nearest


@inlined
def reach_of(nearest, outcome_breadth):
    """How far arrivals decide, if the nearest is so far; all squared."""
    return nearest + NEGLIGIBLE * min(outcome_breadth, nearest + ROUNDING)


@inlined
def none_decides(of_end, nearest, noise, outcome_breadth):
    """Whether all ends are too far to decide what arriving means, even ``noise`` away from there.

    :param of_end: how far the nearest end is, no less; ``nearest``: some arrival, no more
    """
    apart, arrived = max(of_end - noise, 0.0), nearest + noise
    return apart * apart > reach_of(arrived * arrived, outcome_breadth)


@compiled
def distance_of_nearest(state, nearest, of_end, noise, outcome_breadth, arrivals, hint):
    """The squared distance of the nearest arrival, or of one that is so near that no end decides.

    :param nearest: that of some arrival; ``of_end``: that of the nearest end
    :param noise: how far from ``state`` one may arrive
    """
    wraps = any_periodic(arrivals.periodic)
    if hint[1] < arrivals.size[hint[0]]:
        nearest = min(nearest, squared_distance(state, arrivals.state[hint[0], hint[1]], arrivals.periodic, wraps))
    for action in range(len(arrivals.size)):
        if none_decides(np.sqrt(of_end), np.sqrt(nearest), noise, outcome_breadth):
            break
        for block in range(measure_blocks(arrivals, action, state)):
            if arrivals.gap[block] < nearest:
                measure_block(arrivals, action, block, state)
                for j in range(min(arrivals.size[action] - block * BLOCK, BLOCK)):
                    if arrivals.apart[j] < nearest:
                        nearest, hint[0], hint[1] = arrivals.apart[j], action, block * BLOCK + j
    return nearest


@compiled
def end_at(state, near, outcome_breadth, arrivals, ends, found):
    """Write to ``found`` the probability that arriving at ``state`` ends the episode, and what an end there pays.

    :param near: squared distance of some arrival, which saves the search far from all ends
    :param outcome_breadth: squared
    """
    found[0], found[1] = 0.0, 0.0
    of_end = squared_distance_of_end(state, ends, arrivals.periodic)
    if of_end <= reach_of(near, outcome_breadth):
        nearest = distance_of_nearest(state, min(near, of_end), of_end, 0.0, outcome_breadth, arrivals, ends.hint)
        weigh_ends(state, of_end, nearest, outcome_breadth, arrivals, found)


@compiled
def weigh_ends(state, of_end, nearest, outcome_breadth, arrivals, found):
    """:func:`end_at` where the squared distances of the nearest end and of the nearest arrival are known; ``found`` is 0."""
    reach = reach_of(nearest, outcome_breadth)
    if of_end > reach:
        return
    breadth = min(outcome_breadth, nearest + ROUNDING)
    total, ended, reward = 0.0, 0.0, 0.0
    for action in range(len(arrivals.size)):
        for block in range(measure_blocks(arrivals, action, state)):
            if arrivals.gap[block] <= reach:
                measure_block(arrivals, action, block, state)
                for j in range(min(arrivals.size[action] - block * BLOCK, BLOCK)):
                    i, distance = block * BLOCK + j, arrivals.apart[j]
                    if distance <= reach:
                        weight = np.exp((nearest - distance) / breadth)
                        total += weight
                        if arrivals.terminated[action, i]:
                            ended += weight
                            reward += weight * arrivals.reward[action, i]
    if ended > 0.0:
        found[0], found[1] = ended / total, reward / ended
