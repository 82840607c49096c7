"""What a source, as the prior of the target's model, claims to know: its predictions, as far as the target bears them out."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.borne_out import GOES_ON, Outcomes
from sb3_combrel.transfer.recorded_transitions import RecordedEpisodes

# What is predicted through, and what is claimed, is renewed first after so many transitions of the target, and whenever this
# many times as much has been observed as at the last time.
FIRST_RENEWAL = 10
RENEWAL_GROWTH = 2**0.5
# Transitions of a target action from which on effects that a source does not explain are no longer used.
MIN_TRANSITIONS = 10
# What a source explains is counted as if there were so many transitions besides, none of them explained. (Of a mapping that is
# given, all of them explained instead, so that it is trusted from the first step on: the mirrored car then takes 4 % fewer
# steps, Mountain Car 4D and a cart with a pendulum take 4 and 25 % more.)
PRESUMED = 3.0
# Trust is no less than this, or 0: of an action with three transitions so much may be missing that a source which is nearly
# exact is not doubted again for a fourth that it misses by a little; two are not enough.
LEAST_TRUST = 0.4
# The source's data count as so many times their weight. A source that has seen but one transition nearby is more than the
# target has there; to demand of it what makes the target's own instances suffice leaves much of it unused (mirrored car, the
# mapping trusted from the first step on: it saves 1 % with 1, 10 % with 10; instances, of which any counts, 8 %).
CLAIMED_WEIGHT = 10.0
# How much must be explained of a variable's effects, of those that were seen; less is not clearly better than "nothing
# changes". With 0.25 for the mean that is fitted to, a Mountain Car as the source cost the iCub's arm 18 to 87 % more steps
# (two times ten seeds); with 0.5 it costs 3 to 5 %, and sources that are right are not affected.
MIN_EXPLAINED = 0.5
# So many times the threshold the source's data must weigh for an end that they do not predict to contradict them. With 1, the
# exact source of the mirrored car was doubted in three of four runs that were looked at, in one of them for good: by ends with
# an action that the source had hardly taken there (weights of 0.9 to 1.9; where it had, 4 to 8).
NO_END_WEIGHT = 3.0
# Trust is in steps of this: with every change all pairs are predicted anew.
TRUST_STEP = 0.1


def part_explained(missed: np.ndarray, founded: np.ndarray) -> np.ndarray:
    """
    Return which part of the effects is explained, for each target action, of the variable of which least is.

    :param missed: what is not explained of the target's transitions, as a number of them, shape (n_target_actions,
        n_target_variables); ``founded``: of how many, same shape
    :return: shape (n_target_actions,); 1 for an exact source and many transitions, 0 or less for one that is no better than
        "nothing changes"
    """
    return np.asarray(((founded - missed) / (founded + PRESUMED)).min(axis=1))


def trust_in(missed: np.ndarray, founded: np.ndarray) -> np.ndarray:
    """
    Return how far a source is trusted: as far as it explains the target's effects, in steps, or not at all.

    Not at all if it explains less than ``MIN_EXPLAINED`` of what has been seen of a variable, or if so little has been seen
    that less than ``LEAST_TRUST`` would be left.

    :param missed: as in :func:`part_explained`; ``founded``: same
    :return: from 0 to 1, shape (n_target_actions,)
    """
    explained = part_explained(missed, founded)
    believed = (missed <= (1.0 - MIN_EXPLAINED) * founded).all(axis=1) & (explained >= LEAST_TRUST)
    return np.where(believed, np.floor(explained / TRUST_STEP + 1e-9) * TRUST_STEP, 0.0)


class Claims:
    """
    What a prior claims to know without instances of the target, and which of its effects are used.

    The weight of a prediction is ``CLAIMED_WEIGHT`` times that of the source's data there, times the trust in the source for
    the target action: which part of the effects of the target's own transitions with it the source explains (see
    :func:`part_explained`), of the variable of which it explains least (a sum over variables would hide a wrong action, which
    shows in velocities alone). No trust below ``MIN_EXPLAINED``. Nothing is claimed any more while the source's ends or
    rewards are doubted (see :class:`~sb3_combrel.transfer.borne_out.Outcomes`), and no transition that may end unless
    predicted ends have been seen to come. A probability of termination below ``GOES_ON`` is none: that of an average of
    instances some of which are far away.

    Effects are the mean that the target's own instances are fitted to wherever nothing is claimed, too: all but those on
    variables of which the source turns out to explain less than ``MIN_EXPLAINED`` under the action; these are 0.

    :param rewards: of the sources' instances
    :param task: the target task
    :param transfer_terminals: whether the source's ends are used at all
    """

    def __init__(self, rewards: np.ndarray, task: TargetTask, transfer_terminals: bool):
        self.transfer_terminals = transfer_terminals
        #: What confirms and what contradicts the ends and rewards that the source predicts.
        threshold = float(task.exploration_threshold)
        self.outcomes = Outcomes(rewards, threshold, no_end=NO_END_WEIGHT * threshold)
        #: By target action.
        self.trust = np.zeros(task.n_actions)
        #: Whether the source's effects on each variable are used, by target action.
        self.explains = np.ones((task.n_actions, task.n_variables), dtype=np.bool_)
        self._noted = self._believed()

    def _believed(self) -> tuple[bool, bool]:
        return self.outcomes.doubted, self._ends_believed

    @property
    def _ends_believed(self) -> bool:
        return self.transfer_terminals and self.outcomes.ends_believed

    def renew(self, missed: np.ndarray, founded: np.ndarray, predicted: np.ndarray | bool = True) -> bool:
        """
        Renew :attr:`trust` and :attr:`explains`; return whether either has changed.

        :param missed: as in :func:`part_explained`; ``founded``: same
        :param predicted: which effects the source says anything of, bool, same shape; True: all
        """
        trust = trust_in(missed, founded)
        explains = (founded < MIN_TRANSITIONS) | (missed <= (1.0 - MIN_EXPLAINED) * founded) | ~np.asarray(predicted)
        changed = not (np.array_equal(trust, self.trust) and np.array_equal(explains, self.explains))
        self.trust, self.explains = trust, explains
        return changed

    def allow_bound(self) -> bool:
        """Return whether the source's values may bound the target's: all actions explained, ends and rewards not doubted."""
        return self.transfer_terminals and bool(self.trust.all()) and not self.outcomes.doubted

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
        weight = CLAIMED_WEIGHT * coverage * self.trust[actions]
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
        return PriorPredictions(effect, reward, np.where(end < GOES_ON, 0.0, end), self.weight(end, coverage, actions))

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
