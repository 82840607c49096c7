"""Kernel bandwidths of compliance and relevance, chosen from a source's instances and a mapping's variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.instances import Instances
from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.equations import Bandwidths

# So many instances are to share in a prediction, typically.
N_SHARING = 20


class CandidateBandwidths(NamedTuple):
    """Bandwidths of Eq. 2, of all candidates."""

    of_all: Bandwidths  # but for ``start``
    starts: np.ndarray  # float64, shape (n_state_mappings,): the start bandwidth of each state mapping


def candidate_bandwidths(candidates: Candidates, given: Sequence[float] | None) -> CandidateBandwidths:
    """Take the bandwidths ``given``, (start, outcome, reward), the same for all mappings; or choose them from the data."""
    if given is None:
        of_all = default_bandwidths(candidates.instances)
        return CandidateBandwidths(of_all, start_bandwidths(candidates, of_all.start))
    return CandidateBandwidths(Bandwidths(*given), np.full(len(candidates.table.variable), float(given[0])))


def default_bandwidths(source: Instances) -> Bandwidths:
    """Choose bandwidths from a source's instances.

    Of starts: the median squared distance to about the 20th instance of the same action. Of outcomes: the mean squared effect.
    Of rewards: their variance; 1 where they are all alike.
    """
    from scipy.spatial import cKDTree

    distances, effects, rewards = [], [], []
    periodic = source.periodic
    for action, n in enumerate(source.size):
        if n > 1:
            # The tree wants periodic coordinates below the period.
            states = np.where(periodic, source.state[action, :n] % 1.0, source.state[action, :n])
            nth = min(N_SHARING, n - 1) + 1
            tree = cKDTree(states, boxsize=np.where(periodic, 1.0, 0.0) if periodic.any() else None)
            distances.append(tree.query(states, k=[nth])[0].ravel())
        effects.append((source.effect[action, :n] ** 2).sum(axis=1))
        rewards.append(source.reward[action, :n])
    start = float(np.median(np.concatenate(distances))) ** 2 if distances else 0.02
    variance = float(np.concatenate(rewards).var())
    return Bandwidths(
        start=max(start, 1e-6),
        outcome=max(float(np.concatenate(effects).mean()), 1e-9),
        reward=variance if variance > 1e-12 else 1.0,
    )


def start_bandwidths(candidates: Candidates, start: float) -> np.ndarray:
    """Choose the start bandwidth of every state mapping, in proportion to how many variables it compares.

    An instance equally far along each variable then weighs the same, however many there are.

    :param start: for mappings that compare as many variables as their source has
    """
    fractions = [
        (mappings.state_mappings >= 0).sum(axis=1) / source.n_variables
        for source, mappings in zip(candidates.sources, candidates.sets, strict=True)
    ]
    # A mapping of no variables compares nothing; the bandwidth must be above 0 all the same.
    return np.maximum(start * np.concatenate(fractions), 1e-6)
