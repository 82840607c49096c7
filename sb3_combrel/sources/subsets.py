"""Which of many instances to keep: at random, or so that they cover the task's states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.periodic import differences
from sb3_combrel.common.suggestions import did_you_mean

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


def check_method(method: str) -> None:
    """Raise ``ValueError`` if there is no such method of choosing instances."""
    known = "random", "covering"
    if method not in known:
        raise ValueError(f"method must be 'random' or 'covering', got {method!r}{did_you_mean(method, known)}")


def random_rows(terminated: Flags, n_rows: int, rng: np.random.Generator) -> Ints:
    """A uniform sample of ``n_rows`` < n row numbers, ascending, with at least one terminal instance if there is any."""
    return _keep_terminal(rng.choice(len(terminated), n_rows, replace=False), terminated, rng)


def covering_rows(
    units: Floats, actions: Ints, terminated: Flags, n_rows: int, rng: np.random.Generator, periodic: Flags | None = None
) -> Ints:
    """About equally many instances of each action, spread over the states: farthest-point (greedy k-centre) selection."""
    rows_of = [np.flatnonzero(actions == action) for action in np.unique(actions)]
    quotas = _equal_quotas(np.array([len(rows) for rows in rows_of]), n_rows)
    # Selected rows of an action come in the order of selection, so the last one is the least informative.
    chosen = [rows[_farthest_points(units[rows], quota, rng, periodic)] for rows, quota in zip(rows_of, quotas, strict=True)]
    return _keep_terminal(np.concatenate(chosen), terminated, rng)


def _farthest_points(units: Floats, n_points: int, rng: np.random.Generator, periodic: Flags | None) -> Ints:
    """Begin anywhere, then always add the point that is farthest from all points so far."""
    chosen = np.empty(n_points, dtype=np.int64)
    distance = np.full(len(units), np.inf)
    candidate = int(rng.integers(len(units)))
    for i in range(n_points):
        chosen[i] = candidate
        np.minimum(distance, (differences(units, units[candidate], periodic) ** 2).sum(axis=1), out=distance)
        distance[candidate] = -1.0  # of identical states one is as good as another, but none must be chosen twice
        candidate = int(distance.argmax())
    return chosen


def _equal_quotas(available: Ints, total: int) -> Ints:
    """Divide ``total`` as equally as what is available allows; what one action lacks goes to the others."""
    quotas = np.zeros_like(available)
    for rank, i in enumerate(np.argsort(available, kind="stable")):
        quotas[i] = min(available[i], (total - quotas.sum()) // (len(available) - rank))
    return quotas


def _keep_terminal(rows: Ints, terminated: Flags, rng: np.random.Generator) -> Ints:
    # Without a terminal instance nothing of the goal is transferred. It replaces the last row chosen.
    if terminated.any() and not terminated[rows].any():
        rows[-1] = rng.choice(np.flatnonzero(terminated))
    return np.sort(rows)
