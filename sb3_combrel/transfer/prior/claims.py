"""What a source, as the prior of the target's model, claims to know: its predictions, as far as the target bears them out."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.outcome_evidence import GOES_ON, OutcomeEvidence
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

# What is predicted through, and what is claimed, is renewed first after so many transitions of the target, and whenever this
# many times as much has been observed as at the last time.
FIRST_RENEWAL = 10
RENEWAL_GROWTH = 2**0.5
# Transitions of a target action from which on effects that a source does not explain are no longer used.
MIN_TRANSITIONS = 10
# What a source explains is counted as if there were so many transitions besides, none of them explained.
PRESUMED = 3.0
# Trust is no less than this, or 0: what one or two transitions seem to show is not trusted.
LEAST_TRUST = 0.4
# The source's data count as so many times their weight: one transition nearby is more than the target has there.
CLAIMED_WEIGHT = 10.0
# How much must be explained of a variable's effects, of those that were seen; less is not clearly better than "no change".
MIN_EXPLAINED = 0.5
# So many times the threshold the source's data must weigh for an end that they do not predict to contradict them: ends are
# averaged with a narrower kernel, and where data are few they may be those of another place.
NO_END_WEIGHT = 3.0
# Trust is in steps of this: with every change all pairs are predicted anew.
TRUST_STEP = 0.1


def part_explained(unexplained: np.ndarray, n_covered: np.ndarray) -> np.ndarray:
    """Return which part of the effects is explained, for each target action, of the variable of which least is.

    :param unexplained: how much is not explained of the target's transitions, as a number of them, shape (n_target_actions,
        n_target_variables); ``n_covered``: of how many, same shape
    :return: shape (n_target_actions,); at most 1, 0 or less for a source that is no better than "no change"
    """
    return np.asarray(((n_covered - unexplained) / (n_covered + PRESUMED)).min(axis=1))


def trust_in(unexplained: np.ndarray, n_covered: np.ndarray) -> np.ndarray:
    """Return how far a source is trusted, as far as it explains the target's effects: 0 to 1, shape (n_target_actions,).

    0 if it explains less than ``MIN_EXPLAINED`` of what was seen of a variable, or less than ``LEAST_TRUST`` would be left.
    """
    explained = part_explained(unexplained, n_covered)
    believed = (unexplained <= (1.0 - MIN_EXPLAINED) * n_covered).all(axis=1) & (explained >= LEAST_TRUST)
    return np.where(believed, np.floor(explained / TRUST_STEP + 1e-9) * TRUST_STEP, 0.0)


class Claims:
    """What a prior claims to know without instances of the target, and which of its effects are used.

    The weight of a prediction is ``CLAIMED_WEIGHT`` times that of the source's data there, times the trust in the source for
    the target action, see :func:`trust_in`. It is 0 while the source's ends or rewards are doubted (see ``OutcomeEvidence``),
    and of transitions that may end unless predicted ends have been seen to come.

    Effects are the mean that the target's own instances are fitted to where nothing is claimed, too. Only those on variables
    of which the source turns out to explain less than ``MIN_EXPLAINED`` under the action are 0.
    """

    def __init__(self, rewards: np.ndarray, task: TargetTask, transfer_terminals: bool):
        self.transfer_terminals = transfer_terminals
        threshold = float(task.exploration_threshold)
        #: What confirms and what contradicts the ends and rewards that the source predicts.
        self.evidence = OutcomeEvidence(rewards, threshold, no_end=NO_END_WEIGHT * threshold)
        #: By target action.
        self.trust = np.zeros(task.n_actions)
        #: Whether the source's effects on each variable are used, by target action.
        self.explains = np.ones((task.n_actions, task.n_variables), dtype=np.bool_)
        self._noted = self._believed()

    def _believed(self) -> tuple[bool, bool]:
        """Whether ends and rewards are doubted, and whether ends are believed."""
        return self.evidence.doubted, self.transfer_terminals and self.evidence.ends_believed

    def renew(self, unexplained: np.ndarray, n_covered: np.ndarray, predicted: np.ndarray | bool = True) -> bool:
        """Renew trust and explains, see ``part_explained``; whether either changed. ``predicted``: which effects count."""
        trust = trust_in(unexplained, n_covered)
        explained = unexplained <= (1.0 - MIN_EXPLAINED) * n_covered
        explains = (n_covered < MIN_TRANSITIONS) | explained | ~np.asarray(predicted)
        changed = not (np.array_equal(trust, self.trust) and np.array_equal(explains, self.explains))
        self.trust, self.explains = trust, explains
        return changed

    def allow_bound(self) -> bool:
        """Return whether the source's values may bound the target's: all actions explained, ends and rewards not doubted."""
        return self.transfer_terminals and bool(self.trust.all()) and not self.evidence.doubted

    def have_changed(self) -> bool:
        """Return whether doubt about ends and rewards, or belief in ends, differs from when this was last asked."""
        before, self._noted = self._noted, self._believed()
        return self._noted != before

    def weight(self, end: np.ndarray, coverage: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the weight that is claimed; ``end``: predicted termination, ``coverage``: weight of the source's data."""
        doubted, ends_believed = self._believed()
        if doubted:
            return np.zeros(len(actions))
        weight = CLAIMED_WEIGHT * coverage * self.trust[actions]
        if not ends_believed:
            weight[end >= GOES_ON] = 0.0
        return weight

    def restrict(
        self, effect: np.ndarray, reward: np.ndarray, end: np.ndarray, coverage: np.ndarray, actions: np.ndarray
    ) -> PriorPredictions:
        """Restrict predictions, see :meth:`weight`, to what is explained and claimed; ``effect`` may be overwritten."""
        if not self.explains.all():
            effect *= self.explains[actions]
        return PriorPredictions(effect, reward, np.where(end < GOES_ON, 0.0, end), self.weight(end, coverage, actions))

    def replay(self, seen: RecordedTransitions, reward: np.ndarray, end: np.ndarray, weight: np.ndarray) -> None:
        """Count anew what confirms and contradicts the ends and rewards predicted now of transitions ``seen``."""
        self.evidence.forget()
        for i, ended in enumerate(seen.ended[: seen.n].tolist()):
            self.evidence.note(
                float(weight[i]), float(end[i]), float(reward[i]), float(seen.rewards[i]), ended == seen.TERMINATED
            )
            if ended:
                self.evidence.end_episode(ended == seen.TIME_LIMIT)

    def get_state(self, prefix: str) -> dict[str, np.ndarray]:
        """Return what was learned, float64 arrays, under names that begin with ``prefix``."""
        return {
            f"{prefix}trust": self.trust.copy(),
            f"{prefix}explains": self.explains.ravel().astype(np.float64),
            f"{prefix}outcomes": self.evidence.get_state(),
        }

    def set_state(self, state: dict[str, np.ndarray], prefix: str) -> None:
        """Take over what :meth:`get_state` returned."""
        self.trust = state[f"{prefix}trust"].copy()
        self.explains = state[f"{prefix}explains"].reshape(self.explains.shape) > 0.5
        self.evidence.set_state(state[f"{prefix}outcomes"])
        self._noted = self._believed()
