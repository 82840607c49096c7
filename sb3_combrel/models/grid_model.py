"""A model in compiled loops that keeps the pairs of the grid up to date, whatever it predicts them with.

What a pair's row says depends on nothing but the transitions up to the one at which it was last fitted, and when that is
depends on the transitions alone: so a model is saved as its transitions and one number a pair, and loaded by replaying them.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.constants import LEAST_SIZE, ON_GRID
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.regression import Kernel
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import MAX_PAIRS_AT_ONCE, NO_PAIRS, InstanceTransfer, Model, ModelSettings, Predictions
from sb3_combrel.models.ends import Ends, put_arrivals, put_transition
from sb3_combrel.models.grid_points import CAME, ENDED, WENT, PairArrays, PointScratch, note_instance
from sb3_combrel.planning.mdp import FiniteMDP, add_successor
from sb3_combrel.planning.q_values import Prediction

NO_EFFECT = np.empty(0)


@inlined
def total_weight(own, transferred, row):
    """Weight of a pair's own instances and of those transferred to it; ``row``: of the pair in ``transferred``."""
    for j in range(transferred.length[row]):
        own += transferred.weight[row, j]
    return own


@compiled
def add_to_row(reward, n_touched, transferred, row, total, scratch, grid):
    """Add transferred instances to the row of a pair; its reward, and see ``planning.mdp.add_successor``."""
    for j in range(transferred.length[row]):
        p = transferred.weight[row, j] / total
        reward += p * transferred.reward[row, j]
        if not transferred.terminated[row, j]:
            n_touched = add_successor(p, transferred.effect[row, j], scratch, grid, n_touched)
    return reward, n_touched


@entry_point
def join_transferred(transferred, threshold, prediction):
    """Let transferred instances join the prediction of actions of less weight than ``threshold``; plain tuples."""
    transferred, prediction = TransferredInstances(*transferred), Prediction(*prediction)
    for action in range(len(prediction.weight)):
        own = prediction.weight[action]
        if own >= threshold or transferred.length[action] == 0:
            continue
        total = total_weight(own, transferred, action)
        n, reward = prediction.length[action], prediction.reward[action] * own / total
        for k in range(n):
            prediction.probability[action, k] *= own / total
        for j in range(transferred.length[action]):
            p = transferred.weight[action, j] / total
            reward += p * transferred.reward[action, j]
            if not transferred.terminated[action, j]:
                prediction.probability[action, n] = p
                for v in range(prediction.effect.shape[2]):
                    prediction.effect[action, n, v] = transferred.effect[action, j, v]
                n += 1
        prediction.reward[action], prediction.length[action], prediction.modelled[action] = reward, n, True


