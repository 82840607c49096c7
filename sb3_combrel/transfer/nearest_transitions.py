"""Compiled loops of COMBREL's selection: the nearest target transitions choose a candidate by compliance (Algorithm 1)."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inner


class ComplianceCache(NamedTuple):
    """
    Compliance of target transitions, computed once; that of transition i is with the candidates of its action only.

    :param compliance: float64, shape (n_transitions, most candidates of an action): with each of them, in their order
    :param required: float64, shape (n_transitions,): what the mean compliance of the nearest transitions must exceed
    :param measured: bool, shape (n_transitions,): whether the compliance has been computed
    :param total: float64 scratch, shape (most candidates of an action,)
    """

    compliance: np.ndarray
    required: np.ndarray
    measured: np.ndarray
    total: np.ndarray

    @classmethod
    def empty(cls, max_candidates: int, capacity: int = 64) -> "ComplianceCache":
        """Make room for ``capacity`` transitions."""
        return cls(
            compliance=np.empty((capacity, max_candidates)),
            required=np.empty(capacity),
            measured=np.zeros(capacity, dtype=np.bool_),
            total=np.empty(max_candidates),
        )

    def with_room(self, i: int) -> "ComplianceCache":
        """Return itself, or a copy of twice the size if transition ``i`` would not fit."""
        if i < len(self.required):
            return self
        return self._replace(
            compliance=np.concatenate([self.compliance, np.empty_like(self.compliance)]),
            required=np.concatenate([self.required, np.empty_like(self.required)]),
            measured=np.concatenate([self.measured, np.zeros_like(self.measured)]),
        )


@compiled
def add_to_sample(i, state, sample_states, near, distance, due):
    """
    Add transition ``i`` to the nearest ones of every sample state that has it among them.

    :param near: int64, shape (n_points, n_neighbors): nearest transitions, -1 for none, updated
    :param distance: squared distances to them, the limit for none, updated
    :param due: bool, shape (n_points,): becomes True where it was added: the choice there has to be renewed
    """
    n_points, d = sample_states.shape
    last = near.shape[1] - 1
    for p in range(n_points):
        apart = 0.0
        for v in range(d):
            along = sample_states[p, v] - state[v]
            apart += along * along
        if apart < distance[p, last]:
            add_neighbor(i, apart, near[p], distance[p])
            due[p] = True


@inner
def add_neighbor(i, apart, near, distance):
    """Add a transition to the nearest of one state, the nearest first; the last one leaves."""
    k = len(near) - 1
    while k > 0 and distance[k - 1] > apart:
        distance[k] = distance[k - 1]
        near[k] = near[k - 1]
        k -= 1
    distance[k] = apart
    near[k] = i


@compiled
def find_nearest(states, actions, own_weight, threshold, recorded, listed, n_listed, limit, near, distance):
    """
    Find the nearest transitions of exact states and actions (line 17).

    :param states: shape (n, n_variables); ``actions``: shape (n,)
    :param own_weight: shape (n,); where it reaches ``threshold`` none are needed, and none are found
    :param recorded: states of the recorded transitions
    :param listed: int64, shape (n_actions, capacity): the transitions that count for each action; the first ``n_listed``
    :param limit: squared distance from which on a transition does not count
    :param near: receives the transitions, the nearest first, -1 for none, shape (at required n, n_neighbors)
    :param distance: float64 scratch, same shape
    """
    last = near.shape[1] - 1
    for r in range(len(actions)):
        near[r] = -1
        distance[r] = limit
        if own_weight[r] >= threshold:
            continue
        action = actions[r]
        for n in range(n_listed[action]):
            i = listed[action, n]
            apart = 0.0
            for v in range(states.shape[1]):
                along = recorded[i, v] - states[r, v]
                apart += along * along
            if apart < distance[r, last]:
                add_neighbor(i, apart, near[r], distance[r])


@inner
def choose_one(near, compliance, required, n_candidates, draw, total):
    """
    Choose a candidate by the mean compliance of the transitions ``near``; -1 if none exceeds what is required (lines 19-20).

    :param n_candidates: of the action
    :param draw: a random number from [0, 1): each candidate that exceeds it is chosen with a probability in
        proportion to its mean compliance; below 0: the one with the highest is (of equal ones the first)
    :param total: see ``ComplianceCache``
    """
    bar = 0.0
    total[:n_candidates] = 0.0
    for k in range(len(near)):
        i = near[k]
        if i >= 0:
            bar += required[i]
            for c in range(n_candidates):
                total[c] += compliance[i, c]
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
        return best
    mass *= draw
    for c in range(n_candidates):
        if total[c] > bar:
            mass -= total[c]
            # Rounding may leave a little to the end.
            if mass < 0.0:
                return c
    return best


@compiled
def choose(rows, actions, near, cache, first, draws, choice):
    """
    Renew the choices of some rows; those for which it changed are moved to the front of ``rows``.

    :param rows: int64, shape (n,): rows of ``near`` and ``choice``
    :param actions: int64, shape (n,): their actions
    :param near: int64, shape (at required n, n_neighbors): nearest transitions, -1 for none
    :param cache: ComplianceCache, in which they are measured
    :param first: see ``CandidateArrays``
    :param draws: a random number for each of ``rows``; or nothing, shape (0,): the best is chosen (see ``choose_one``)
    :param choice: int64: candidates, -1 for none, updated
    :return: how many changed
    """
    n_changed = 0
    for k in range(len(rows)):
        row = rows[k]
        action = actions[k]
        draw = draws[k] if len(draws) > 0 else -1.0
        n_candidates = first[action + 1] - first[action]
        chosen = choose_one(near[row], cache.compliance, cache.required, n_candidates, draw, cache.total)
        if chosen >= 0:
            chosen += first[action]
        if chosen != choice[row]:
            choice[row] = chosen
            rows[n_changed] = row
            n_changed += 1
    return n_changed
