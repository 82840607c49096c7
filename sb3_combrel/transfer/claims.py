"""What a source, as the prior of the target's model, claims to know: its predictions, as far as the target bears them out."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.prior import PriorPredictions
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.borne_out import GOES_ON, Outcomes
from sb3_combrel.transfer.recorded_transitions import RecordedEpisodes

# What is predicted through, and what is claimed, is renewed first after so many transitions of the target, and whenever this
# many times as much has been observed as at the last time.
FIRST_RENEWAL = 10
RENEWAL_GROWTH = 2**0.5
# Transitions of a target action from which on a source is believed about it.
MIN_TRANSITIONS = 10
# How much of a variable's effects must be explained; less is not clearly better than "nothing changes". With 0.25 for the
# mean that is fitted to, a Mountain Car as the source cost the iCub's arm 18 to 87 % more steps (two times ten seeds); with
# 0.5 it costs 3 to 5 %, and sources that are right are not affected.
MIN_EXPLAINED = 0.5
# Trust is in steps of this: with every change all pairs are predicted anew.
TRUST_STEP = 0.1


def trust_in(explained: np.ndarray) -> np.ndarray:
    """
    Return how far a source is trusted that explains so much of the target's effects: as much, in steps, or not at all.

    :param explained: part of the effects, of the variable of which least is explained, shape (n_target_actions,)
    :return: from 0 to 1, same shape
    """
    return np.where(explained >= MIN_EXPLAINED, np.floor(explained / TRUST_STEP + 1e-9) * TRUST_STEP, 0.0)


class Claims:
    """
    What a prior claims to know without instances of the target, and which of its effects are used.

    The weight of a prediction is that of the source's data there, times the trust in the source for the target action: which
    part of the effects of the target's own transitions with it the source explains, of the variable of which it explains
    least (a sum over variables would hide a wrong action, which shows in velocities alone). No trust below
    ``MIN_EXPLAINED``, or before ``MIN_TRANSITIONS`` of the action. Nothing is claimed any more while the source's ends or
    rewards are doubted (see :class:`~sb3_combrel.transfer.borne_out.Outcomes`), and no transition that may end before an end
    has been confirmed.

    Effects are the mean that the target's own instances are fitted to wherever nothing is claimed, too: all but those on
    variables of which the source turns out to explain less than ``MIN_EXPLAINED`` under the action; these are 0.

    :param rewards: of the sources' instances
    :param task: the target task
    :param transfer_terminals: whether the source's ends are used at all
    """

    def __init__(self, rewards: np.ndarray, task: TargetTask, transfer_terminals: bool):
        self.transfer_terminals = transfer_terminals
        #: What confirms and what contradicts the ends and rewards that the source predicts.
        self.outcomes = Outcomes(rewards, float(task.exploration_threshold))
        #: By target action.
        self.trust = np.zeros(task.n_actions)
        #: Whether the source's effects on each variable are used, by target action.
        self.explains = np.ones((task.n_actions, task.n_variables), dtype=np.bool_)
        self._noted = self._believed()

    def _believed(self) -> tuple[bool, bool]:
        return self.outcomes.doubted, self._ends_believed

    @property
    def _ends_believed(self) -> bool:
        return self.transfer_terminals and self.outcomes.confirmed > 0

    def renew(self, trust: np.ndarray, explains: np.ndarray) -> bool:
        """Set :attr:`trust` and :attr:`explains`; return whether either has changed."""
        changed = not (np.array_equal(trust, self.trust) and np.array_equal(explains, self.explains))
        self.trust, self.explains = trust, explains
        return changed

    def have_changed(self) -> bool:
        """Return whether ends and rewards are doubted, or ends believed, that were not, or no longer, since last asked."""
        before, self._noted = self._noted, self._believed()
        return self._noted != before

    def weight(self, end: np.ndarray, coverage: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        Return the weight that is claimed for predictions.

        :param end: probability of termination that is predicted, shape (n,)
        :param coverage: weight of the source's data, same shape
        :param actions: target actions, int64, same shape
        """
        if self.outcomes.doubted:
            return np.zeros(len(actions))
        weight = coverage * self.trust[actions]
        if not self._ends_believed:
            weight[end >= GOES_ON] = 0.0
        return weight

    def applied(
        self, effect: np.ndarray, reward: np.ndarray, end: np.ndarray, coverage: np.ndarray, actions: np.ndarray
    ) -> PriorPredictions:
        """
        Return what is predicted and claimed, given what the source predicts.

        :param effect: shape (n, n_target_variables); it may be overwritten
        :param reward: raw, shape (n,); ``end``, ``coverage`` and ``actions``: see :meth:`weight`
        """
        if not self.explains.all():
            effect *= self.explains[actions]
        return PriorPredictions(effect, reward, end, self.weight(end, coverage, actions))

    def replay(self, seen: RecordedEpisodes, reward: np.ndarray, end: np.ndarray, weight: np.ndarray) -> None:
        """
        Count anew what confirms and contradicts the ends and rewards that are predicted now.

        :param seen: the target's recorded transitions
        :param reward: predicted of each; ``end`` and ``weight``: probability of termination, and weight of the source's data
        """
        self.outcomes.forget()
        for i, ended in enumerate(seen.ended[: seen.n].tolist()):
            self.outcomes.note(
                float(weight[i]), float(end[i]), float(reward[i]), float(seen.rewards[i]), ended == seen.TERMINATED
            )
            if ended:
                self.outcomes.end_episode(ended == seen.TIME_LIMIT)

    def get_state(self, prefix: str) -> dict[str, np.ndarray]:
        """Return what was learned, float64 arrays, under names that begin with ``prefix``."""
        return {
            f"{prefix}trust": self.trust.copy(),
            f"{prefix}explains": self.explains.ravel().astype(np.float64),
            f"{prefix}outcomes": self.outcomes.get_state(),
        }

    def set_state(self, state: dict[str, np.ndarray], prefix: str) -> None:
        """Take over what :meth:`get_state` returned."""
        self.trust = state[f"{prefix}trust"].copy()
        self.explains = state[f"{prefix}explains"].reshape(self.explains.shape) > 0.5
        self.outcomes.set_state(state[f"{prefix}outcomes"])
        self._noted = self._believed()
