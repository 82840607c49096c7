"""Where in the state space the target's own transitions contradict what a source predicts."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.outcome_evidence import OutcomeEvidence
from sb3_combrel.transfer.report import Contradiction

# Each state variable's range is divided into so many parts.
N_PARTS = 4
# A part with fewer transitions says nothing.
MIN_IN_PART = 10
MAX_CONTRADICTIONS = 8
# Effects are squared unit coordinates; less than this is no movement.
NO_MOVEMENT = 1e-18
_N, _ERROR, _EFFECT, _WORSE = range(4)


class RegionErrors:
    """Sums of squared prediction errors and squared effects, by target action and by part of each state variable's range."""

    def __init__(self, task: TargetTask):
        self.task = task
        #: Number of transitions, squared errors, squared effects, and number of those whose error is the larger one; shape
        #: (n_actions, n_variables, N_PARTS, 4).
        self.sums = np.zeros((task.n_actions, task.n_variables, N_PARTS, 4))
        self._variables = np.arange(task.n_variables)

    def note(self, state: np.ndarray, action: int, effect: np.ndarray, predicted: np.ndarray) -> None:
        """Add a transition whose effect was ``predicted``; unit coordinates."""
        part = np.clip((state * N_PARTS).astype(np.int64), 0, N_PARTS - 1)
        error, moved = (float((each * each).sum()) for each in (effect - predicted, effect))
        self.sums[action, self._variables, part] += 1.0, error, moved, error > moved

    def forget(self) -> None:
        """Forget all transitions."""
        self.sums[:] = 0.0

    @property
    def of_actions(self) -> np.ndarray:
        """Sums by target action: number, squared error, squared effect, number that are worse; shape (n_actions, 4)."""
        # Each transition is in one part of every variable.
        return self.sums[:, 0].sum(axis=1)

    def errors(self) -> np.ndarray:
        """Return the mean squared error over that of "no change", by target action, NaN where nothing moved."""
        sums = self.of_actions
        moved = sums[:, _EFFECT] > NO_MOVEMENT
        return np.where(moved, sums[:, _ERROR] / np.where(moved, sums[:, _EFFECT], 1.0), np.nan)

    def error(self) -> float:
        """Return the same over all actions."""
        _, error, effect, _ = self.of_actions.sum(axis=0).tolist()
        return error / effect if effect > NO_MOVEMENT else np.nan

    def contradictions(self) -> tuple[Contradiction, ...]:
        """Return the parts in which predictions are worse than "no change", the largest excess of squared error first."""
        excess = self.sums[..., _ERROR] - self.sums[..., _EFFECT]
        worse = (self.sums[..., _N] >= MIN_IN_PART) & (excess > NO_MOVEMENT)
        order = sorted(map(tuple, np.argwhere(worse).tolist()), key=lambda cell: -excess[cell])
        return tuple(self._contradiction(*cell) for cell in order[:MAX_CONTRADICTIONS])

    def report_fields(self, evidence: OutcomeEvidence) -> dict[str, Any]:
        """Return the fields of a report that say how the target's transitions compare with what was predicted of them."""
        totals = self.of_actions.sum(axis=0)
        return dict(
            n_compared=int(totals[_N]),
            n_worse=int(totals[_WORSE]),
            contradictions=self.contradictions(),
            ends=(evidence.confirmed, evidence.contradicted),
            rewards=(evidence.rewards_right, evidence.rewards_wrong),
        )

    def _contradiction(self, action: int, variable: int, part: int) -> Contradiction:
        n, error, effect, _ = self.sums[action, variable, part].tolist()
        low, high = (float(bound[variable]) for bound in (self.task.scaling.low, self.task.scaling.high))
        width = (high - low) / N_PARTS
        return Contradiction(
            target_action=self.task.action_names[action],
            variable=self.task.state_names[variable],
            low=low + part * width,
            high=low + (part + 1) * width,
            n_compared=int(n),
            error=error / effect if effect > NO_MOVEMENT else np.inf,
        )
