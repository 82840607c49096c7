"""Compiled loops that pick source instances for target pairs and translate them."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import compiled, inner, part
from sb3_combrel.common.instances import BLOCK


class CandidateArrays(ArrayStruct):
    """The ways to see the source from each target action: candidates ``first[a]`` to ``first[a + 1]`` are of action a.

    :param first: int64, shape (n_target_actions + 1,)
    :param row: int64, shape (n_candidates,): state mapping, a row of the mapping table
    :param action: int64, shape (n_candidates,): source action
    """

    first: np.ndarray
    row: np.ndarray
    action: np.ndarray


class TransferRules(NamedTuple):
    """When and how instances are transferred.

    :param threshold: weight that settles a pair
    :param breadth: kernel breadth of transferred instances, unit coordinates
    :param min_weight: lighter instances do not count
    :param min_fraction: nearest first, an instance counts while it has this part of the weight before it
    :param believe_terminal: whether an instance that ended a source episode ends the target's
    :param by_merit: whether the instances come in the order of their merit (relevance), not of their distance
    """

    threshold: float
    breadth: float
    min_weight: float
    min_fraction: float
    believe_terminal: bool
    by_merit: bool


@part
def consider(j, candidate, w, merit, own, kept, rules, best):
    """Enter an instance into the list of the best, heaviest (or worthiest) first, and cut what is not needed any more.

    An instance is needed while those before it and ``own`` do not reach the threshold, and while it has at least
    ``min_fraction`` of their weight. These sums only grow, so what is cut once would be cut for ever.

    :param kept: how many are in the list
    :return: how many are now, and the least weight with which a further instance could enter (by weight)
    """
    most = len(best.weight) - 1
    k = kept
    while k > 0 and best.merit[k - 1] < merit:
        best.index[k] = best.index[k - 1]
        best.weight[k] = best.weight[k - 1]
        best.merit[k] = best.merit[k - 1]
        best.candidate[k] = best.candidate[k - 1]
        k -= 1
    best.index[k] = j
    best.weight[k] = w
    best.merit[k] = merit
    best.candidate[k] = candidate
    total = own
    for k in range(min(kept + 1, most)):
        if not rules.by_merit and best.weight[k] < rules.min_fraction * total:
            # Heavier than the last of the list, one need not have that part of the last's weight as well.
            return k, min(rules.min_fraction * total, best.weight[k - 1]) if k > 0 else rules.min_fraction * total
        total += best.weight[k]
        if total >= rules.threshold:
            return k + 1, best.weight[k]
    return min(kept + 1, most), best.weight[most - 1] if kept + 1 >= most else 0.0


@inner
def gather(state, source, row, action, mappings, rules, merit, own, kept, best, candidate):
    """Enter the translated instances of one candidate that weigh at least ``min_weight`` at ``state`` into ``best``.

    :param merit: relevance of the candidate's instances; read only if ``rules.by_merit``
    :param best: BestInstances, of which ``kept`` are filled
    :return: how many are now
    """
    scale = -1.0 / (rules.breadth * rules.breadth)
    far = np.log(rules.min_weight) / scale
    n_mapped = 0
    for v in range(len(state)):
        k = mappings.index[row, v]
        if k >= 0:
            mirrored = mappings.sign[row, v] < 0.0
            best.variable[n_mapped] = k
            best.at[n_mapped] = 1.0 - state[v] if mirrored else state[v]
            n_mapped += 1
    nearest_block = measure_blocks(source, action, n_mapped, best)
    nearest = far
    # What is in the nearest block keeps most other blocks out.
    for turn in range(-1, (source.count[action] + BLOCK - 1) // BLOCK):
        block = nearest_block if turn < 0 else turn
        if turn == nearest_block or source.gap[block] > nearest:
            continue
        for j in range(block * BLOCK, min(source.count[action], (block + 1) * BLOCK)):
            apart = 0.0
            for m in range(n_mapped):
                along = best.at[m] - source.state[action, j, best.variable[m]]
                apart += along * along
            if apart <= nearest:
                w = np.exp(apart * scale)
                kept, least = consider(j, candidate, w, merit[j] if rules.by_merit else w, own, kept, rules, best)
                if least > rules.min_weight and not rules.by_merit:
                    nearest = np.log(least) / scale * (1 + 1e-12)
    return kept


@part
def measure_blocks(source, action, n_mapped, best):
    """Write to ``source.gap`` the squared distance of each block's box, in the mapped variables; the nearest block."""
    nearest_block = 0
    for block in range((source.count[action] + BLOCK - 1) // BLOCK):
        gap = 0.0
        for m in range(n_mapped):
            k = best.variable[m]
            below = source.block_low[action, k, block] - best.at[m]
            above = best.at[m] - source.block_high[action, k, block]
            outside = below if below > above else above
            if outside > 0.0:
                gap += outside * outside
        source.gap[block] = gap
        if gap < source.gap[nearest_block]:
            nearest_block = block
    return nearest_block


@part
def write_row(s, own, kept, source, ways, mappings, rules, best, supply):
    """Write the best instances to row ``s`` of ``supply``, if they and ``own`` reach the threshold."""
    total = own
    for n in range(kept):
        total += best.weight[n]
    supply.count[s] = 0
    if total < rules.threshold:
        return
    supply.count[s] = kept
    for n in range(kept):
        row = ways.row[best.candidate[n]]
        action = ways.action[best.candidate[n]]
        j = best.index[n]
        supply.weight[s, n] = best.weight[n]
        supply.reward[s, n] = source.reward[action, j]
        supply.terminated[s, n] = rules.believe_terminal and source.terminated[action, j]
        for v in range(mappings.index.shape[1]):
            k = mappings.index[row, v]
            supply.effect[s, n, v] = mappings.sign[row, v] * source.effect[action, j, k] if k >= 0 else 0.0


@compiled
def translate(states, own, first, last, source, ways, mappings, rules, merit, best, supply):
    """Supply instances to a number of pairs (see ``Transfer.supply``).

    :param states: unit coordinates, shape (n, n_variables)
    :param own: weight of each pair's own instances, shape (n,)
    :param first: first candidate that each pair may draw from; ``last``: one past the last (none if equal)
    :param merit: relevance, shape (n_candidates, most instances of an action); or (1, 0) if not used
    :param best: BestInstances
    """
    for s in range(len(own)):
        supply.count[s] = 0
        if own[s] >= rules.threshold:
            continue
        kept = np.int64(0)
        for c in range(first[s], last[s]):
            kept = gather(
                states[s],
                source,
                ways.row[c],
                ways.action[c],
                mappings,
                rules,
                merit[c] if rules.by_merit else merit[0],
                own[s],
                kept,
                best,
                c,
            )
        write_row(s, own[s], kept, source, ways, mappings, rules, best, supply)


class BestInstances(ArrayStruct):
    """Work space for the instances needed at one state, best first, with room for one more than are ever needed.

    :param index: int64, shape (room,); ``weight``, ``merit``: float64; ``candidate``: int64
    :param variable: int64, shape (n_variables,): source variables that a candidate compares with; ``at``: float64, same
        shape: where the state lies along each
    """

    index: np.ndarray
    weight: np.ndarray
    merit: np.ndarray
    candidate: np.ndarray
    variable: np.ndarray
    at: np.ndarray

    @classmethod
    def empty(cls, most: int, n_variables: int) -> "BestInstances":
        """Work space for ``most`` instances."""
        room = most + 1
        return cls(
            index=np.empty(room, dtype=np.int64),
            weight=np.empty(room),
            merit=np.empty(room),
            candidate=np.empty(room, dtype=np.int64),
            variable=np.empty(n_variables, dtype=np.int64),
            at=np.empty(n_variables),
        )
