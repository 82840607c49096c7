"""Compiled loops of COMBREL's vote: the nearest target transitions choose a candidate by compliance (Algorithm 1)."""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import compiled, inner


class Ballots(ArrayStruct):
    """What the measured target transitions have to say; transition i speaks about the candidates of its action only.

    :param compliance: float64, shape (n_transitions, most candidates of an action): with each of them, in their order
    :param least: float64, shape (n_transitions,): what the compliances of the voters must exceed in the mean
    :param measured: bool, shape (n_transitions,): whether this is known of the transition
    :param total: float64 scratch, shape (most candidates of an action,)
    """

    compliance: np.ndarray
    least: np.ndarray
    measured: np.ndarray
    total: np.ndarray

    @classmethod
    def empty(cls, most_candidates: int, capacity: int = 64) -> "Ballots":
        """Room for ``capacity`` transitions."""
        return cls(
            compliance=np.empty((capacity, most_candidates)),
            least=np.empty(capacity),
            measured=np.zeros(capacity, dtype=np.bool_),
            total=np.empty(most_candidates),
        )

    def with_room(self, i: int) -> "Ballots":
        """Itself, or a copy of twice the size if transition ``i`` would not fit."""
        if i < len(self.least):
            return self
        return self.replace(
            compliance=np.concatenate([self.compliance, np.empty_like(self.compliance)]),
            least=np.concatenate([self.least, np.empty_like(self.least)]),
            measured=np.concatenate([self.measured, np.zeros_like(self.measured)]),
        )


@compiled
def note_neighbor(i, state, sample_states, near, distance, due):
    """Enter transition ``i`` at every sample state that has it among its nearest.

    :param near: int64, shape (n_points, n_neighbors): nearest transitions, -1 for none, updated
    :param distance: squared distances to them, the limit for none, updated
    :param due: bool, shape (n_points,): becomes True where it entered: a vote is due there
    """
    n_points, d = sample_states.shape
    last = near.shape[1] - 1
    for p in range(n_points):
        apart = 0.0
        for v in range(d):
            along = sample_states[p, v] - state[v]
            apart += along * along
        if apart < distance[p, last]:
            insert_neighbor(i, apart, near[p], distance[p])
            due[p] = True


@inner
def insert_neighbor(i, apart, near, distance):
    """Enter a transition among the nearest of one state, the nearest first; the last one leaves."""
    k = len(near) - 1
    while k > 0 and distance[k - 1] > apart:
        distance[k] = distance[k - 1]
        near[k] = near[k - 1]
        k -= 1
    distance[k] = apart
    near[k] = i


@inner
def elect(near, compliance, least, n_candidates, draw, total):
    """The candidate that the transitions ``near`` choose; -1 if none has more than the least in the mean.

    :param n_candidates: of the action
    :param draw: a random number from [0, 1): each that has enough is chosen with a probability in proportion to its mean
        compliance; below 0: the one with the highest is (of equal ones the first)
    :param total: see ``Ballots``
    """
    bar = 0.0
    total[:n_candidates] = 0.0
    for k in range(len(near)):
        voter = near[k]
        if voter >= 0:
            bar += least[voter]
            for c in range(n_candidates):
                total[c] += compliance[voter, c]
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
def vote(pairs, near, ballots, first, draws, choice):
    """Renew the choice of some pairs; those for which it changed are moved to the front of ``pairs``.

    :param pairs: of an action and one of n_points states, ``action * n_points + point``
    :param near: int64, shape (n_actions * n_points, n_neighbors): the transitions that vote, -1 for none
    :param first: see ``CandidateArrays``
    :param draws: a random number for each of ``pairs``; or nothing, shape (0,): the best is chosen (see ``elect``)
    :param choice: int64, shape (n_actions * n_points,), updated
    :return: how many changed
    """
    n_points = len(choice) // (len(first) - 1)
    n_changed = 0
    for f in range(len(pairs)):
        pair = pairs[f]
        action = pair // n_points
        draw = draws[f] if len(draws) > 0 else -1.0
        n_candidates = first[action + 1] - first[action]
        chosen = elect(near[pair], ballots.compliance, ballots.least, n_candidates, draw, ballots.total)
        if chosen >= 0:
            chosen += first[action]
        if chosen != choice[pair]:
            choice[pair] = chosen
            pairs[n_changed] = pair
            n_changed += 1
    return n_changed


@compiled
def find_voters(state, missing, states, actions, n, limit, near, distance):
    """The transitions that vote at an exact state, for every action with ``missing``; no one for the others.

    :param states: target transitions' states, of which the first ``n`` may vote; ``actions``: their actions
    :param limit: squared distance from which on a transition does not vote
    :param near: receives the transitions, the nearest first, -1 for none, shape (n_actions, n_neighbors)
    :param distance: float64 scratch, same shape
    """
    near[:] = -1
    distance[:] = limit
    last = near.shape[1] - 1
    for i in range(n):
        action = actions[i]
        if not missing[action]:
            continue
        apart = 0.0
        for v in range(len(state)):
            along = states[i, v] - state[v]
            apart += along * along
        if apart < distance[action, last]:
            insert_neighbor(i, apart, near[action], distance[action])
