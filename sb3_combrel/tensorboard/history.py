"""Which candidates were chosen when, in bounded memory."""

from __future__ import annotations

import numpy as np

MAX_COLUMNS = 200


class ChoiceHistory:
    """
    How many pairs of the sample chose each candidate (``counts``), at times spread over the run (``steps``, of environments).

    When there are too many times, every second one is dropped, and from then on half as many are added.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.counts: list[np.ndarray] = []
        self._every = 1
        self._n_offered = 0

    def note(self, step: int, choices: np.ndarray) -> None:
        """Add a time, in environment steps, unless it is left out; ``choices``: each pair's candidate, -1 for none, int64."""
        if self.steps and self.steps[-1] == step:
            return
        if self._n_offered % self._every == 0:
            self.steps.append(step)
            self.counts.append(np.bincount(choices[choices >= 0]).astype(np.int32))
        self._n_offered += 1
        if len(self.steps) >= MAX_COLUMNS:
            self.steps, self.counts = self.steps[::2], self.counts[::2]
            self._every *= 2

    def table(self) -> np.ndarray:
        """Return the counts as one array, shape (largest number of a candidate that was ever chosen + 1, n_times)."""
        table = np.zeros((max(map(len, self.counts), default=0), len(self.counts)), dtype=np.int64)
        for column, counts in enumerate(self.counts):
            table[: len(counts), column] = counts
        return table
