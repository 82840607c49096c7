"""Whether the target's own transitions contradict the transferred instances that the agent acted on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.outcome_evidence import TRANSITIONS_BEFORE_WARNING, OutcomeEvidence, warn_of_error

# The error is a mean in which the last so many transitions have most of the weight.
WINDOW = 200
# So much must be new since the kernel was last narrowed: transitions that were compared, ends predicted that did not come.
MIN_COMPARED, MIN_CONTRADICTIONS = 20, 3
# So many episodes that ran into their time limit without a single transferred instance tried, and none that ended in between.
EPISODES_IN_VAIN = 3
# Predictions that wait for their transition, at most: of many environments at once, or of actions never carried out.
MAX_PENDING = 1024


class InstancesCheck:
    """Compares what transferred instances predict, their mean by weight, with what the target then does.

    After an episode that ran into its time limit they are contradicted if, since they last were,

    - at least ``MIN_COMPARED`` transitions were compared, and the error of the effects is larger than that of "no change"; or
    - the ends that they predict did not come on at least ``MIN_CONTRADICTIONS`` visits (see :class:`OutcomeEvidence`), and
      never one has come where it was predicted: right dynamics with a wrong goal; or
    - nothing can be found out any more: ``EPISODES_IN_VAIN`` episodes, and none that ended by itself in between, ran into
      their time limit without one step on transferred instances, and all rewards are alike and not above 0.

    Wrong rewards do not count: the target's own transitions correct them where the agent goes.
    """

    def __init__(self, sources: Sequence[SourceInstances]):
        self.evidence = OutcomeEvidence(np.concatenate([source.rewards for source in sources]))
        self.n_compared = 0
        self._sources = sources
        # Squared errors, and squared effects.
        self._sums = np.zeros(2)
        # Transitions compared and ends contradicted, as far as they have narrowed the kernel.
        self._used_up = 0, 0
        self._in_vain = 0
        # Transitions compared before the present episode.
        self._n_before = 0
        self._warned = False
        self._pending: dict[bytes, TransferredInstances] = {}

    def note_use(self, state: np.ndarray, given: TransferredInstances, n_actions: int) -> None:
        """Keep what is transferred to a state, for each action, until the transition from it is observed."""
        if len(self._pending) >= MAX_PENDING:
            del self._pending[next(iter(self._pending))]
        self._pending[state.tobytes()] = TransferredInstances(*(array[:n_actions].copy() for array in given))

    def observe(
        self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool
    ) -> np.ndarray | None:
        """Compare a transition with what was transferred to its state and action; the predicted effect, None if nothing."""
        given = self._pending.pop(state.tobytes(), None)
        if given is None or given.length[action] == 0:
            # A visit to where an end was predicted may be over.
            self.evidence.note(None, reward, terminated)
            return None
        n = given.length[action]
        weight = given.weight[action, :n] / given.weight[action, :n].sum()
        predicted: np.ndarray = weight @ given.effect[action, :n]
        error = effect - predicted
        self._sums *= 1.0 - 1.0 / WINDOW
        self._sums += error @ error, effect @ effect
        self.n_compared += 1
        end, predicted_reward = float(weight @ given.terminated[action, :n]), float(weight @ given.reward[action, :n])
        self.evidence.note((end, predicted_reward), reward, terminated)
        return predicted

    def break_off(self) -> None:
        """Forget what was going on."""
        self._pending.clear()
        self.evidence.break_off()

    def end_episode(self, truncated: bool) -> bool:
        """Take in the end of an episode; return whether what was transferred has been contradicted, see the class."""
        self.evidence.end_episode(truncated)
        if not self._warned and self.n_compared >= TRANSITIONS_BEFORE_WARNING and self.error() > 1.0:
            self._warned = True
            warn_of_error(self._sources, WINDOW, self.error())
        self._in_vain = self._in_vain + (self.n_compared == self._n_before) if truncated else 0
        self._n_before = self.n_compared
        if not (truncated and self._contradicted()):
            return False
        self._used_up = self.n_compared, self.evidence.contradicted
        return True

    def _contradicted(self) -> bool:
        compared, contradicted = self._used_up
        wrong_effects = self.n_compared - compared >= MIN_COMPARED and self.error() > 1.0
        new_contradictions = self.evidence.contradicted - contradicted
        wrong_ends = self.evidence.confirmed == 0 and new_contradictions >= MIN_CONTRADICTIONS
        low, high = self.evidence.reward_range
        return wrong_effects or wrong_ends or (self._in_vain >= EPISODES_IN_VAIN and high <= min(0.0, low + 1e-9))

    def error(self) -> float:
        """Return the mean squared error over that of "no change", mostly of the last ``WINDOW``; NaN if nothing moved."""
        wrong, baseline = self._sums.tolist()
        return wrong / baseline if baseline > 0.0 else np.nan

    def get_state(self) -> np.ndarray:
        """What was found so far, but for the visits that go on, float64, shape (15,)."""
        figures = *self._sums, self.n_compared, *self._used_up, self._in_vain, self._n_before, self._warned
        return np.concatenate([np.array(figures, dtype=np.float64), self.evidence.get_state()])

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        self._sums = np.array(state[:2])
        self.n_compared, compared, contradicted, self._in_vain, self._n_before = (int(value) for value in state[2:7])
        self._used_up, self._warned = (compared, contradicted), bool(state[7] > 0.5)
        self.evidence.set_state(state[8:])
