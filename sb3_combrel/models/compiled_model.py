"""What models in compiled loops have in common: plain tuples made once, predictions in place, and transferred instances."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from sb3_combrel.common.instances import Instances
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import InstanceTransfer, Model, ModelSettings, Predictions
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.q_values import Prediction

# Own weight must have changed by this fraction of the threshold before the row of a pair that has transferred instances is
# updated within an episode: an instance that hardly counts among them would have hundreds of pairs translated and planned.
MIN_CHANGE = 0.5


class CompiledModel(Model):
    """
    A model whose loops are compiled. Plain tuples for them are made once, not at every step (see ``common.compiled``).

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    _prediction: Prediction

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        self._nothing = TransferredInstances.empty(1, self.grid.n_variables)

    @property
    def _giver(self) -> InstanceTransfer | None:
        """Where instances come from for pairs that are not known; a transfer method that is a prior gives none."""
        transfer = self.transfer
        return None if transfer is None or (self.takes_prior and transfer.use == "prior") else transfer

    @abstractmethod
    def _predict_own(self, state: np.ndarray) -> float:
        """Fill the prediction from the own instances; the least weight that an action has."""

    def _make_prediction(self, room: int) -> None:
        self._prediction = Prediction.empty(self.n_actions, room, self.grid.n_variables)
        self._plain_prediction = tuple(self._prediction)

    @property
    def instances(self) -> Instances:
        """The instances, by action."""
        return self._instances

    @instances.setter
    def instances(self, instances: Instances) -> None:
        self._instances, self._plain_instances = instances, tuple(instances)

    def _transferred_to(self, pairs: np.ndarray) -> TransferredInstances:
        """Transferred instances for pairs; known ones need none."""
        if self._giver is None or self.known[pairs].all():
            if len(self._nothing.length) < len(pairs):
                self._nothing = TransferredInstances.empty(2 * len(pairs), self.grid.n_variables)
            return self._nothing
        actions, points = np.divmod(pairs, self.grid.n_points)
        # Of a known pair the full threshold, so that no method has work with it; it may have been lowered.
        full = self.settings.exploration_threshold
        own_weight = np.where(self.known[pairs], np.maximum(full, self.own_weight[pairs]), self.own_weight[pairs])
        given = self._giver.transferred_to_sample(points, actions, own_weight)
        self._check(given, own_weight)
        return given

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        rows = []
        for state, action in zip(states, actions, strict=True):
            self._predict_own(np.ascontiguousarray(state, dtype=np.float64))
            rows.append([array[action].copy() for array in self._prediction])
        _, weight, reward, length, probability, effect = map(np.array, zip(*rows, strict=True))
        used = np.arange(probability.shape[1]) < length[:, None]
        return Predictions(weight, reward, np.where(used, probability, 0.0), np.where(used[:, :, None], effect, 0.0))
