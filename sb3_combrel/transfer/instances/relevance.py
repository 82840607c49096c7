"""Relevance: which source instances are to be transferred first (Eqs. 4 and 7, and one of this package)."""

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point
from sb3_combrel.common.periodic import difference
from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions


def renew_relevance(
    candidates: Candidates,
    transitions: RecordedTransitions,
    n_used: int,
    bandwidths: CandidateBandwidths,
    values: np.ndarray,
    mu: float | None,
) -> None:
    """Compute the relevance of all source instances, through every candidate, to recorded target transitions.

    :param n_used: so many of the transitions count, the first ones
    :param values: receives the relevances, shape (n_candidates, most instances of an action)
    :param mu: fraction of the weight of Eq. 4; None: the relevance that does not favour distant instances
    """
    weight, evidence = np.empty(n_used), np.empty(values.shape[1])
    periodic = np.array(candidates.task.periodic)
    rows = [np.flatnonzero(transitions.actions[:n_used] == a) for a in range(candidates.task.n_actions)]
    of_actions = [(transitions.states[some], transitions.effects[some], transitions.rewards[some]) for some in rows]
    for c, origin in enumerate(candidates.origins):
        row = candidates.arrays.row[c]
        mapping = candidates.table.variable[row], candidates.table.sign[row], periodic
        of_row = bandwidths.of_all._replace(start=float(bandwidths.starts[row]))
        given = of_actions[origin.target_action], candidates.instances, candidates.arrays.action[c], mapping, of_row
        if mu is None:
            near_relevance.call(*given, weight, evidence, values[c])
        else:
            relevance.call(*given, mu, weight, values[c])


@entry_point
def relevance(target, source, action, mapping, bandwidths, mu, weight, values):
    """Compute ``equations.source_relevances``, through one state mapping.

    :param target: (states, effects, rewards) of the n transitions with one target action
    :param mapping: (source variable of each target variable, -1 for none; sign; whether the target variable is periodic)
    :param weight: float64 scratch, at least shape (n,)
    :param values: receives the relevances, at least as many as ``source.size[action]``
    """
    n = len(target[2])
    for j in range(source.size[action]):
        total, compliance = _compliance(j, target, source, action, mapping, bandwidths, weight)
        if total < 1e-300:
            values[j] = 1.0
            continue
        distance = _mean_distance(weight[:n], total, mu, bandwidths.start)
        off = compliance - 1.0
        values[j] = 1.0 if off == 0.0 else (0.0 if distance == 0.0 else np.exp(-(off / distance) * (off / distance)))


@entry_point
def near_relevance(target, source, action, mapping, bandwidths, weight, evidence, values):
    """Compute ``equations.near_relevances``, as :func:`relevance`; ``evidence``: float64 scratch, shaped as ``values``."""
    n = source.size[action]
    total = 0.0
    complied = 0.0
    for j in range(n):
        evidence[j], values[j] = _compliance(j, target, source, action, mapping, bandwidths, weight)
        total += evidence[j]
        complied += evidence[j] * values[j]
    mean = complied / total if total > 0.0 else 1.0
    for j in range(n):
        values[j] = (evidence[j] * values[j] + mean) / (evidence[j] + 1.0)


@compiled
def _compliance(j, target, source, action, mapping, bandwidths, weight):
    """Return the evidence on instance ``j``, the sum of all transitions' weights, and its compliance; fill ``weight``."""
    states, effects, rewards = target
    index, sign, periodic = mapping
    n, d = states.shape
    total = 0.0
    transition = 0.0
    rewarded = 0.0
    for i in range(n):
        apart = 0.0
        missed = 0.0
        for v in range(d):
            moved = 0.0
            if index[v] >= 0:
                here = source.state[action, j, index[v]]
                moved = sign[v] * source.effect[action, j, index[v]]
                along = difference(states[i, v], 1.0 - here if sign[v] < 0.0 else here, periodic[v])
                apart += along * along
            missed += difference(effects[i, v], moved, periodic[v]) ** 2
        w = np.exp(-apart / bandwidths.start)
        weight[i] = w
        total += w
        transition += w * np.exp(-missed / bandwidths.outcome)
        off = rewards[i] - source.reward[action, j]
        rewarded += w * np.exp(-off * off / bandwidths.reward)
    if total < 1e-300:
        return 0.0, 0.0
    return total, (transition / total) * (rewarded / total)


@compiled
def _mean_distance(weight, total, mu, bandwidth):
    """Return d_j of Eq. 4: mean distance of the heaviest transitions whose sum stays below ``mu`` of the weight, at least one.

    The weights are used up; distances are read back from them. A sum that reaches ``mu`` but for rounding does not stay below.
    """
    limit = mu * total * (1.0 - 1e-12)
    n = len(weight)
    # A heap, whose top is the heaviest: only those that are taken are put in order, not thousands that weigh next to nothing.
    for root in range(n // 2 - 1, -1, -1):
        _sift_down(weight, root, n)
    gathered = 0.0
    distance = 0.0
    n_taken = 0
    while n_taken < n:
        heaviest = weight[0]
        if heaviest <= 0.0 or (n_taken > 0 and gathered + heaviest >= limit):
            break
        gathered += heaviest
        distance += np.sqrt(-bandwidth * np.log(heaviest))
        n_taken += 1
        weight[0] = weight[n - n_taken]
        _sift_down(weight, np.int64(0), n - n_taken)
    return distance / max(n_taken, 1)


@compiled
def _sift_down(heap, root, size):
    """Move the entry at ``root`` down until neither entry below it is larger, in a heap of the first ``size`` entries."""
    entry = heap[root]
    below = 2 * root + 1
    while below < size:
        if below + 1 < size and heap[below + 1] > heap[below]:
            below += 1
        if heap[below] <= entry:
            break
        heap[root] = heap[below]
        root = below
        below = 2 * root + 1
    heap[root] = entry
