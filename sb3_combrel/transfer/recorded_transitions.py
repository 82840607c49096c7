"""Transitions of the target task that a transfer method has recorded."""

from __future__ import annotations

import numpy as np

_COLUMNS = ("states", "effects", "rewards", "actions", "ended")  # the arrays, which grow together


class RecordedTransitions:
    """Transitions of the target task in growing arrays, in the order in which they were observed (unit coordinates)."""

    #: How the episode went on after a transition, see :attr:`ended`.
    GOES_ON, TERMINATED, TIME_LIMIT = 0, 1, 2

    def __init__(self, n_variables: int):
        self.n = 0
        self.states, self.effects, self.rewards = np.empty((64, n_variables)), np.empty((64, n_variables)), np.empty(64)
        self.actions, self.ended = np.empty(64, dtype=np.int64), np.empty(64, dtype=np.int64)

    def add(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool = False) -> int:
        """Record one transition; ``effect``: next state minus state; return its number."""
        if self.n == len(self.rewards):
            for name in _COLUMNS:
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        i = self.n
        self.states[i], self.effects[i] = state, effect
        self.rewards[i], self.actions[i] = reward, action
        self.ended[i] = self.TERMINATED if terminated else self.GOES_ON
        self.n += 1
        return i

    def note_time_limit(self) -> None:
        """Take in that the episode of the last transition reached its time limit; nothing if there is none."""
        if self.n:
            self.ended[self.n - 1] = self.TIME_LIMIT

    def rows(self) -> np.ndarray:
        """Return all of them, one a row: state, effect, reward, action, ended; shape (n, 2 * n_variables + 3)."""
        return np.column_stack([getattr(self, name)[: self.n] for name in _COLUMNS])

    def restore(self, rows: np.ndarray, n_actions: int) -> None:
        """Record what :meth:`rows` returned once more, in a new object, whatever a file says with target actions alone."""
        d = self.states.shape[1]
        for row in rows:
            self.add(row[:d], int(np.clip(row[2 * d + 1], 0, n_actions - 1)), float(row[2 * d]), row[d : 2 * d])
        self.ended[: self.n] = rows[:, -1]
