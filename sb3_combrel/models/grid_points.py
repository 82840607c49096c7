"""Which state-action pairs of the grid a new instance concerns, and when they are to be fitted anew."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled
from sb3_combrel.common.periodic import difference
from sb3_combrel.planning.grid import GridArrays


class PairArrays(NamedTuple):
    """What a model has of each pair (pair ``action * n_points + point``)."""

    reach: np.ndarray  # float64, (n_pairs,): squared distance within which a new instance concerns the pair
    n_new: np.ndarray  # int32, (n_pairs,): instances within that since the pair was last fitted
    renewed_after: np.ndarray  # int32, (n_pairs,): with so many new ones it is fitted again
    fitted_at: np.ndarray  # int64, (n_pairs,): transitions there were when it was last fitted; 0: it never was
    weight: np.ndarray  # float64, (n_pairs,): of its instances then
    known: np.ndarray  # bool, (n_pairs,): whether that suffices

    @classmethod
    def empty(cls, n_pairs: int, reach: float) -> "PairArrays":
        """Pairs none of which has been fitted."""
        return cls(
            reach=np.full(n_pairs, reach),
            n_new=np.zeros(n_pairs, dtype=np.int32),
            renewed_after=np.ones(n_pairs, dtype=np.int32),
            fitted_at=np.zeros(n_pairs, dtype=np.int64),
            weight=np.zeros(n_pairs),
            known=np.zeros(n_pairs, dtype=np.bool_),
        )


class PointScratch(NamedTuple):
    """Work space for the grid points around a state."""

    along: np.ndarray  # float64, (n_variables, largest axis of the grid): squared distances along one variable
    span: np.ndarray  # int64, (3, n_variables): first grid coordinate within reach, one past the last, the present one
    pair: np.ndarray  # int64, (n_pairs,): pairs that are due

    @classmethod
    def empty(cls, grid: GridArrays, n_pairs: int) -> "PointScratch":
        """Make room for a grid."""
        d = len(grid.shape)
        along = np.empty((d, int(grid.shape.max())))
        return cls(along, np.empty((3, d), dtype=np.int64), np.empty(n_pairs, dtype=np.int64))


@compiled
def note_instance(state, first_pair, pairs, widest, at_once, grid, scratch):
    """Count a new instance at ``state`` for the pairs of an action that it concerns; how many are due, in ``scratch.pair``.

    :param first_pair: of the action; plain tuples for ``pairs``, ``grid`` and ``scratch``
    :param widest: the largest reach that a pair may have
    :param at_once: whether all that it concerns are due, as when an instance is removed
    """
    pairs, grid, scratch = PairArrays(*pairs), GridArrays(*grid), PointScratch(*scratch)
    first, last, at = scratch.span[0], scratch.span[1], scratch.span[2]
    d = len(state)
    radius = np.sqrt(widest) * (1 + 1e-12)
    for k in range(d):
        if grid.periodic[k]:
            first[k], last[k] = 0, grid.shape[k]
        else:
            first[k] = max(0, int(np.ceil((state[k] - radius) * grid.cells[k] + grid.margin[k])))
            last[k] = min(grid.shape[k], int(np.floor((state[k] + radius) * grid.cells[k] + grid.margin[k])) + 1)
        if first[k] >= last[k]:
            return 0
        for j in range(first[k], last[k]):
            apart = difference((j - grid.margin[k]) / grid.cells[k], state[k], grid.periodic[k])
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
                if outer + scratch.along[inner, j] <= pairs.reach[base + j]:
                    pairs.n_new[base + j] += 1
                    if at_once or pairs.n_new[base + j] >= pairs.renewed_after[base + j]:
                        scratch.pair[due] = base + j
                        due += 1
        k = inner - 1
        while k >= 0:
            at[k] += 1
            if at[k] < last[k]:
                break
            at[k] = first[k]
            k -= 1
        if k < 0:
            return due
