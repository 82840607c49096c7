"""What models in compiled loops have in common: plain tuples made once, predictions in place, and transferred instances."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from sb3_combrel.common.compiled import inlined
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import InstanceTransfer, Model, ModelSettings, Predictions
from sb3_combrel.planning.mdp import FiniteMDP, add_successor
from sb3_combrel.planning.q_values import Prediction

# Within an episode the row of a pair that has transferred instances is updated once its own weight has changed by this
# fraction of the threshold.
MIN_CHANGE = 0.5


@inlined
def total_weight(own, transferred, row):
    """Weight of a pair's own instances and of those transferred to it; ``row``: of the pair in ``transferred``."""
    for j in range(transferred.length[row]):
        own += transferred.weight[row, j]
    return own


@inlined
def add_to_prediction(prediction, action, transferred, total):
    """Add transferred instances, one row an action, to what is predicted of an action; ``total``: weight of all instances."""
    n, reward = prediction.length[action], prediction.reward[action]
    for j in range(transferred.length[action]):
        p = transferred.weight[action, j] / total
        reward += p * transferred.reward[action, j]
        if not transferred.terminated[action, j]:
            prediction.probability[action, n] = p
            for v in range(prediction.effect.shape[2]):
                prediction.effect[action, n, v] = transferred.effect[action, j, v]
            n += 1
    prediction.reward[action] = reward
    prediction.length[action] = n
    prediction.modelled[action] = True


@inlined
def add_to_row(reward, n_touched, transferred, row, total, scratch, grid):
    """Add transferred instances to the row of a pair; its reward, and see ``planning.mdp.add_successor``."""
    for j in range(transferred.length[row]):
        p = transferred.weight[row, j] / total
        reward += p * transferred.reward[row, j]
        if not transferred.terminated[row, j]:
            n_touched = add_successor(p, transferred.effect[row, j], scratch, grid, n_touched)
    return reward, n_touched


class CompiledModel(Model):
    """A model whose loops are compiled. Plain tuples for them are made once, not at every step (see ``common.compiled``)."""

    #: Successors of an action that the own instances may predict.
    _own_room: int
    _prediction: Prediction

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        #: Own weight of each pair when its row was last updated.
        self.last_weight = np.zeros(len(self.known))
        self._nothing = TransferredInstances.empty(1, self.grid.n_variables)

    @property
    def _giver(self) -> InstanceTransfer | None:
        """Where instances come from for pairs that are not known; a transfer method that is a prior gives none."""
        transfer = self.transfer
        return None if transfer is None or (self.takes_prior and transfer.use == "prior") else transfer

    @abstractmethod
    def _predict_own(self, state: np.ndarray) -> float:
        """Fill the prediction from the own instances; the least weight that an action has."""

    @abstractmethod
    def _join_transferred(self, given: TransferredInstances) -> None:
        """Let transferred instances join the prediction of the actions whose own instances do not suffice."""

    @abstractmethod
    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        """Write rows of (pairs, how many of them are done); how many are done then, fewer than all if there is no room."""

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

    def update_rows(self, pairs: np.ndarray) -> None:
        transferred = tuple(self._transferred_to(pairs))
        done = 0
        while done < len(pairs):
            done = self._write_rows((pairs, done), transferred)
            if done < len(pairs):
                self.mdp.make_room()

    def outdated(self) -> np.ndarray:
        return np.flatnonzero(~self.known & (self.own_weight != self.last_weight))

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

    def predict_at(self, state: np.ndarray) -> tuple[Prediction, TransferredInstances | None]:
        if self._predict_own(state) >= self.exploration_threshold or self._giver is None:
            return self._prediction, None
        states = np.repeat(state[None], self.n_actions, axis=0)
        given = self._giver.transferred(states, np.arange(self.n_actions), self._prediction.weight)
        self._check(given, self._prediction.weight)
        room = self._own_room + given.weight.shape[1]
        if room > self._prediction.probability.shape[1]:
            self._make_prediction(room)
            self._predict_own(state)
        self._join_transferred(given)
        return self._prediction, given

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        rows = []
        for state, action in zip(states, actions, strict=True):
            self._predict_own(np.ascontiguousarray(state, dtype=np.float64))
            rows.append([array[action].copy() for array in self._prediction])
        _, weight, reward, length, probability, effect = map(np.array, zip(*rows, strict=True))
        used = np.arange(probability.shape[1]) < length[:, None]
        return Predictions(weight, reward, np.where(used, probability, 0.0), np.where(used[:, :, None], effect, 0.0))
