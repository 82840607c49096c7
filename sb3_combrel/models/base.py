"""What planner and agent ask of a model of the dynamics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from sb3_combrel.common.instances import Instances, put_instance_at
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.q_values import Prediction

NO_PAIRS = np.empty(0, dtype=np.int64)
# State, action, reward, next state, terminated.
Transition = tuple[np.ndarray, int, float, np.ndarray, bool]
MAX_PAIRS_AT_ONCE = 4096


@dataclass(frozen=True)
class ModelSettings:
    """The arguments of :class:`~sb3_combrel.FittedRMax` that a model needs; what they mean is said there."""

    model_breadth: float
    min_weight: float
    min_fraction: float
    exploration_threshold: float
    max_instances: int | None = None
    n_neighbors: int = 40
    outcome_breadth: float = 0.05
    #: Whether episodes end by where an action is taken, and not by where it leads (see ``models.ends_by_action``).
    ends_by_action: bool = False


class FitOfEffects(NamedTuple):
    """Local regressions of n pairs on the target's own instances alone. Unit coordinates, float64; NaN without any instance.

    The variance of a next transition's effect around the fitted one is at most ``variance * (1 + leverage)``.
    """

    slopes: np.ndarray  # (n, n_variables, n_variables): derivative by the first variable of the effect on the second
    # (n, n_variables): of one instance's effect around the fit; infinite where instances are too few to tell.
    variance: np.ndarray
    leverage: np.ndarray  # (n,): by how much it is multiplied for the fitted effect itself


class Predictions(NamedTuple):
    """What the target's own instances predict of n state-action pairs. Unit coordinates, float64."""

    weight: np.ndarray  # (n,): of the instances behind each prediction, which decides whether it is known
    reward: np.ndarray  # (n,): expected reward
    probability: np.ndarray  # (n, n_successors); what is missing to 1 ends the episode
    effect: np.ndarray  # (n, n_successors, n_variables): displacement to each successor
    # How sure a model is that fits effects as functions of the state; None for others.
    fit: FitOfEffects | None = None


class InstanceTransfer(Protocol):
    """What a model knows of a transfer method (see ``sb3_combrel.transfer.base.Transfer``); what it gives has been checked."""

    use: str  # "instances" or "prior": which of the other methods are called

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances: ...
    def transferred_to_sample(
        self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray
    ) -> TransferredInstances: ...
    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions: ...
    def prior_version(self) -> int: ...


