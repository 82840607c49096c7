"""The agent of Fitted R-Max: model, planner and transfer method together, on arrays, without Stable-Baselines3."""

from __future__ import annotations

import threading
from time import perf_counter
from typing import Any

import numpy as np

from sb3_combrel.common.checks import check_resolution
from sb3_combrel.common.periodic import periodic_flags
from sb3_combrel.common.task import Task
from sb3_combrel.fitted_rmax.loop_detection import EXPLOIT, EXPLORE, OPTIMISTIC, EpisodeMemory, manner, small_cell
from sb3_combrel.fitted_rmax.settings import MODELS, FittedRMaxSettings
from sb3_combrel.fitted_rmax.workload import warn_if_long, workload
from sb3_combrel.models.base import MAX_PAIRS_AT_ONCE, NO_PAIRS, Model
from sb3_combrel.planning.corrections import MAX_VISITS, CorrectionArrays
from sb3_combrel.planning.grid import fitting_grid
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.q_values import NOBODY, PlainValueFunction, Prediction, QValues
from sb3_combrel.planning.sweeping import NOWHERE, Planner
from sb3_combrel.planning.visits import Visits
from sb3_combrel.transfer.base import TargetTask, Transfer

# Lowest return that a state is given, in steps of the worst reward seen: far below every sensible plan.
LONGEST_PLAN = 10_000

# Backups in multiples of those of a step, passes over the grid, and backups for each pair that transfer has changed.
AT_EPISODE_END = 400
BEFORE_FIRST_STEP = 300
BACKUPS_PER_CHANGED_PAIR = 2

# A time limit reached this often changes nothing; each further time multiplies the threshold by the factor.
DECAY_AFTER_EPISODES = 10
THRESHOLD_DECAY = 0.98


