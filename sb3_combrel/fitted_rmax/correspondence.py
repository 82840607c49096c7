"""Unit coordinates in which tasks correspond, beside those in which a learner fits and plans."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances, check_prior, check_transferred
from sb3_combrel.transfer.base import Transfer


class Correspondence:
    """From the unit coordinates of a learner to those in which its task corresponds to others, and back.

    What a variable of the source means in the target is said by the bounds of both; how finely it is to be modelled, by the
    range in which it is observed (:class:`~sb3_combrel.fitted_rmax.scales.FoundScales`).

    :param scaling: of the learner; ``bounds``: by which tasks correspond
    """

    def __init__(self, scaling: StateScaling, bounds: StateScaling):
        #: Whether they are the same coordinates: then nothing is computed.
        self.same = scaling == bounds
        given = bounds.high - bounds.low
        self._factor, self._offset = (scaling.high - scaling.low) / given, (scaling.low - bounds.low) / given

    def states(self, states: np.ndarray) -> np.ndarray:
        """States of the learner as a transfer method sees them, shape (..., n_variables)."""
        return states if self.same else np.asarray(states * self._factor + self._offset)

    def effects(self, effects: np.ndarray) -> np.ndarray:
        """Effects of the learner as a transfer method sees them, shape (..., n_variables)."""
        return effects if self.same else np.asarray(effects * self._factor)

    def effects_of_learner(self, effects: np.ndarray) -> np.ndarray:
        """The other way around."""
        return effects if self.same else np.asarray(effects / self._factor)


class OfLearner:
    """What is transferred, checked, in the unit coordinates of the learner: see ``models.base.InstanceTransfer``."""

    def __init__(self, transfer: Transfer, correspondence: Correspondence):
        self._transfer, self._correspondence = transfer, correspondence
        self.use = transfer.use

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        given = self._transfer.prior(self._correspondence.states(states), actions)
        check_prior(given, self._transfer, *states.shape)
        return given._replace(effect=self._correspondence.effects_of_learner(given.effect))

    def prior_version(self) -> int:
        return self._transfer.prior_version()

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        return self._scaled(self._transfer.transferred(self._correspondence.states(states), actions, own_weight), own_weight)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        return self._scaled(self._transfer.transferred_to_sample(points, actions, own_weight), own_weight)

    def _scaled(self, given: TransferredInstances, own_weight: np.ndarray) -> TransferredInstances:
        task = self._transfer.task
        assert task is not None
        check_transferred(given, self._transfer, own_weight, len(task.scaling.low), task.exploration_threshold)
        return given._replace(effect=self._correspondence.effects_of_learner(given.effect))

    def note_use(self, given: TransferredInstances) -> None:
        self._transfer.note_use(given._replace(effect=self._correspondence.effects(given.effect)))


class NoTransfer(Transfer):
    """What an agent without a transfer method speaks to: it hears everything, and knows nothing."""

    use = "actions"

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        pass