class Model(ABC):
    """A model of the dynamics, kept up to date transition by transition. Everything is in unit coordinates.

    A subclass must say what its instances predict, :meth:`predict`, and nothing else: the other methods have defaults, which
    are slow, as they compute all pairs of an action anew with each of its transitions. A state-action pair is *known* when
    the weight of the target's own instances reaches the threshold. A pair that is not known can be modelled with transferred
    instances; if it is not, it is optimistic.

    :param mdp: the finite MDP over the sample of states, which the model writes
    :param transfer: where to get instances for pairs that are not known
    """

    #: Whether what a transfer method predicts may join the fits to the target's own instances (``use="prior"``).
    takes_prior: ClassVar[bool] = False
    #: Whether places are worth less with each visit as long as nothing has been found (see ``fitted_rmax.optimism``); grid
    #: points are known with less weight from then on (see ``constants.ON_GRID``).
    searches: ClassVar[bool] = False
    #: Whether the planner leaves points out on which no change bears that is larger than its tolerance.
    follows_changes: ClassVar[bool] = False
    #: Whether it has a second way to tell how episodes end, ``ModelSettings.ends_by_action``.
    asks_what_ends: ClassVar[bool] = False
    #: Whether all pairs of a finer grid are fitted within seconds: a frozen policy may then plan on one.
    plans_finer: ClassVar[bool] = False

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        self.mdp, self.grid, self.n_actions = mdp, mdp.grid, mdp.n_actions
        self.settings, self.transfer = settings, transfer
        self.exploration_threshold = float(settings.exploration_threshold)
        self.instances = Instances.empty(self.n_actions, self.grid.n_variables, periodic=self.grid.arrays.periodic)
        n_pairs = self.n_actions * self.grid.n_points
        # Weight of each pair's own instances, and whether it reaches the threshold.
        self.own_weight = np.zeros(n_pairs)
        self.known = np.zeros(n_pairs, dtype=np.bool_)
        # Transitions so far, of which ``max_instances`` may have removed some; the number of each that is there.
        self.n_added = 0
        self._number = np.zeros((self.n_actions, self.instances.capacity), dtype=np.int64)

    @abstractmethod
    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        """Predict from the target's own instances.

        :param states: shape (n, n_variables)
        :param actions: int64, shape (n,)
        """

    @property
    def n_instances(self) -> int:
        """Number of instances, of all actions."""
        return sum(self.instances.size.tolist())

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        """Add one transition; the pairs whose rows are to be updated, int64, by default all of the action.

        :param state: shape (n_variables,); ``next_state``: the same
        :param terminated: the episode ended in a terminal state; a time limit is none
        """
        slot = size = int(self.instances.size[action])
        if self.settings.max_instances is not None and size >= self.settings.max_instances:
            slot = int(self._number[action, :size].argmin())
        else:
            self._make_room(size + 1)
        put_instance_at.call(self.instances, (action, slot, state, next_state, reward, terminated))
        self.n_added += 1
        self._number[action, slot] = self.n_added
        return np.arange(action * self.grid.n_points, (action + 1) * self.grid.n_points)

    def outdated(self) -> np.ndarray:
        """All pairs whose rows are not what the instances say: for new scales."""
        return np.arange(len(self.known))

    def take_over(self, other: Model) -> np.ndarray:
        """Take over what another model, whose transitions this one has, knows of those that ``max_instances`` has removed.

        :return: the pairs whose rows are to be updated, int64
        """
        return NO_PAIRS

    def transitions(self) -> list[Transition]:
        """State, action, reward, next state and terminated of all instances, in the order in which they came."""
        rows, d = self.instances.rows()[np.argsort(self._numbers(), kind="stable")], self.grid.n_variables
        states, next_states = rows[:, 1 : 1 + d], rows[:, 1 : 1 + d] + rows[:, 1 + d : 1 + 2 * d]
        actions, rewards, terminated = rows[:, 0].astype(np.int64).tolist(), rows[:, -2].tolist(), (rows[:, -1] > 0.5).tolist()
        return list(zip(states, actions, rewards, next_states, terminated, strict=True))

    def _numbers(self) -> np.ndarray:
        """When each instance came, by action as in ``Instances.rows``."""
        return np.concatenate([self._number[action, :n] for action, n in enumerate(self.instances.size.tolist())])

    def _make_room(self, capacity: int) -> None:
        """Make room for at least so many instances of each action."""
        instances = self.instances.enlarged(capacity)
        self._number = np.pad(self._number, ((0, 0), (0, instances.capacity - self._number.shape[1])))
        self._take_in_arrays(instances)

    def _take_in_arrays(self, instances: Instances) -> None:
        """Have the instances in other arrays."""
        self.instances = instances

    def update_rows(self, pairs: np.ndarray) -> None:
        """Bring the rows of at most ``MAX_PAIRS_AT_ONCE`` pairs up to date with the instances and with what is transferred."""
        actions, points = np.divmod(pairs, self.grid.n_points)
        predictions = self.predict(self.grid.states_of(points), actions)
        self.own_weight[pairs] = predictions.weight
        self.known[pairs] = predictions.weight >= self.exploration_threshold
        modelled = self.known[pairs]
        if self.transfer is not None and not modelled.all():
            given = self.transfer.transferred_to_sample(points, actions, predictions.weight)
            predictions, modelled = join(predictions, given, modelled)
        self.mdp.write_rows(pairs, modelled, predictions.probability, predictions.effect, predictions.reward)

    def predict_at(self, state: np.ndarray) -> tuple[Prediction, TransferredInstances | None]:
        """Predict every action at an exact state, with transferred instances where the own ones do not suffice.

        :param state: shape (n_variables,)
        :return: good until the next call; and the transferred instances that were asked for, if any
        """
        actions = np.arange(self.n_actions)
        states = np.repeat(np.asarray(state, dtype=np.float64)[None], self.n_actions, axis=0)
        predictions = self.predict(states, actions)
        modelled, given = predictions.weight >= self.exploration_threshold, None
        weight = predictions.weight
        if self.transfer is not None and not modelled.all():
            given = self.transfer.transferred(states, actions, weight)
            predictions, modelled = join(predictions, given, modelled)
        length = np.full(self.n_actions, predictions.probability.shape[1], dtype=np.int64)
        arrays = map(np.ascontiguousarray, (predictions.probability, predictions.effect))
        return Prediction(modelled, weight, predictions.reward, length, *arrays), given

    def on(self, mdp: FiniteMDP) -> Model:
        """A model of the same instances over another finite MDP, all of whose pairs it fits; without transfer."""
        model = type(self)(mdp, self.settings)
        model._share_instances(self)
        model.update_all(np.arange(len(model.known)))
        return model

    def _share_instances(self, other: Model) -> None:
        self._number, self.n_added = other._number, other.n_added
        self._take_in_arrays(other.instances)

    def predict_alone(self, state: np.ndarray, action: int) -> tuple[np.ndarray, float]:
        """Predict the effect of an action at a state without a prior.

        :return: shape (n_variables,); and by how much the variance of one instance is multiplied, 0 if nothing is predicted
        """
        return np.zeros(self.grid.n_variables), 0.0

    def renew_prior(self) -> np.ndarray:
        """Ask the transfer method for its prior again if that may have changed; the pairs whose rows are to be updated."""
        return NO_PAIRS

    def end_episode(self) -> np.ndarray:
        """Do what may wait until the end of an episode; the pairs whose rows are to be updated."""
        return NO_PAIRS

    def get_state(self) -> dict[str, np.ndarray]:
        """What has been learned, float64 arrays, to be saved; their names and widths do not change."""
        return {"instances": np.column_stack([self.instances.rows(), self._numbers()])}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned, and update all rows of the finite MDP; for a new model."""
        self._put_in_order(state["instances"])
        self.n_added = int(self._number.max())
        self.update_all(np.arange(len(self.known)))

    def _put_in_order(self, rows: np.ndarray) -> None:
        """Put instances where they were: sums over all of them depend on their order, in the last bit."""
        instances = Instances.from_rows(self.n_actions, rows[:, :-1], self.grid.arrays.periodic)
        by_action = np.argsort(rows[:, 0], kind="stable")
        numbers = np.split(rows[by_action, -1].astype(np.int64), np.cumsum(instances.size)[:-1])
        self._number = np.zeros((self.n_actions, instances.capacity), dtype=np.int64)
        for action, own in enumerate(numbers):
            self._number[action, : len(own)] = own
        self._take_in_arrays(instances)

    def update_all(self, pairs: np.ndarray) -> None:
        """:meth:`update_rows` of any number of pairs."""
        for first in range(0, len(pairs), MAX_PAIRS_AT_ONCE):
            self.update_rows(pairs[first : first + MAX_PAIRS_AT_ONCE])


def join(own: Predictions, given: TransferredInstances, known: np.ndarray) -> tuple[Predictions, np.ndarray]:
    """Let transferred instances, one row a pair, join those of pairs that are not known; predictions, and what has a model."""
    n = len(known)
    length = np.where(known, 0, given.length[:n])
    used = np.arange(given.weight.shape[1]) < length[:, None]
    weight = np.where(used, given.weight[:n], 0.0)
    own_weight = np.where((length > 0) & (own.weight > 0.0), own.weight, length == 0)
    total = own_weight + weight.sum(axis=1)
    share, own_share = weight / total[:, None], own_weight / total
    reward = own_share * own.reward + (share * np.where(used, given.reward[:n], 0.0)).sum(axis=1)
    goes_on = np.where(used & ~given.terminated[:n], share, 0.0)
    effect = np.where(used[:, :, None], given.effect[:n], 0.0)
    joined = Predictions(
        weight=own.weight,
        reward=reward,
        probability=np.hstack([own_share[:, None] * own.probability, goes_on]),
        effect=np.concatenate([own.effect, effect], axis=1),
    )
    return joined, known | (length > 0)