class FittedRMaxAgent:
    """Fitted R-Max on arrays. States are in unit coordinates (``task.scaling.to_unit(states)``), actions are numbered from 0.

    One step of learning is ``action = agent.act(state)``, then ``agent.update(state, action, reward, next_state,
    terminated)``; call ``agent.end_episode(truncated)`` at the end of each episode. All methods may be called from any
    thread. What is asked of the agent without ``explore`` does not change what it learns.

    :param settings: see :class:`FittedRMaxSettings`
    :param task: state variables and actions
    :param transfer: a transfer method, bound here to the task; None for none
    :param rng: generator of all random numbers of learning
    :param model_class: a subclass of :class:`~sb3_combrel.models.base.Model`; None: the one for ``settings.degree``
    :raises ValueError: if the settings do not fit the task, or the transfer method does not
    """

    def __init__(
        self,
        settings: FittedRMaxSettings,
        task: Task,
        transfer: Transfer | None = None,
        rng: np.random.Generator | None = None,
        model_class: type[Model] | None = None,
    ):
        self.settings, self.task, self.transfer = settings, task, transfer
        self.model_class = MODELS[settings.degree] if model_class is None else model_class
        self.rng = np.random.default_rng() if rng is None else rng
        self._prediction_rng = self.rng.spawn(1)[0]
        d = task.n_variables
        self.max_backups = settings.backups_for(d)
        #: Which state variables are periodic.
        self.periodic = periodic_flags(settings.periodic, d)
        self.model_settings = settings.model_settings(d)
        breadth, min_weight = self.model_settings.model_breadth, self.model_settings.min_weight
        check_resolution(settings.resolution, d)
        self.grid = fitting_grid(d, task.n_actions, settings.resolution, breadth, min_weight, self.periodic)
        transfers = transfer is not None and transfer.informs_model
        self.workload = workload(self.grid, task.n_actions, self.model_settings, transfers)
        warn_if_long(self.workload, self.grid)
        self.n_truncated = self.n_backups = 0
        #: How often an action without a model was chosen in learning.
        self.n_optimistic_actions = 0
        #: Whether to measure the time of planning, which takes some itself.
        self.timed = False
        self.planning_seconds = 0.0
        # One thread at a time: predicting in one while another learns must be safe.
        self._lock = threading.RLock()
        self._q = QValues(task.n_actions, d)
        # Most methods leave all actions to the agent: they are not asked at every step.
        self._transfer_decides = transfer is not None and type(transfer).action is not Transfer.action
        if transfer is not None:
            transfer.check_degree(1 if self.model_class.takes_prior else 0)
            self.target = self._target_task()
            transfer.bind(self.target, self.rng)
        self._build()
        if transfer is not None:
            self._widen(transfer.lowest_reward())

    def _target_task(self) -> TargetTask:
        return TargetTask(
            scaling=self.task.scaling,
            n_actions=self.task.n_actions,
            sample_states=self.grid.points(),
            exploration_threshold=self.model_settings.exploration_threshold,
            min_weight=self.model_settings.min_weight,
            min_fraction=self.model_settings.min_fraction,
            state_names=tuple(self.task.state_names),
            action_names=tuple(self.task.action_names),
            periodic=self.periodic,
            takes_prior=self.model_class.takes_prior,
            gamma=self.settings.gamma,
            max_value=float(self.settings.max_value),
        )

    def _build(self) -> None:
        """Make model and planner, without any instances."""
        max_value, tolerance = float(self.settings.max_value), self.settings.planning_tolerance
        self.mdp = FiniteMDP(self.grid, self.task.n_actions, self.settings.gamma)
        self._model_transfer = self.transfer if self.transfer is not None and self.transfer.informs_model else None
        self.model = self.model_class(self.mdp, self.model_settings, self._model_transfer)
        self.planner = Planner(self.mdp, max_value=max_value, min_value=min(0.0, max_value) - 1.0, tolerance=tolerance)
        self._set_corrections(CorrectionArrays.empty(self.task.n_variables))
        self.visits = Visits(self.task.n_variables, self.grid.n_points)
        self._outdated: list[np.ndarray] = []

    def _set_corrections(self, corrections: CorrectionArrays) -> None:
        self.corrections, self._plain_corrections = corrections, tuple(corrections)

    def reseed(self, rng: np.random.Generator) -> None:
        """Go on with the random numbers of ``rng``, in the transfer method as well; predictions with some derived from it."""
        # The generator itself stays the same, as the transfer method has it too.
        self.rng.bit_generator.state = rng.bit_generator.state
        self._prediction_rng = rng.spawn(1)[0]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.RLock())

    def act(
        self,
        state: np.ndarray,
        explore: bool = True,
        episode: int = 0,
        memory: EpisodeMemory | None = None,
        environment: int = 0,
    ) -> int:
        """Choose an action.

        :param state: unit coordinates, shape (n_variables,)
        :param explore: whether to choose for learning: greedily, ties broken at random, so that optimistic actions come
            first. Otherwise the best of the actions that are known, or else modelled with transferred instances; where a
            source bounds the values, of all.
        :param episode: in learning, a number that tells the episodes of all environments apart
        :param memory: in evaluation, what is stored of the episode so far; in a loop other actions are tried
        :param environment: in learning, the number of the environment, for a transfer method that decides actions
        :return: the action, from 0 on
        :raises ValueError: if a transfer method decides on something that is no action
        """
        with self._lock:
            if not explore:
                return self._exploit(state, memory)
            decided = self._decided_by_transfer(state, environment) if self._transfer_decides else None
            return self._explore(state, episode) if decided is None else decided

    def _decided_by_transfer(self, state: np.ndarray, environment: int) -> int | None:
        """The action that the transfer method decides on; None if it leaves it to the agent."""
        assert self.transfer is not None
        self.transfer.environment = environment
        action = self.transfer.action(state)
        is_number = isinstance(action, int | np.integer) and not isinstance(action, bool)
        if action is None or (is_number and 0 <= action < self.task.n_actions):
            return None if action is None else int(action)
        raise ValueError(
            f"{type(self.transfer).__name__}.action must return None or a whole number from 0 to {self.task.n_actions - 1}, "
            f"got {action!r}"
        )

    def _explore(self, state: np.ndarray, episode: int) -> int:
        if self.corrections.n_states[0] == len(self.corrections.key):
            self._set_corrections(self.corrections.with_room())
        prediction, given = self.model.predict_at(state)
        if given is not None and self.transfer is not None:
            self.transfer.note_use(given)
        elif self.model.accepts_visited:
            self._note_visit(state, prediction)
        visitor = (episode, 5 * self.planner.tolerance, MAX_VISITS)
        best = self._q.compute(prediction, state, self._value_function(self.planner.values), visitor)
        if best < 0:
            ties = np.flatnonzero(self._q.q == self._q.q.max())
            best = int(ties[self.rng.integers(len(ties))])
        if not prediction.modelled[best]:
            self.n_optimistic_actions += 1
        return best

    def _note_visit(self, state: np.ndarray, prediction: Prediction) -> None:
        """Let grid points beside which all has been known often enough count as known (see ``planning.visits``)."""
        threshold, n_optimistic = self.model.exploration_threshold, self.mdp.arrays.n_optimistic
        points = self.visits.note(state, prediction.weight, threshold, n_optimistic, self.grid.plain)
        if len(points):
            pairs = (np.arange(self.task.n_actions)[:, None] * self.grid.n_points + points).reshape(-1)
            self._outdated.append(self.model.accept(pairs))

    def _exploit(self, state: np.ndarray, memory: EpisodeMemory | None) -> int:
        mode = manner(memory, self.planner.is_bounded)
        prediction = self._evaluate(state, self.planner.exploitation_values() if mode == EXPLOIT else None)
        q = self._q.q
        eligible = prediction.weight >= self.model.exploration_threshold
        if not eligible.any():
            eligible = prediction.modelled
        if mode == EXPLORE or (mode == OPTIMISTIC and not eligible.any()):
            eligible = np.ones(len(q), dtype=np.bool_)
        action = int(np.where(eligible, q, -np.inf).argmax())
        if memory is not None:
            memory.note(small_cell(state, self.grid), float(q[action]), float(prediction.reward[action]), self.settings.gamma)
        return action

    def sample_action(self, state: np.ndarray) -> int:
        """Choose an action as in learning, optimistic ones first, but for a prediction: it does not change what is learned."""
        with self._lock:
            self._evaluate(state)
            return int(self._prediction_rng.choice(np.flatnonzero(self._q.q == self._q.q.max())))

    def q_values(self, state: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        """Compute the action values at an exact state; optimistic actions have ``max_value``, or what a prior bounds it by.

        :param state: unit coordinates, shape (n_variables,)
        :param values: at the grid points; by default the planner's, optimistic ones
        :return: shape (n_actions,)
        """
        with self._lock:
            self._evaluate(np.ascontiguousarray(state, dtype=np.float64), values)
            return self._q.q.copy()

    def _evaluate(self, state: np.ndarray, values: np.ndarray | None = None) -> Prediction:
        prediction, _ = self.model.predict_at(state)
        function = self._value_function(self.planner.values if values is None else values)
        self._q.compute(prediction, state, function, NOBODY)
        return prediction

    def _value_function(self, values: np.ndarray) -> PlainValueFunction:
        return values, self._plain_corrections, self.grid.plain, self.mdp.gamma, self.planner.bounds, self.planner.upper

    def update(
        self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool, environment: int = 0
    ) -> None:
        """Learn from one transition, and plan.

        :param state: unit coordinates; ``next_state``: the same
        :param action: from 0 on
        :param terminated: whether ``next_state`` is a terminal state; a time limit is none
        :param environment: see :meth:`act`
        """
        with self._lock:
            self._widen(reward)
            self._outdated.append(self.model.add(state, action, reward, next_state, terminated))
            if self.transfer is not None:
                self.transfer.environment = environment
                self.transfer.observe(state, action, reward, next_state, terminated)
            self._plan(self.max_backups, NOWHERE if terminated else next_state)

    def end_episode(self, truncated: bool, environment: int = 0) -> None:
        """Plan on while no action is due.

        :param truncated: whether the episode ended by its time limit
        :param environment: see :meth:`act`
        """
        with self._lock:
            if truncated:
                self.n_truncated += 1
                self._outdated.append(self.model.lower_threshold(self._lowered_threshold()))
            if self.transfer is not None:
                self.transfer.environment = environment
                self.transfer.end_episode(truncated)
                self._outdated.append(self.model.outdated())
            self._outdated.append(self.model.end_episode())
            self._plan(AT_EPISODE_END * self.max_backups)

    def complete(self) -> None:
        """Bring the model up to date with all transitions, as at an episode's end: what is saved is what is predicted with."""
        with self._lock:
            pairs = self.model.end_episode()
            if len(pairs):
                self._outdated.append(pairs)
                self._plan(0)

    def _lowered_threshold(self) -> float:
        # Exploration would otherwise not end where a narrow kernel cannot know all that is within an episode's reach.
        full, min_weight = self.model_settings.exploration_threshold, self.model_settings.min_weight
        return max(full * THRESHOLD_DECAY ** max(0, self.n_truncated - DECAY_AFTER_EPISODES), min(full, min_weight))

    def prepare(self) -> None:
        """Model what is transferred before the first step, and plan until the values have converged."""
        with self._lock:
            # Episodes are numbered from 0 again.
            self.corrections.visits.fill(0)
            self._plan(0)
            if self.transfer is not None or self.model.n_instances > 0:
                self.planner.restart()
                self.n_backups += self.planner.sweep_all(BEFORE_FIRST_STEP)

    def _plan(self, max_backups: int, around: np.ndarray = NOWHERE) -> None:
        """Update the rows of the pairs that changed, and plan; longer where transfer changed many pairs at once."""
        began = perf_counter() if self.timed else None
        changed = NO_PAIRS if self._model_transfer is None else self._changed_by(self._model_transfer)
        passes = 0
        if len(changed):
            self._outdated.append(changed)
            backups = BACKUPS_PER_CHANGED_PAIR * len(changed)
            passes = backups // self.grid.n_points
            max_backups += backups if passes == 0 else 0
        # Left on the list until all is done: an interrupt in between loses no change.
        pairs = self._outdated[0] if len(self._outdated) == 1 else np.unique(np.concatenate([NO_PAIRS, *self._outdated]))
        while len(pairs) > MAX_PAIRS_AT_ONCE:
            some, pairs = pairs[:MAX_PAIRS_AT_ONCE], pairs[MAX_PAIRS_AT_ONCE:]
            self.model.update_rows(some)
            self.n_backups += self.planner.update(some, 0)
        if len(pairs):
            self.model.update_rows(pairs)
        self.n_backups += self.planner.update(pairs, max_backups, around)
        self._outdated.clear()
        if passes:
            self.n_backups += self.planner.sweep_all(passes)
        if began is not None:
            self.planning_seconds += perf_counter() - began

    def _changed_by(self, transfer: Transfer) -> np.ndarray:
        """The pairs for which transfer has changed: all for a new prior, or those, not known, that may have new instances."""
        if transfer.use == "prior":
            pairs = self.model.renew_prior()
            if len(pairs):
                self.planner.set_upper(transfer.value_bound())
            return pairs
        changed = transfer.changed(self.model.known.reshape(self.task.n_actions, -1))
        if isinstance(changed, np.ndarray):
            return np.flatnonzero(changed.reshape(-1) & ~self.model.known)
        return np.flatnonzero(~self.model.known) if changed else NO_PAIRS

    def _widen(self, reward: float) -> None:
        """Keep the lower bound of the values below what the worst reward seen could add up to."""
        low, high = self.planner.bounds
        self.planner.bounds = (min(low, min(0.0, high) + LONGEST_PLAN * min(0.0, reward)), high)

    def get_state(self) -> dict[str, np.ndarray]:
        """What has been learned, float64 arrays by name; only the number of rows of arrays with several axes ever changes."""
        with self._lock:
            of_transfer = {} if self.transfer is None else self.transfer.get_state()
            return {
                **{f"transfer_{name}": array for name, array in of_transfer.items()},
                **self.model.get_state(),
                "values": self.planner.values.copy(),
                "lowest_value": np.array([self.planner.bounds[0]]),
                "n_truncated": np.array([float(self.n_truncated)]),
                "corrections": self.corrections.rows(),
                "visits": self.visits.counts.astype(np.float64),
            }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned; what has been learned since is forgotten."""
        with self._lock:
            self._build()
            self.n_truncated = int(state["n_truncated"][0])
            if self.transfer is not None:
                self.transfer.bind(self.target, self.rng)
                prefix = "transfer_"
                self.transfer.set_state({name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)})
            self.model.lower_threshold(self._lowered_threshold())
            self.model.set_state(state)
            self.planner.bounds = (float(state["lowest_value"][0]), self.planner.bounds[1])
            if self.transfer is not None and self.transfer.use == "prior":
                self.planner.set_upper(self.transfer.value_bound())
            self.planner.restore(state["values"])
            self._set_corrections(CorrectionArrays.of_rows(state["corrections"]))
            self.visits.counts[:] = np.clip(state["visits"], 0, np.iinfo(np.int32).max)

    def statistics(self) -> dict[str, float]:
        """Figures for the logger, by name."""
        with self._lock:
            modelled, known = float(self.mdp.arrays.modelled.mean()), float(self.model.known.mean())
            figures = {
                "model/instances": self.model.n_instances,
                "model/known": known,
                "model/transferred": modelled - known,
                "model/optimistic": 1.0 - modelled,
                "model/threshold": self.model.exploration_threshold,
                "planner/queued": self.planner.n_queued,
                "planner/corrections": int(self.corrections.n_states[0]),
            }
            return figures if self.transfer is None else {**figures, **self.transfer.statistics()}