class GridModel(Model):
    """A model whose loops are compiled; they take plain tuples (see ``common.compiled``)."""

    #: Successors of an action that the own instances may predict.
    _own_room = 1
    #: Coefficients of each number that is fitted at a pair, and numbers.
    _fitted = 0, 0

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        is_prior = self.takes_prior and transfer is not None and transfer.use == "prior"
        self._prior = transfer if is_prior else None
        breadth, per_breadth = float(settings.model_breadth), -np.log(settings.min_weight)
        self.kernel = Kernel(
            scale=-1.0 / breadth**2,
            per_breadth=per_breadth,
            reach=per_breadth * breadth**2,
            n_neighbors=settings.n_neighbors,
            outcome_breadth=min(breadth, float(settings.outcome_breadth)) ** 2,
        )
        n_kept = settings.n_neighbors if is_prior else 0
        self.pairs = PairArrays.empty(len(self.known), self.kernel.reach, self._fitted, n_kept)
        self.own_weight, self.known = self.pairs.weight, self.pairs.known
        # The transition whose outcome was the first to tell states apart; 0: none has.
        self._first_reward, self._informed_at = np.nan, 0
        # A variable that hardly ever changes is measured by this part of a cell.
        least_size = np.append(LEAST_SIZE / self.grid.arrays.cells, [1e-9] * (1 + settings.ends_by_action))
        # Of effects, rewards and ends: sums of sizes by action, the least mean sizes; the last instance's, and mean sizes.
        n = len(least_size)
        self._measured = np.zeros((self.n_actions, n)), least_size, np.zeros(n), np.zeros(n)
        along = np.empty((self.grid.n_variables, int(self.grid.arrays.shape.max())))
        span, due = np.empty((3, self.grid.n_variables), dtype=np.int64), np.empty(len(self.known), dtype=np.int64)
        self._points = tuple(PointScratch(along, span, due, predicted=np.empty(n)))
        self._prediction = Prediction.empty(self.n_actions, self._own_room, self.grid.n_variables)
        # To as many pairs as are ever written at once.
        self._nothing = tuple(TransferredInstances.empty(MAX_PAIRS_AT_ONCE, self.grid.n_variables))
        self._take_in_arrays(self.instances)

    @property
    def _giver(self) -> InstanceTransfer | None:
        """Where instances come from for pairs that are not known; a transfer method that is a prior gives none."""
        return None if self._prior is not None else self.transfer

    @property
    def _informed(self) -> bool:
        """Whether an outcome has told states apart."""
        return 0 < self._informed_at <= self.n_added

    @property
    def _threshold(self) -> float:
        """The weight with which grid points are known."""
        return ON_GRID * self.exploration_threshold if self._informed else self.exploration_threshold

    @abstractmethod
    def _predict_own(self, state: np.ndarray) -> float:
        """Fill the prediction from the own instances; the least weight that an action has."""

    @abstractmethod
    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        """Fit, and write the rows of, (pairs, how many are done); how many are done then, fewer if there is no room."""

    def _take_in_arrays(self, instances: Instances) -> None:
        """Make the arrivals, which share arrays with the instances, and those among them that ended an episode."""
        arrivals = Instances.empty(self.n_actions, self.grid.n_variables, instances.capacity)
        shared = {name: getattr(instances, name) for name in ("reward", "terminated", "size", "periodic")}
        arrivals = arrivals._replace(**shared)
        put_arrivals.call(instances, arrivals)
        self._renew_ends(instances, arrivals)

    def _renew_ends(self, instances: Instances, arrivals: Instances) -> None:
        ended = [np.empty((0, self.grid.n_variables))]
        if not self.settings.ends_by_action:
            ended += [arrivals.state[a, :n][arrivals.terminated[a, :n]] for a, n in enumerate(arrivals.size)]
        ends = Ends(np.concatenate(ended), np.zeros(2, dtype=np.int64))
        plain = tuple(instances), tuple(arrivals), tuple(ends)
        # At once, without a call in between: with some of them an interrupt would leave others that are too small.
        self.instances, self.arrivals, self.ends, self._plain_experience = instances, arrivals, ends, plain

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        slot, removed = self._slot_for(state, action)
        due = self._put((action, slot, state, next_state, reward, terminated))
        return due if len(removed) == 0 else np.union1d(removed, due)

    def _put(self, transition: tuple[Any, ...], effect: np.ndarray = NO_EFFECT) -> np.ndarray:
        """Write an instance to its slot; the pairs that are due. ``effect``: in place of next state minus state."""
        action, slot, *_, terminated = transition
        put_transition.call(*self._plain_experience[:2], transition, effect, self._measured)
        self.n_added += 1
        self._number[action, slot] = self.n_added
        numbers_and_size = self._measured[2:]
        due = self._note((self.instances.state[action, slot], *numbers_and_size), action, self.kernel.reach, CAME)
        if self.searches and not self._informed:
            due = self._inform(float(transition[4]), bool(terminated), due)
        if not terminated or self.settings.ends_by_action:
            return due
        self._renew_ends(self.instances, self.arrivals)
        # What is known of ends concerns all actions that may lead there.
        arrived, noted = self.arrivals.state[action, slot], [due]
        widest = (self.grid.diagonal + float(np.linalg.norm(self.instances.effect[action, slot]))) ** 2
        noted += [self._note((arrived, *numbers_and_size), other, widest, ENDED) for other in range(self.n_actions)]
        return np.unique(np.concatenate(noted))

    def _inform(self, reward: float, terminated: bool, due: np.ndarray) -> np.ndarray:
        """Note an outcome; with the first that differs grid points need less weight: the pairs that are due."""
        self._first_reward = reward if np.isnan(self._first_reward) else self._first_reward
        if not (terminated or abs(reward - self._first_reward) > 1e-9 * abs(reward)):
            return due
        self._informed_at = self.n_added
        return np.union1d(due, self._with_enough())

    def _with_enough(self) -> np.ndarray:
        """The pairs that are not known, although their instances suffice."""
        return np.flatnonzero(~self.known & (self.own_weight >= self._threshold))

    def take_over(self, other: Model) -> np.ndarray:
        assert isinstance(other, GridModel)
        if self._informed or not other._informed:
            return NO_PAIRS
        self._informed_at = self.n_added
        return self._with_enough()

    def _note(self, instance: tuple[np.ndarray, ...], action: int, widest: float, why: int) -> np.ndarray:
        """Note at the pairs of an action what has happened near them; those that are to be fitted."""
        # Where instances are transferred, what is not known is updated when its instances are twice as many.
        rules = self.kernel.scale, self.kernel.per_breadth, self._threshold, 0 if self._giver is None else 1
        first = action * self.grid.n_points
        n = note_instance.call(instance, first, tuple(self.pairs), widest, why, self.grid.plain, rules, self._points)
        # The next transition writes to the same work space, and an interrupt may leave these pairs to be fitted after it.
        due: np.ndarray = self._points[2][:n].copy()
        return due

    def _slot_for(self, state: np.ndarray, action: int) -> tuple[int, np.ndarray]:
        """Where a new instance goes, and the pairs that lose one: with ``max_instances`` the nearest of its action goes."""
        instances, size = self.instances, int(self.instances.size[action])
        if self.settings.max_instances is not None and size >= self.settings.max_instances:
            apart = differences(instances.state[action, :size], state, instances.periodic)
            slot = int((apart**2).sum(axis=1).argmin())
            sums, _, numbers, _ = self._measured
            gone = [*instances.effect[action, slot], instances.reward[action, slot], instances.terminated[action, slot]]
            sums[action] = np.maximum(sums[action] - np.abs(gone[: len(numbers)]), 0.0)
            instance = instances.state[action, slot], numbers, numbers
            removed = self._note(instance, action, self.kernel.reach, WENT)
            if instances.terminated[action, slot]:
                instances.terminated[action, slot] = False
                self._renew_ends(self.instances, self.arrivals)
                # Rows that have an end in them, of whatever action.
                removed = np.union1d(removed, np.flatnonzero(np.isinf(self.pairs.surprise)))
            return slot, removed
        if size == instances.capacity:
            self._make_room(size + 1)
        return size, NO_PAIRS

    def end_episode(self) -> np.ndarray:
        """The pairs with transferred instances that have new ones of their own."""
        return NO_PAIRS if self._giver is None else np.flatnonzero((self.pairs.n_new > 0) & ~self.known)

    def _share_instances(self, other: Model) -> None:
        assert isinstance(other, GridModel)
        super()._share_instances(other)
        self._informed_at = other._informed_at

    def outdated(self) -> np.ndarray:
        return np.flatnonzero(self.pairs.n_new) if self._giver is None else super().outdated()

    def update_rows(self, pairs: np.ndarray) -> None:
        if self._giver is None:
            self._write_all_rows(pairs)
            return
        # What their own instances alone say of pairs also shows which of these still lack some.
        unsure = np.flatnonzero(~self.known[pairs])
        self._write_all_rows(pairs[unsure])
        # Of what is known the full threshold, so that no method has work with it: grid points may be known with less. And what
        # is known stays known, unless an instance has gone.
        full, found = self.exploration_threshold, self.own_weight[pairs[unsure]]
        own_weight = np.full(len(pairs), full)
        own_weight[unsure] = np.where(self.known[pairs[unsure]], np.maximum(full, found), found)
        actions, points = np.divmod(pairs, self.grid.n_points)
        self._write_all_rows(pairs, self._giver.transferred_to_sample(points, actions, own_weight))

    def _write_all_rows(self, pairs: np.ndarray, transferred: TransferredInstances | None = None) -> None:
        """Write the rows of pairs, and make room in the finite MDP where they need more; ``transferred``: to each of them."""
        given, done = self._nothing if transferred is None else tuple(transferred), 0
        while done < len(pairs):
            done = self._write_rows((pairs, done), given)
            if done < len(pairs):
                self.mdp.make_room()

    def predict_at(self, state: np.ndarray) -> tuple[Prediction, TransferredInstances | None]:
        if self._predict_own(state) >= self.exploration_threshold or self._giver is None:
            return self._prediction, None
        states = np.repeat(state[None], self.n_actions, axis=0)
        given = self._giver.transferred(states, np.arange(self.n_actions), self._prediction.weight)
        room = self._own_room + given.weight.shape[1]
        if room > self._prediction.probability.shape[1]:
            self._prediction = Prediction.empty(self.n_actions, room, self.grid.n_variables)
            self._predict_own(state)
        join_transferred.call(tuple(given), self.exploration_threshold, tuple(self._prediction))
        return self._prediction, given

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        rows = []
        for state, action in zip(states, actions, strict=True):
            self._predict_own(np.ascontiguousarray(state, dtype=np.float64))
            rows.append([array[action].copy() for array in self._prediction])
        _, weight, reward, length, probability, effect = map(np.array, zip(*rows, strict=True))
        used = np.arange(probability.shape[1]) < length[:, None]
        return Predictions(weight, reward, np.where(used, probability, 0.0), np.where(used[:, :, None], effect, 0.0))

    def get_state(self) -> dict[str, np.ndarray]:
        return {
            **super().get_state(),
            "fitted_at": self.pairs.fitted_at.astype(np.float64),
            "n_added": np.array([float(self.n_added), float(self._informed_at)]),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Replay the transitions, and fit each pair when it was last fitted; for a new model."""
        self.update_all(self.renew_prior())
        rows, d = state["instances"][np.argsort(state["instances"][:, -1], kind="stable")], self.grid.n_variables
        actions = np.clip(rows[:, 0], 0, self.n_actions - 1).astype(np.int64)
        self._make_room(int(np.bincount(actions, minlength=self.n_actions).max()))
        n_added, self._informed_at = (int(number) for number in state["n_added"])
        fitted_at = state["fitted_at"].astype(np.int64)
        if self._giver is not None and len(rows) > 0:
            self.update_all(np.flatnonzero(fitted_at == 0))
        by_time = np.argsort(fitted_at, kind="stable")
        times, first = np.unique(fitted_at[by_time], return_index=True)
        fits = zip(times.tolist(), np.split(by_time, first[1:]), strict=True)
        events: list[tuple[int, bool, Any]] = [(time, True, pairs) for time, pairs in fits if 0 < time <= n_added]
        events += [(int(row[-1]), False, (action, row)) for action, row in zip(actions.tolist(), rows, strict=True)]
        # A transition comes before the fits to it.
        for number, is_fit, what in sorted(events, key=lambda event: event[:2]):
            if is_fit:
                self.n_added = number
                self.update_all(what)
                continue
            self.n_added, (action, row) = number - 1, what
            at, effect = row[1 : 1 + d].copy(), row[1 + d : 1 + 2 * d].copy()
            self._put((action, int(self.instances.size[action]), at, at, float(row[-3]), bool(row[-2] > 0.5)), effect)
        self.n_added = n_added
        self._put_in_order(state["instances"])
        if self.pairs.item.size:
            self._rename_kept()

    def _rename_kept(self) -> None:
        """Let the lists of pairs name slots as they are: in the replay these were in order of time."""
        items = self.pairs.item.reshape(self.n_actions, self.grid.n_points, -1)
        for action in np.flatnonzero(self.instances.size):
            slots = np.argsort(self._number[action, : self.instances.size[action]])
            items[action] = slots[items[action]]
