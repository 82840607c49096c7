"""Transitions of the target task that a transfer method has recorded."""

from __future__ import annotations

import numpy as np

_COLUMNS = ("states", "effects", "rewards", "actions", "ended")  # the arrays, which grow together


class RecordedTransitions:
    """Transitions of the target task in growing arrays, in the order in which they were observed (unit coordinates)."""

    def __init__(self, n_variables: int):
        self.n = 0
        self.states, self.effects, self.rewards = np.empty((64, n_variables)), np.empty((64, n_variables)), np.empty(64)
        self.actions, self.ended = np.empty(64, dtype=np.int64), np.empty(64, dtype=np.bool_)

    def add(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool = False) -> int:
        """Record one transition; ``effect``: next state minus state; return its number."""
        if self.n == len(self.rewards):
            for name in _COLUMNS:
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        i = self.n
        self.states[i], self.effects[i] = state, effect
        self.rewards[i], self.actions[i] = reward, action
        self.ended[i] = terminated
        self.n += 1
        return i

    def rows(self) -> np.ndarray:
        """Return all of them, one a row: state, effect, reward, action, ended; shape (n, 2 * n_variables + 3)."""
        return np.column_stack([getattr(self, name)[: self.n] for name in _COLUMNS])

    def restore(self, rows: np.ndarray, n_actions: int) -> None:
        """Record what :meth:`rows` returned once more, in a new object, whatever a file says with target actions alone."""
        d = self.states.shape[1]
        for row in rows:
            effect, reward, action = row[d : 2 * d], float(row[2 * d]), int(np.clip(row[2 * d + 1], 0, n_actions - 1))
            # A file of an older version has 2 for a time limit.
            self.add(row[:d], action, reward, effect, bool(row[-1] == 1.0))
