"""The evidence for a source over time: one row whenever it is renewed or its bound is exceeded; in between it stays.

Renewals come ever more rarely, so the rows stay few.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_combrel.transfer.report import EvidencePoint

if TYPE_CHECKING:
    from sb3_combrel.transfer.prior.source_prior import SourcePrior

# Columns before those of the target actions: steps, error (-1 for none: saved models have no NaN), excess, whether bounded.
N_FIRST = 4


def belief(prior: SourcePrior) -> np.ndarray:
    """What is believed now: the first columns, and by target action strength, 0 for none, and candidate; float64, one row."""
    error = prior.error()
    first = prior.n_observed, -1.0 if np.isnan(error) else error, prior.excess, prior.value_bound() is not None
    return np.concatenate([first, np.nan_to_num(prior.strengths()), prior.choices_by_action()], dtype=np.float64)


def evidence_points(prior: SourcePrior) -> tuple[EvidencePoint, ...]:
    """Return all rows by name, the last of them of now."""
    rows = [row for row in prior.history if row[0] < prior.n_observed]
    return tuple(_point(prior, row) for row in [*rows, belief(prior)])


def _point(prior: SourcePrior, row: np.ndarray) -> EvidencePoint:
    step, error, exceeded, bounded = row[:N_FIRST].tolist()
    strengths, candidates = row[N_FIRST:].reshape(2, -1)
    of = prior.candidates
    return EvidencePoint(
        step=int(step),
        error=np.nan if error < 0.0 else error,
        exceeded=exceeded,
        bounds_values=bool(bounded),
        strengths=tuple(strengths.tolist()),
        mappings=tuple(of.describe_moves(of.made_of(int(number))[1] if number >= 0 else []) for number in candidates),
    )
