"""Selectors: which mapping's instances are translated for which state and action."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

Ranges = tuple[np.ndarray, np.ndarray]


def ranges_of(chosen: np.ndarray) -> Ranges:
    """Return the ranges that hold one candidate each; empty ones for -1."""
    return np.maximum(chosen, 0), chosen + 1


class Selector(ABC):
    """Selects, for states and actions, the range of candidates whose instances are translated."""

    #: Whether :meth:`choices` ever names a candidate.
    makes_choices: ClassVar[bool] = False
    #: Whether the selection depends on recorded transitions.
    needs_transitions: ClassVar[bool] = False
    #: Whether a range is of one candidate at most.
    selects_one: ClassVar[bool] = True
    #: So many transitions are recorded, at most.
    max_transitions: float = np.inf

    def __init__(self, candidates: Candidates):
        self.candidates = candidates
        self.task = candidates.task
        self.first = candidates.arrays.first
        self.transitions = RecordedTransitions(self.task.n_variables)

    @abstractmethod
    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        """Select candidates, the first and one past the last (equal: none), int64, shape (n,), without leaving a trace."""

    def select_at_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        """Select candidates for states of the finite sample, given by their numbers; called for learning only."""
        return self.select(self.task.sample_states[points], actions, own_weight)

    def before_transition(self) -> None:  # noqa: B027 - most have nothing to do
        """Prepare for another transition of the target, whether it is recorded or not."""

    def takes_transitions(self) -> bool:
        """Return whether another transition is to be recorded."""
        return self.transitions.n < self.max_transitions

    def add_transition(self, i: int) -> None:  # noqa: B027 - most ignore it
        """Take in that transition ``i`` was recorded."""

    def n_used(self) -> int:
        """Return how many of the recorded transitions are used; the first so many."""
        return self.transitions.n

    def end_episode(self) -> bool:
        """Take in the end of an episode; return whether transitions recorded before are used from now on."""
        return False

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        """Say for which states of the sample the selection differs from the last one (see ``Transfer.changed``)."""
        return False

    def choices(self) -> np.ndarray:
        """Return the candidate of each pair of the sample, int64, shape (n_actions * n_points,); -1: not a single one."""
        return np.full(self.task.n_actions * len(self.task.sample_states), -1, dtype=np.int64)

    def confidence(self, action: int) -> dict[str, Any]:
        """Return the compliances of ``MappingReport`` for a target action; none where nothing is chosen by compliance."""
        return {}

    def get_state(self) -> dict[str, np.ndarray]:
        """Return what is to be saved besides the transitions."""
        return {}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`get_state` returned; called after the transitions have been recorded again."""
        for i in range(self.transitions.n):
            self.add_transition(i)

    def sample_moved(self) -> None:  # noqa: B027 - most choose the same in all states, or at random
        """Choose anew, after :meth:`set_state`, for a sample of other states."""

    def statistics(self) -> dict[str, float]:
        """Return figures for the logger, by name."""
        return {}


class FixedSelector(Selector):
    """Selects one candidate for each target action, ``fixed``, the same in every state; -1 for none."""

    makes_choices = True

    def __init__(self, candidates: Candidates, fixed: np.ndarray):
        super().__init__(candidates)
        self.fixed = fixed

    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        return ranges_of(self.fixed[actions])

    def choices(self) -> np.ndarray:
        return np.repeat(self.fixed, len(self.task.sample_states))


class RandomSelector(Selector):
    """Selects at random: whenever a state of the sample is asked for; elsewhere one an action until the next transition."""

    def __init__(self, candidates: Candidates, rng: np.random.Generator):
        super().__init__(candidates)
        self.rng = rng
        self.before_transition()

    def before_transition(self) -> None:
        self._drawn = self._draw(np.arange(self.task.n_actions))

    def _draw(self, actions: np.ndarray) -> np.ndarray:
        return self.rng.integers(self.first[actions], self.first[actions + 1])

    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        return ranges_of(self._drawn[actions])

    def get_state(self) -> dict[str, np.ndarray]:
        return {"drawn": self._drawn.astype(np.float64)}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._drawn = np.clip(state["drawn"].astype(np.int64), self.first[:-1], self.first[1:] - 1)

    def select_at_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        return ranges_of(self._draw(actions))


class PooledSelector(Selector):
    """Selects all candidates of an action: the instances come from one pool of all translations (Figure 3)."""

    selects_one = False

    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        return self.first[actions], self.first[actions + 1]
