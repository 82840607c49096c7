"""The evidence for a source over time: one point whenever it is renewed or its bound is exceeded; in between it stays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_combrel.transfer.report import EvidencePoint

if TYPE_CHECKING:
    from sb3_combrel.transfer.prior.source_prior import SourcePrior

# Columns before those of the target actions: steps, error (-1 for none: saved models have no NaN), excess, whether bounded.
N_FIRST = 4


class PriorHistory:
    """Rows of steps, error, excess, whether values are bounded, and by target action strength, 0 for none, and candidate.

    Renewals come ever more rarely, so the rows stay few.

    :param n_actions: target actions
    """

    def __init__(self, n_actions: int):
        self._n_actions = n_actions
        self._rows: list[np.ndarray] = []

    def note(self, prior: SourcePrior) -> None:
        """Add what is believed now, in place of what was at the same step."""
        row = self._row(prior)
        if self._rows and self._rows[-1][0] == row[0]:
            self._rows.pop()
        self._rows.append(row)

    def points(self, prior: SourcePrior) -> tuple[EvidencePoint, ...]:
        """Return all points by name, the last of them of now."""
        rows = [row for row in self._rows if row[0] < prior.n_observed]
        return tuple(self._point(prior, row) for row in [*rows, self._row(prior)])

    def _row(self, prior: SourcePrior) -> np.ndarray:
        error = prior.error()
        first = prior.n_observed, -1.0 if np.isnan(error) else error, prior.excess, prior.value_bound() is not None
        return np.concatenate([first, np.nan_to_num(prior.strengths()), prior.choices_by_action()], dtype=np.float64)

    def _point(self, prior: SourcePrior, row: np.ndarray) -> EvidencePoint:
        step, error, exceeded, bounded = row[:N_FIRST].tolist()
        strengths, candidates = row[N_FIRST:].reshape(2, self._n_actions)
        of = prior.candidates
        return EvidencePoint(
            step=int(step),
            error=np.nan if error < 0.0 else error,
            exceeded=exceeded,
            bounds_values=bool(bounded),
            strengths=tuple(strengths.tolist()),
            mappings=tuple(of.describe_moves(of.made_of(int(number))[1] if number >= 0 else []) for number in candidates),
        )

    def get_state(self) -> np.ndarray:
        """Return the rows, float64, shape (n, 4 + 2 * n_actions)."""
        return np.array(self._rows, dtype=np.float64).reshape(-1, N_FIRST + 2 * self._n_actions)

    def set_state(self, rows: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        self._rows = list(rows.copy())
