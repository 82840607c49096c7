"""What a run records of the mappings that its transfer method selects."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.transfer.base import Transfer


class SelectionRecorder(BaseCallback):
    """Records the state at which instances of a candidate were used, each time that they were; of one environment."""

    def __init__(self) -> None:
        super().__init__()
        self._before: dict[int, int] = {}
        self._state: np.ndarray | None = None
        self._rows: list[tuple[int, np.ndarray]] = []

    def _on_training_start(self) -> None:
        self._state = self.model._last_obs[0].copy()  # type: ignore[index]

    def _on_step(self) -> bool:
        # The model was asked about the state in which the step was made, before it was made.
        assert self._state is not None
        uses = self.model.agent.transfer.uses()  # type: ignore[attr-defined]
        if uses != self._before:
            new = (number for number, n in uses.items() if n != self._before.get(number, 0))
            self._rows += [(number, self._state) for number in new]
            self._before = uses
        self._state = self.locals["new_obs"][0].copy()
        return True

    def rows(self, candidates: list[int]) -> list[list[float]]:
        """
        Return the selections, in their order: [place of the candidate in ``candidates``, *state, raw units].

        :param candidates: numbers of all candidates that were used
        """
        place = {number: k for k, number in enumerate(candidates)}
        return [[place[number], *np.round(state.astype(np.float64), 5).tolist()] for number, state in self._rows]


def uses_of(transfer: Transfer | None) -> list[tuple[int, list[Any]]]:
    """
    Return how often instances of each candidate were used, the most used first.

    :return: number of the candidate, and [target action, source action, state mapping, action mapping or "", times]
    """
    if transfer is None:
        return []
    names = transfer.task.action_names  # type: ignore[union-attr]
    found = []
    for number, n in sorted(transfer.uses().items(), key=lambda use: (-use[1], use[0])):  # type: ignore[attr-defined]
        parts = transfer.candidate(number)  # type: ignore[attr-defined]
        action_mapping = ", ".join(parts.action_mapping)
        found.append((number, [names[parts.target_action], parts.source_action, parts.state_mapping, action_mapping, n]))
    return found


def selections_at_sample(transfer: Transfer | None) -> dict[str, list[str]]:
    """Return the source action selected for each state of the finite sample, by target action; "" where there is none."""
    if transfer is None or not transfer.makes_choices:  # type: ignore[attr-defined]
        return {}
    assert transfer.task is not None
    points = transfer.task.sample_states
    found = {}
    for action, name in enumerate(transfer.task.action_names):
        numbers = transfer.selected(points, np.full(len(points), action)).tolist()  # type: ignore[attr-defined]
        known = {number: transfer.candidate(number).source_action for number in set(numbers) - {-1}}  # type: ignore[attr-defined]
        found[name] = [known.get(number, "") for number in numbers]
    return found
