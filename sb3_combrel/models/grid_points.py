"""Which state-action pairs of the grid a new instance concerns, and when they are to be fitted anew."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import entry_point, inlined
from sb3_combrel.common.constants import MAX_SURPRISE, SHARE_OF_LIST
from sb3_combrel.common.periodic import difference
from sb3_combrel.planning.grid import GridArrays, grid_coordinate, next_row, unit_of_line

ROUNDING = 1e-12


class PairArrays(NamedTuple):
    """What a model has of each pair (pair ``action * n_points + point``)."""

    reach: np.ndarray  # float64, (n_pairs,): squared distance within which a new instance concerns the pair
    n_new: np.ndarray  # int32, (n_pairs,): instances that came or went within that since the pair was last fitted
    length: np.ndarray  # int32, (n_pairs,): instances that it was fitted to then
    fitted_at: np.ndarray  # int64, (n_pairs,): transitions there were then; 0: it never was
    weight: np.ndarray  # float64, (n_pairs,): of the instances, which decides whether the pair is known
    known: np.ndarray  # bool, (n_pairs,)
    # How much new instances may have changed of what is predicted, in parts of the mean effect; inf: it is fitted at once.
    surprise: np.ndarray  # float64, (n_pairs,)
    # Means and slopes of the numbers of ``LocalFit``; (n_pairs, 0, 0) for a model without.
    fit: np.ndarray  # float64, (n_pairs, d + 1, n_numbers)
    item: np.ndarray  # int32, (n_pairs, n_neighbors): the instances it was fitted to; (n_pairs, 0) without a prior

    @classmethod
    def empty(cls, n_pairs: int, reach: float, fitted: tuple[int, int], n_kept: int) -> "PairArrays":
        """Pairs none of which has been fitted; ``fitted``: (d + 1, n_numbers), or (0, 0) for a model without fits."""
        return cls(
            reach=np.full(n_pairs, reach),
            n_new=np.zeros(n_pairs, dtype=np.int32),
            length=np.zeros(n_pairs, dtype=np.int32),
            fitted_at=np.zeros(n_pairs, dtype=np.int64),
            weight=np.zeros(n_pairs),
            known=np.zeros(n_pairs, dtype=np.bool_),
            surprise=np.zeros(n_pairs),
            fit=np.zeros((n_pairs, *fitted)),
            item=np.zeros((n_pairs, n_kept), dtype=np.int32),
        )


class PointScratch(NamedTuple):
    """Work space for the grid points around a state."""

    along: np.ndarray  # float64, (n_variables, largest axis of the grid): squared distances along one variable
    span: np.ndarray  # int64, (3, n_variables): first grid coordinate within reach, one past the last, the present one
    pair: np.ndarray  # int64, (n_pairs,): pairs that are due
    predicted: np.ndarray  # float64, (n_numbers,): what a pair predicts


@inlined
def note_fit(pair, length, weight, threshold, transitions, pairs):
    """Note that a pair is fitted to its instances; whether these suffice."""
    pairs.n_new[pair], pairs.length[pair], pairs.fitted_at[pair] = 0, length, transitions
    pairs.weight[pair], pairs.known[pair], pairs.surprise[pair] = weight, weight >= threshold, 0.0
    return pairs.known[pair]


# Why the pairs around a state are looked at: an instance has come, has gone, or an episode has ended there.
CAME, WENT, ENDED = range(3)


@inlined
def surprise_of(pair, distance, pairs, numbers, state, at, grid, size, per_breadth, predicted):
    """By how much an instance may change what a pair predicts, in parts of the mean size of the action's numbers."""
    for v in range(len(numbers)):
        predicted[v] = pairs.fit[pair, 0, v]
    for k in range(len(state)):
        away = difference(state[k], unit_of_line(at[k], k, grid), grid.periodic[k])
        for v in range(len(numbers)):
            predicted[v] += pairs.fit[pair, k + 1, v] * away
    worst = 0.0
    for v in range(len(numbers)):
        worst = max(worst, abs(numbers[v] - predicted[v]) / size[v])
    return worst * np.exp(-per_breadth * distance / pairs.reach[pair]) / max(1.0, SHARE_OF_LIST * pairs.length[pair])


@inlined
def look_at(pair, distance, widest, why, pairs, instance, at, grid, rules, predicted):
    """Note at one pair what has happened near it; whether it is to be fitted at once."""
    state, numbers, size = instance
    scale, per_breadth, threshold, few = rules
    if why != ENDED and distance > pairs.reach[pair] * (1.0 + ROUNDING):
        return False
    if why == WENT:
        # Another one, farther away, may take its place, and what is left may be too little.
        pairs.reach[pair] = widest
        pairs.n_new[pair] += 1
        pairs.known[pair] = False
        return True
    if why == ENDED:
        return pairs.known[pair]
    pairs.n_new[pair] += 1
    if not pairs.known[pair]:
        pairs.weight[pair] += np.exp(distance * scale)
        return pairs.weight[pair] >= threshold * (1.0 - 1e-9) or pairs.n_new[pair] * few > pairs.length[pair]
    if pairs.fit.shape[1] == 0:
        return True
    pairs.surprise[pair] += surprise_of(pair, distance, pairs, numbers, state, at, grid, size, per_breadth, predicted)
    return pairs.surprise[pair] > MAX_SURPRISE or pairs.n_new[pair] * 2 >= pairs.length[pair]


@entry_point
def note_instance(instance, first_pair, pairs, widest, why, grid, rules, scratch):
    """Note an instance at all pairs of an action that it concerns; how many are to be fitted, in ``scratch.pair``.

    :param instance: (state; what is fitted of it, shape (n_numbers,); what differences of these are measured by)
    :param first_pair: of the action; plain tuples for ``pairs``, ``grid`` and ``scratch``
    :param widest: squared distance beyond which no pair is concerned
    :param why: CAME, WENT, or ENDED: then the state is where an episode ended
    :param rules: (``scale`` and ``per_breadth`` of Kernel, threshold, 1 if a pair that is not known is fitted when its
        instances are twice as many, or 0: it waits until it becomes known)
    """
    pairs, grid, scratch = PairArrays(*pairs), GridArrays(*grid), PointScratch(*scratch)
    first, last, at = scratch.span[0], scratch.span[1], scratch.span[2]
    state = instance[0]
    d = len(state)
    radius = np.sqrt(widest) * (1 + 1e-12)
    for k in range(d):
        if grid.periodic[k]:
            first[k], last[k] = 0, grid.shape[k]
        else:
            first[k] = max(0, int(np.ceil(grid_coordinate(state[k] - radius, k, grid))))
            last[k] = min(grid.shape[k], int(np.floor(grid_coordinate(state[k] + radius, k, grid))) + 1)
        if first[k] >= last[k]:
            return 0
        for j in range(first[k], last[k]):
            apart = difference(unit_of_line(j, k, grid), state[k], grid.periodic[k])
            scratch.along[k, j] = apart * apart
        at[k] = first[k]
    due = 0
    inner = d - 1
    while True:
        outer = 0.0
        base = first_pair
        for k in range(inner):
            outer += scratch.along[k, at[k]]
            base += at[k] * grid.strides[k]
        if outer <= widest:
            for j in range(first[inner], last[inner]):
                distance = outer + scratch.along[inner, j]
                at[inner] = j
                if distance > widest:
                    continue
                if look_at(base + j, distance, widest, why, pairs, instance, at, grid, rules, scratch.predicted):
                    scratch.pair[due] = base + j
                    due += 1
        if not next_row(at, first, last):
            return due
