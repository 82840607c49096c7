"""Compiled loops that pick source instances for target pairs and translate them."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled


class CandidateArrays(NamedTuple):
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


@compiled
def gather(state, source, row, action, mappings, rules, merit, found, indices, weights, merits, candidates, candidate):
    """Collect the translated instances of one candidate that weigh at least ``min_weight`` at ``state``.

    :param merit: relevance of the candidate's instances; read only if ``rules.by_merit``
    :param found: how many were collected before
    :return: how many now
    """
    far = -np.log(rules.min_weight) * rules.breadth * rules.breadth
    for j in range(source.count[action]):
        apart = 0.0
        for v in range(len(state)):
            k = mappings.index[row, v]
            if k >= 0:
                here = source.state[action, j, k]
                along = state[v] - (1.0 - here if mappings.sign[row, v] < 0.0 else here)
                apart += along * along
        if apart <= far:
            w = np.exp(-apart / (rules.breadth * rules.breadth))
            indices[found] = j
            weights[found] = w
            merits[found] = merit[j] if rules.by_merit else w
            candidates[found] = candidate
            found += 1
    return found


@compiled
def fill_row(s, own, found, source, ways, mappings, rules, indices, weights, merits, candidates, supply):
    """Write the best of the gathered instances to row ``s`` of ``supply``, until they and ``own`` reach the threshold."""
    total = own
    n = 0
    most = supply.weight.shape[1]
    while total < rules.threshold and n < most and found > 0:
        best = 0
        for f in range(1, found):
            if merits[f] > merits[best]:
                best = f
        w = weights[best]
        if not rules.by_merit and w < rules.min_fraction * total:
            break
        row = ways.row[candidates[best]]
        action = ways.action[candidates[best]]
        j = indices[best]
        supply.weight[s, n] = w
        supply.reward[s, n] = source.reward[action, j]
        supply.terminated[s, n] = rules.believe_terminal and source.terminated[action, j]
        for v in range(mappings.index.shape[1]):
            k = mappings.index[row, v]
            supply.effect[s, n, v] = mappings.sign[row, v] * source.effect[action, j, k] if k >= 0 else 0.0
        total += w
        n += 1
        found -= 1
        indices[best] = indices[found]
        weights[best] = weights[found]
        merits[best] = merits[found]
        candidates[best] = candidates[found]
    supply.count[s] = n if total >= rules.threshold else 0


@compiled
def translate(states, own, first, last, source, ways, mappings, rules, merit, scratch, supply):
    """Supply instances to a number of pairs (see ``Transfer.supply``).

    :param states: unit coordinates, shape (n, n_variables)
    :param own: weight of each pair's own instances, shape (n,)
    :param first: first candidate that each pair may draw from; ``last``: one past the last (none if equal)
    :param merit: relevance, shape (n_candidates, most instances of an action); or (1, 0) if not used
    :param scratch: GatherScratch
    """
    for s in range(len(own)):
        supply.count[s] = 0
        if own[s] >= rules.threshold:
            continue
        found = np.int64(0)
        for c in range(first[s], last[s]):
            found = gather(
                states[s],
                source,
                ways.row[c],
                ways.action[c],
                mappings,
                rules,
                merit[c] if rules.by_merit else merit[0],
                found,
                scratch.index,
                scratch.weight,
                scratch.merit,
                scratch.candidate,
                c,
            )
        fill_row(
            s,
            own[s],
            found,
            source,
            ways,
            mappings,
            rules,
            scratch.index,
            scratch.weight,
            scratch.merit,
            scratch.candidate,
            supply,
        )


class GatherScratch(NamedTuple):
    """Work space for the instances gathered at one state.

    :param index: int64, shape (room,); ``weight``, ``merit``: float64; ``candidate``: int64
    """

    index: np.ndarray  # type: ignore[assignment]
    weight: np.ndarray
    merit: np.ndarray
    candidate: np.ndarray

    @classmethod
    def empty(cls, room: int) -> "GatherScratch":
        """Work space for ``room`` instances."""
        return cls(np.empty(room, dtype=np.int64), np.empty(room), np.empty(room), np.empty(room, dtype=np.int64))
