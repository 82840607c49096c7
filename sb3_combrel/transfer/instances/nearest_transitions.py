"""Compiled loops of COMBREL's selection: the nearest target transitions choose a candidate by compliance (Algorithm 1)."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.kernels import any_periodic, insert_by_distance, squared_distance
from sb3_combrel.common.periodic import difference


class ComplianceCache(NamedTuple):
    """Compliance of target transitions, computed once; that of transition i is with the candidates of its action only."""

    compliance: np.ndarray  # float64, shape (n_transitions, most candidates of an action): with each, in their order
    required: np.ndarray  # float64, shape (n_transitions,): what the mean compliance of the nearest must exceed
    measured: np.ndarray  # bool, shape (n_transitions,): whether the compliance has been computed
    total: np.ndarray  # float64 scratch, shape (most candidates of an action,)

    @classmethod
    def empty(cls, max_candidates: int, capacity: int = 64) -> "ComplianceCache":
        return cls(
            compliance=np.empty((capacity, max_candidates)),
            required=np.empty(capacity),
            measured=np.zeros(capacity, dtype=np.bool_),
            total=np.empty(max_candidates),
        )

    def grown(self) -> "ComplianceCache":
        """Return a copy of twice the size."""
        return self._replace(
            **{name: np.concatenate([old, np.zeros_like(old)]) for name, old in self._asdict().items() if name != "total"}
        )


@entry_point
def add_to_sample(i, state, sample, near, distance, due, apart):
    """Add transition ``i`` to the nearest ones of every sample state that has it among them.

    :param sample: (its states, shape (n_variables, n_points): many at once in vector registers; periodic, (n_variables,))
    :param near: int64, shape (n_points, n_neighbors): nearest transitions, -1 for none; ``distance``: squared, the limit for
        none; ``due``: bool, shape (n_points,): becomes True where it was added
    :param apart: float64 scratch, shape (n_points,)
    """
    n_points = len(apart)
    last = near.shape[1] - 1
    apart[:] = 0.0
    sample_states, periodic = sample
    for v in range(len(state)):
        at = state[v]
        of_sample = sample_states[v]
        if periodic[v]:
            for p in range(n_points):
                along = difference(of_sample[p], at, True)
                apart[p] += along * along
        else:
            for p in range(n_points):
                along = of_sample[p] - at
                apart[p] += along * along
    for p in range(n_points):
        if apart[p] < distance[p, last]:
            insert_by_distance(near[p], distance[p], last + 1, i, apart[p])
            due[p] = True


@inlined
def find_nearest(query, recorded, limits, near, distance):
    """Find the nearest transitions of exact states and actions (line 17).

    :param query: (states, actions, own_weight), n of each: none are found where ``own_weight`` reaches the threshold
    :param recorded: (states of the transitions; those that count for each action, int64, shape (n_actions, capacity); how many
        these are, shape (n_actions,); periodic, bool, shape (n_variables,))
    :param limits: (threshold, squared distance from which on a transition does not count)
    :param near: receives the transitions, the nearest first, -1 for none, int64, shape (n, n_neighbors)
    """
    states, actions, own_weight = query
    at, listed, n_listed, periodic = recorded
    threshold, limit = limits
    last = near.shape[1] - 1
    # Asked once, not for every transition.
    wraps = any_periodic(periodic)
    for r in range(len(actions)):
        near[r] = -1
        distance[r] = limit
        if own_weight[r] >= threshold:
            continue
        action = actions[r]
        for n in range(n_listed[action]):
            i = listed[action, n]
            apart = squared_distance(at[i], states[r], periodic, wraps)
            if apart < distance[r, last]:
                insert_by_distance(near[r], distance[r], last + 1, i, apart)


@compiled
def choose_one(near, action, cache, first, draw):
    """Choose a candidate of ``action`` by the mean compliance of ``near``; -1 if none exceeds what is required (lines 19-20).

    :param draw: a random number from [0, 1): each candidate that exceeds what is required is chosen with a probability in
        proportion to its mean compliance; below 0: the one with the highest is (of equal ones the first)
    """
    bar, total = 0.0, cache.total
    n_candidates = first[action + 1] - first[action]
    total[:n_candidates] = 0.0
    for k in range(len(near)):
        i = near[k]
        if i >= 0:
            bar += cache.required[i]
            for c in range(n_candidates):
                total[c] += cache.compliance[i, c]
    best = -1
    highest = bar
    mass = 0.0
    for c in range(n_candidates):
        if total[c] > bar:
            mass += total[c]
        if total[c] > highest:
            highest = total[c]
            best = c
    if draw < 0.0 or best < 0:
        return first[action] + best if best >= 0 else best
    mass *= draw
    for c in range(n_candidates):
        if total[c] > bar:
            mass -= total[c]
            # Rounding may leave a little to the end.
            if mass < 0.0:
                return first[action] + c
    return first[action] + best


@compiled
def same_neighbors(near, others):
    """Return whether two states have the same nearest transitions, in the same order."""
    for k in range(len(near)):
        if near[k] != others[k]:
            return False
    return True


@entry_point
def choose(rows, actions, near, cache, first, draws, choice):
    """Renew the choices of some rows; those for which it changed are moved to the front of ``rows``.

    :param rows: int64, shape (n,): rows of ``near`` and ``choice``; ``actions``: same shape
    :param cache: ComplianceCache as a plain tuple, in which all neighbours are measured
    :param draws: a random number for each of ``rows``; or nothing, shape (0,): the best is chosen (see ``choose_one``)
    :param choice: int64: candidates, -1 for none, updated
    :return: how many changed
    """
    cache = ComplianceCache(*cache)
    n_changed = 0
    last = np.int64(-1)
    chosen = np.int64(-1)
    for k in range(len(rows)):
        row = rows[k]
        draw = draws[k] if len(draws) > 0 else -1.0
        # Most states have the same nearest transitions as the state before, and their choice follows from these alone.
        if last < 0 or draw >= 0.0 or actions[k] != actions[k - 1] or not same_neighbors(near[row], near[last]):
            chosen = choose_one(near[row], actions[k], cache, first, draw)
        last = row
        if chosen != choice[row]:
            choice[row] = chosen
            rows[n_changed] = row
            n_changed += 1
    return n_changed


@entry_point
def select(query, recorded, limits, cache, first, draws, found):
    """Choose candidates for exact states and actions (lines 17-20), if all that are needed have been measured.

    :param query: as ``recorded`` and ``limits``: see :func:`find_nearest`
    :param draws: a random number for each action; or nothing; the rest as in :func:`choose`
    :param found: (nearest transitions, their distances, first candidate, one past the last: none if equal), n of each
    :return: whether all nearest transitions have been measured; otherwise nothing is chosen
    """
    cache = ComplianceCache(*cache)
    _, actions, _ = query
    near, distance, begin, end = found
    find_nearest(query, recorded, limits, near, distance)
    for r in range(len(actions)):
        for k in range(near.shape[1]):
            if near[r, k] >= 0 and not cache.measured[near[r, k]]:
                return False
    for r in range(len(actions)):
        draw = draws[actions[r]] if len(draws) > 0 else -1.0
        chosen = choose_one(near[r], actions[r], cache, first, draw)
        begin[r], end[r] = max(chosen, 0), chosen + 1
    return True
