"""The agent of Fitted R-Max: model, planner and transfer method together, on arrays, without Stable-Baselines3.

A step of learning, as Jong & Stone (2007) have it: :meth:`FittedRMaxAgent.act` predicts every action at the exact state,
values what it leads to by the planner's values, and takes the best one; :meth:`FittedRMaxAgent.update` gives the transition to
the model, which says what pairs of the grid it changes, fits these anew, and sweeps over the grid.
"""

from __future__ import annotations

import reprlib
import threading
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from sb3_combrel.common.checks import check_finite, check_resolution
from sb3_combrel.common.constants import (
    BEYOND,
    COARSE,
    LINES_AGAIN,
    LONGEST_PLAN,
    SURE_OF_ENDS,
    SWEEPS_A_STEP,
    SWEEPS_AT_EPISODE_END,
)
from sb3_combrel.common.periodic import periodic_flags
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.task import Task
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.fitted_rmax.correspondence import Correspondence, NoTransfer, OfLearner
from sb3_combrel.fitted_rmax.optimism import RewardRange, worth_after_visits
from sb3_combrel.fitted_rmax.promises import Promises
from sb3_combrel.fitted_rmax.settings import MODELS, FittedRMaxSettings
from sb3_combrel.fitted_rmax.workload import warn_if_long, workload
from sb3_combrel.models.base import NO_PAIRS, Model, Transition
from sb3_combrel.models.ends_by_action import evidence_for_action
from sb3_combrel.planning.grid import MAX_PAIRS_BY_DEFAULT, fitting_grid
from sb3_combrel.planning.lines import moved_lines
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.planner import Planner
from sb3_combrel.planning.q_values import Prediction, QValues, ValueFunction
from sb3_combrel.transfer.base import TargetTask, Transfer

# By what the names of arrays of a transfer method begin in the agent's state.
OF_TRANSFER = "transfer_"


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
        self.settings, self.task = settings, task
        #: The transfer method, None for none.
        self.transfer = transfer
        # The same, or one that transfers nothing.
        self._method = NoTransfer() if transfer is None else transfer
        self.model_class = MODELS[settings.degree] if model_class is None else model_class
        self.rng = np.random.default_rng() if rng is None else rng
        #: Of predictions that are drawn, which do not change what is learned.
        self.prediction_rng = self.rng.spawn(1)[0]
        d = task.n_variables
        #: Which state variables are periodic.
        self.periodic = periodic_flags(settings.periodic, d)
        self.model_settings = settings.model_settings(d)
        breadth, min_weight = self.model_settings.model_breadth, self.model_settings.min_weight
        check_resolution(settings.resolution, d)
        self.grid = fitting_grid(d, task.n_actions, settings.resolution, breadth, min_weight, self.periodic)
        self.workload = workload(self.grid, task.n_actions, self.model_settings, self._method.informs_model)
        warn_if_long(self.workload, self.grid)
        self.rewards = RewardRange(settings.gamma, settings.max_value)
        #: Whether the grid is so coarse that it matters where its lines are; with how many instances they are moved next.
        self.is_coarse = self.grid.margin == 0 and 2 ** max(self.grid.resolution) <= COARSE
        self._lines_due = self.model_settings.n_neighbors * task.n_actions
        # After how many ends it is looked at next what decides them.
        self._ends_due = 1
        self.n_sweeps = 0
        #: Whether it has learned from what it has done itself.
        self.has_acted = False
        self._cautious: ValueFunction | None = None
        #: How often an action without a model was chosen in learning.
        self.n_optimistic_actions = 0
        #: How long planning has taken so far.
        self.planning_seconds = 0.0
        #: One thread at a time: predicting in one while another learns must be safe.
        self.lock = threading.RLock()
        self._q = QValues(task.n_actions, d)
        # Most methods leave all actions to the agent: they are not asked at every step.
        self._transfer_decides = type(self._method).action is not Transfer.action
        self._method.check_degree(1 if self.model_class.takes_prior else 0)
        self._bind()
        self._build()

    def _bind(self) -> None:
        """Tell the transfer method of the task, in the unit coordinates in which tasks correspond."""
        task, kernel = self.task, self.model_settings
        self.correspondence = Correspondence(task.scaling, task.bounds)
        target = TargetTask(
            scaling=task.bounds,
            n_actions=task.n_actions,
            sample_states=self.correspondence.states(self.grid.points()),
            exploration_threshold=kernel.exploration_threshold,
            min_weight=kernel.min_weight,
            min_fraction=kernel.min_fraction,
            state_names=tuple(task.state_names),
            action_names=tuple(task.action_names),
            periodic=self.periodic,
            takes_prior=self.model_class.takes_prior,
            gamma=self.rewards.gamma,
            max_value=self.rewards.max_value,
        )
        self._method.bind(target, self.rng)

    def _build(self, width: int | None = None) -> None:
        """Make model and planner, without any instances; ``width``: room for successors that rows have had before."""
        max_value, tolerance = self.rewards.max_value, self.settings.planning_tolerance
        self.mdp = FiniteMDP(self.grid, self.task.n_actions, self.rewards.gamma, width)
        self._asked = OfLearner(self._method, self.correspondence) if self._method.informs_model else None
        self.model = self.model_class(self.mdp, self.model_settings, self._asked)
        bounds = {"max_value": max_value, "min_value": min(0.0, max_value) - 1.0}
        self.planner = Planner(self.mdp, **bounds, tolerance=tolerance, follows_changes=self.model.follows_changes)
        self.promises = Promises(self.grid, self.task.n_actions)
        self._prior_version = -1
        # Pairs whose rows are to be updated: an interrupt in between loses none.
        self._outdated: list[np.ndarray] = []
        lowest = self._method.lowest_reward()
        check_finite(f"what {type(self._method).__name__}.lowest_reward returns", lowest)
        self._widen(lowest)

    def prepare(self) -> None:
        """Model what is transferred before the first step, and plan until the values have converged."""
        with self.lock:
            if self.transfer is not None and self.model.n_instances == 0:
                self._plan(SWEEPS_AT_EPISODE_END)

    def act(self, state: np.ndarray, explore: bool = True, environment: int = 0) -> int:
        """Choose an action.

        :param state: unit coordinates, shape (n_variables,)
        :param explore: whether to choose for learning: greedily, ties broken at random, so that optimistic actions come
            first. Otherwise the best of the actions that are known, or else modelled with transferred instances; where a
            source bounds the values, of all; by the values of :meth:`_function_of_frozen`.
        :param environment: in learning, the number of the environment, for a transfer method that decides actions
        :return: the action, from 0 on
        :raises ValueError: if a transfer method decides on something that is no action
        """
        with self.lock:
            if not explore:
                return self._exploit(state)
            decided = self._decided_by_transfer(state, environment) if self._transfer_decides else None
            return self._explore(state, environment) if decided is None else decided

    def _decided_by_transfer(self, state: np.ndarray, environment: int) -> int | None:
        """The action that the transfer method decides on; None if it leaves it to the agent."""
        self._method.environment = environment
        action = self._method.action(self.correspondence.states(state))
        if action is None:
            return None
        if isinstance(action, int | np.integer) and not isinstance(action, bool) and 0 <= action < self.task.n_actions:
            return int(action)
        raise ValueError(
            f"{type(self._method).__name__}.action must return None or a whole number from 0 to {self.task.n_actions - 1}, "
            f"got {action!r}"
        )

    def _explore(self, state: np.ndarray, environment: int) -> int:
        """The action of the largest value, or the one that is held where values do not keep their promise."""
        prediction, given, best = self._evaluate(state)
        if given is not None and self._asked is not None:
            self._asked.note_use(given)
        if best < 0:
            ties = np.flatnonzero(self._q.q == self._q.q.max())
            best = int(ties[self.rng.integers(len(ties))])
        chosen = self.promises.choose(environment, state, max(self._q.q.tolist()), best, self.rng)
        if not prediction.modelled[chosen]:
            self.n_optimistic_actions += 1
        return chosen

    def _evaluate(
        self, state: np.ndarray, function: ValueFunction | None = None
    ) -> tuple[Prediction, TransferredInstances | None, int]:
        """Compute the action values at a state; what is predicted and transferred there, and the best action, -1 for ties.

        :param function: the values of states; None: the learner's own
        """
        prediction, given = self.model.predict_at(state)
        return prediction, given, self._q.compute(prediction, state, function or self._function())

    def _function(self) -> ValueFunction:
        """The learner's own values of states."""
        planner = self.planner
        return ValueFunction(planner.values, self.grid.plain, self.mdp.gamma, planner.bounds, planner.worth)

    def update(
        self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool, environment: int = 0
    ) -> None:
        """Learn from one transition, and plan.

        :param state: unit coordinates; ``next_state``: the same
        :param action: from 0 on
        :param terminated: whether ``next_state`` is a terminal state; a time limit is none
        :param environment: see :meth:`act`
        """
        with self.lock:
            self.has_acted = True
            self._note_reward(reward, terminated)
            self._method.environment = environment
            self.promises.pay(environment, reward, self.mdp.gamma)
            self._take_in(state, action, reward, next_state, terminated)
            self._plan(SWEEPS_A_STEP)
            self._look_at_ends()
            self._move_lines()

    def break_off(self) -> None:
        """Take in that all environments have been reset, wherever they were."""
        with self.lock:
            self.promises.stays.clear()
            self._method.break_off()

    def end_episode(self, truncated: bool, environment: int = 0) -> None:
        """Plan on while no action is due.

        :param truncated: whether the episode ended by its time limit
        :param environment: see :meth:`act`
        """
        with self.lock:
            self.rewards.n_truncated += bool(truncated)
            self.promises.stays.pop(environment, None)
            self._method.environment = environment
            self._method.end_episode(truncated)
            self._outdated.append(self.model.end_episode())
            self._plan(SWEEPS_AT_EPISODE_END)

    def _take_in(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        """Give a transition to the model and to the transfer method."""
        if self._method.use == "prior":
            effect, leverage = self.model.predict_alone(state, action)
            self._method.note_prediction(self.correspondence.effects(effect), leverage)
        self._outdated.append(self.model.add(state, action, reward, next_state, terminated))
        before, after = self.correspondence.states(state), self.correspondence.states(next_state)
        self._method.observe(before, action, reward, after, terminated)

    def _note_reward(self, reward: float, terminated: bool) -> None:
        """Take in what a step has paid: how optimistic to be, and how low values may get."""
        self.rewards.note(reward, terminated)
        self._widen(reward)

    def _widen(self, reward: float) -> None:
        """Keep the lower bound of the values below what the worst reward seen could add up to."""
        low, high = self.planner.bounds
        self.planner.bounds = (min(low, min(0.0, high) + LONGEST_PLAN * min(0.0, reward)), high)

    def _plan(self, max_sweeps: int) -> None:
        """Update the rows of the pairs that changed, and sweep over the grid."""
        began = perf_counter()
        self._follow_rewards()
        if self._method.informs_model:
            self._outdated.append(self._changed_by_transfer())
        pairs = self._outdated[0] if len(self._outdated) == 1 else np.unique(np.concatenate([NO_PAIRS, *self._outdated]))
        self.model.update_all(pairs)
        self._outdated.clear()
        self._search()
        self.n_sweeps += self.planner.sweep(max_sweeps)
        self._cautious = None
        self.planning_seconds += perf_counter() - began

    def _follow_rewards(self) -> None:
        """Plan with other optimism, or another discount, if what rewards have shown asks for it."""
        gamma, max_value = self.rewards.gamma, self.rewards.max_value
        if gamma == self.mdp.gamma and max_value == self.planner.bounds[1]:
            return
        if gamma != self.mdp.gamma:
            self.mdp.gamma = gamma
            self._outdated.append(np.flatnonzero(self.mdp.arrays.modelled))
        self.planner.set_max_value(max_value)
        self._method.change_optimism(gamma, max_value)
        self._bound_values()

    def _changed_by_transfer(self) -> np.ndarray:
        """The pairs for which transfer has changed: all for a new prior, or those, not known, that may have new instances."""
        if self._method.use == "prior":
            if self._method.prior_version() != self._prior_version:
                self._prior_version = self._method.prior_version()
                self._bound_values()
            return self.model.renew_prior()
        known = self.model.known.reshape(self.task.n_actions, -1)
        changed: Any = self._method.changed(known)
        if isinstance(changed, bool | np.bool_):
            return np.flatnonzero(~self.model.known) if changed else NO_PAIRS
        if not isinstance(changed, np.ndarray) or changed.dtype != np.bool_ or changed.shape != known.shape:
            raise ValueError(
                f"{type(self._method).__name__}.changed must return True, False or an array of bools of shape {known.shape}, "
                f"got {reprlib.repr(changed)}"
            )
        return np.flatnonzero(changed.reshape(-1) & ~self.model.known)

    def _bound_values(self) -> None:
        """Take over what a prior bounds values by."""
        if self._method.use == "prior":
            self.planner.set_upper(self._method.value_bound())

    def _search(self) -> None:
        """Let places be worth what they are after the visits to them, as long as nothing has been found."""
        # Transferred instances tell what is where; a prior does so by its bound on values.
        if not self.model.searches or self.rewards.differ or self.transfers or self.model.n_instances == 0:
            self.planner.set_worth(None)
            return
        visits = self.model.own_weight.reshape(self.task.n_actions, -1).sum(axis=0)
        self.planner.set_worth(worth_after_visits(self.planner.upper, visits, self.rewards.lowest, self.mdp.gamma))

    @property
    def transfers(self) -> bool:
        """Whether there are pairs that transferred instances model."""
        return bool((self.mdp.arrays.modelled & ~self.model.known).any())

    def _exploit(self, state: np.ndarray) -> int:
        """The best of what is known: nobody has seen what the others do."""
        prediction, _, _ = self._evaluate(state, self._function_of_frozen())
        eligible = prediction.weight >= self.model.exploration_threshold
        if not eligible.any():
            eligible = prediction.modelled
        if (self.planner.is_bounded and self.has_acted) or not eligible.any():
            return int(self._q.q.argmax())
        return int(np.where(eligible, self._q.q, -np.inf).argmax())

    def _function_of_frozen(self) -> ValueFunction | None:
        """The values by which a frozen policy acts, those of what is known alone; None: the learner's own.

        These it has where a source says what the unknown is worth; and on a coarse grid where variables have no bounds: that
        ends where the agent has been, and caution towards its unknown points would drive a frozen policy beyond, where there
        are none. An agent that has only been given others' transitions is cautious in any case: it has not tried what it hopes
        for.

        Where lines move, the grid is what limits the policy, and these are values on a finer one. Where there is an end to be
        reached, they are not: a finer plan finds ways to it that nobody has tried, where the model is wrong. Where a grid is
        not coarse, an action is held until it leaves a cell; the cells of a coarse one are too large for that.
        """
        ends_coarsely = self.is_coarse and not self.task.is_bounded
        if self.has_acted and (self.transfer is not None or ends_coarsely):
            return None
        if self._cautious is None and self.mdp.arrays.modelled.any():
            finer = self._lines_move and self.transfer is None and self.task.is_bounded
            self._cautious = self._plan_cautiously(finer)
        return self._cautious

    def _plan_cautiously(self, finer: bool) -> ValueFunction:
        """Plan without optimism, from below, until the values have converged.

        :param finer: whether to fit and plan on a grid twice as fine, which takes seconds, if the model does so and there is
            room. Learning has no time for that at every step.
        """
        mdp, planner = self.mdp, self.planner
        if finer and self.model.plans_finer and (grid := self.grid.finer()).n_points * mdp.n_actions <= MAX_PAIRS_BY_DEFAULT:
            mdp, (low, high) = FiniteMDP(grid, mdp.n_actions, mdp.gamma), planner.bounds
            self.model.on(mdp)
            planner = Planner(mdp, max_value=high, min_value=low, tolerance=planner.tolerance)
        values = planner.cautious_values(LONGEST_PLAN)
        return ValueFunction(values, mdp.grid.plain, mdp.gamma, planner.bounds, planner.worth, holds=not self.is_coarse)

    def sample_action(self, state: np.ndarray) -> int:
        """Choose an action as in learning, optimistic ones first, but for a prediction: it does not change what is learned."""
        with self.lock:
            self._evaluate(state)
            return int(self.prediction_rng.choice(np.flatnonzero(self._q.q == self._q.q.max())))

    def q_values(self, state: np.ndarray) -> np.ndarray:
        """Compute the action values at an exact state.

        Optimistic actions have ``max_value``, or what a prior bounds it by; less where one has been and found nothing.

        :param state: unit coordinates, shape (n_variables,)
        :return: shape (n_actions,)
        :raises ValueError: if the state has another shape, or is not finite
        """
        state = np.ascontiguousarray(state, dtype=np.float64)
        if state.shape != (self.grid.n_variables,) or not np.isfinite(state).all():
            raise ValueError(f"state must be {self.grid.n_variables} finite numbers, got {state.tolist()}")
        beyond = np.abs(state - np.clip(state, 0.0, 1.0))
        if beyond[~self.grid.arrays.periodic].max(initial=0.0) > BEYOND:
            warn_user(
                f"the state {state.tolist()} is outside what has been seen, which is 0 to 1 in unit coordinates; of an "
                "observation, ask q_values(model.policy.to_unit(observation))"
            )
        return self._q_values(state)

    def _q_values(self, state: np.ndarray) -> np.ndarray:
        with self.lock:
            self._evaluate(state)
            return self._q.q.copy()

    def take_in(self, transitions: Sequence[Transition]) -> None:
        """Learn from past transitions of the task, in their order, and plan until little changes.

        :param transitions: state, action, reward, next state and terminated of each, as :meth:`update` takes them
        """
        with self.lock:
            for _, _, reward, _, terminated in transitions:
                self._note_reward(reward, terminated)
            # Episodes none of which has come to an end were broken off, as by a time limit.
            self.rewards.n_truncated += bool(transitions) and not any(terminated for *_, terminated in transitions)
            self._follow_rewards()
            self._take_in_all(transitions)
            self._plan(SWEEPS_AT_EPISODE_END)
            self._look_at_ends()
            self._move_lines()

    def _take_in_all(self, transitions: Sequence[Transition], observed: bool = False) -> None:
        """Give past transitions to model and transfer method; all pairs that they change are outdated.

        :param observed: whether the transfer method knows them
        """
        # Of what these change each pair once.
        outdated = np.zeros(len(self.model.known), dtype=np.bool_)
        try:
            for transition in transitions:
                if observed:
                    self._outdated.append(self.model.add(*transition))
                else:
                    self._take_in(*transition)
                    if transition[-1]:
                        self._method.end_episode(truncated=False)
                outdated[self._outdated.pop()] = True
        finally:
            outdated[self.model.outdated()] = True
            self._outdated.append(np.flatnonzero(outdated))

    @property
    def _lines_move(self) -> bool:
        """Whether the grid limits what can be had: it is coarse, and a place for staying has to be kept to exactly."""
        return self.is_coarse and self.rewards.for_ever

    def _move_lines(self) -> None:
        """Move the lines of a coarse grid to where values between them are wrong, whenever experience has grown by a quarter.

        That is by how much a value interpolated at a state differs from the best action's there; the latter half of the
        experience counts. Where there is an end to come to, lines stay: no place is for staying.
        """
        if not self._lines_move or (n := self.model.n_instances) < self._lines_due:
            return
        states, values = [state for state, *_ in self.model.transitions()[n // 2 :]], self.planner.values
        errors = [abs(self.grid.interpolate(values, state) - self._q_values(state).max()) for state in states]
        if max(errors) > 0.0:
            lines = moved_lines(self.grid, np.array(states), np.array(errors))
            self.rescale(self.task.scaling, self.task.bounds, lines)
        self._lines_due = int(np.ceil(LINES_AGAIN * n))

    def _look_at_ends(self) -> None:
        """Find out whether the action or where it leads decides how episodes end, whenever ends are twice as many."""
        if not self.model_class.asks_what_ends or self.rewards.n_ended < self._ends_due:
            return
        evidence, is_so = evidence_for_action(self.model.transitions()), self.model_settings.ends_by_action
        if (-evidence if is_so else evidence) > SURE_OF_ENDS:
            self.rescale(self.task.scaling, self.task.bounds, ends_by_action=not is_so)
        self._ends_due = 2 * self.rewards.n_ended

    def rescale(
        self, scaling: StateScaling, bounds: StateScaling, lines: np.ndarray | None = None, ends_by_action: bool | None = None
    ) -> None:
        """Compute all anew in other unit coordinates; an interrupt, or an error, leaves all as it was.

        :param scaling: raw <-> unit coordinates from now on; ``bounds``: as of :class:`~sb3_combrel.common.task.Task`
        :param lines: of the grid; None: as they are
        :param ends_by_action: whether the action decides how episodes end; None: as it is
        """
        with self.lock:
            attributes, generator, of_transfer = dict(vars(self)), self.rng.bit_generator.state, self._method.get_state()
            try:
                if ends_by_action is not None:
                    self.model_settings = replace(self.model_settings, ends_by_action=ends_by_action)
                self._rescale(scaling, bounds, self.grid.arrays.lines if lines is None else lines)
            except BaseException:
                vars(self).update(attributes)
                self._bind()
                self._method.set_state(of_transfer)
                self.rng.bit_generator.state = generator
                raise

    def _rescale(self, scaling: StateScaling, bounds: StateScaling, lines: np.ndarray) -> None:
        before, model, lowest = self.task.scaling, self.model, self.planner.bounds[0]
        transitions = model.transitions()
        # What a transfer method has learned is about the bounds.
        learned = self._method.get_state() if bounds == self.task.bounds else {}
        self.task, self.grid = replace(self.task, scaling=scaling, bounds=bounds), self.grid.with_lines(lines)
        self._bind()
        self._build(width=self.mdp.arrays.to.shape[2])
        if learned:
            self._method.set_state(learned)
            self._method.sample_moved()
        self.planner.bounds = (min(self.planner.bounds[0], lowest), self.planner.bounds[1])

        def moved(state: np.ndarray) -> np.ndarray:
            return scaling.to_unit(before.to_raw(state))

        if scaling != before:
            transitions = [(moved(s), a, r, moved(n), t) for s, a, r, n, t in transitions]
        self._take_in_all(transitions, observed=bool(learned))
        self._outdated.append(self.model.take_over(model))
        self._plan(SWEEPS_AT_EPISODE_END)

    def plan_anew(self) -> None:
        """Plan from the upper bounds on: what values were before does not count."""
        with self.lock:
            self.planner.restore(self.planner.upper)
            self._plan(SWEEPS_AT_EPISODE_END)

    def reseed(self, rng: np.random.Generator) -> None:
        """Go on with the random numbers of ``rng``, in the transfer method as well; predictions with some derived from it."""
        # The generator itself stays the same, as the transfer method has it too.
        self.rng.bit_generator.state = rng.bit_generator.state
        self.prediction_rng = rng.spawn(1)[0]

    def get_state(self) -> dict[str, np.ndarray]:
        """What has been learned, float64 arrays by name; only the number of rows of arrays with several axes ever changes."""
        with self.lock:
            return {
                **{f"{OF_TRANSFER}{name}": array for name, array in self._method.get_state().items()},
                **self.model.get_state(),
                **self.planner.get_state(),
                "has_acted": np.array([float(self.has_acted)]),
                "rewards": self.rewards.get_state(),
                "promises": self.promises.rows(),
                "lines": self.grid.arrays.lines.copy(),
                "lines_due": np.array([float(self._lines_due)]),
                "ends": np.array([float(self.model_settings.ends_by_action), float(self._ends_due)]),
            }

    def set_state(
        self, state: dict[str, np.ndarray], scaling: StateScaling | None = None, bounds: StateScaling | None = None
    ) -> None:
        """Take over what :meth:`get_state` returned, in unit coordinates of ``scaling``, in place of what was learned."""
        with self.lock:
            generator = self.rng.bit_generator.state
            self.task = self.task if scaling is None else replace(self.task, scaling=scaling, bounds=bounds or scaling)
            self.rewards.set_state(state["rewards"])
            self.grid, self._lines_due = self.grid.with_lines(state["lines"]), int(state["lines_due"][0])
            by_action, self._ends_due = bool(state["ends"][0] > 0.5), int(state["ends"][1])
            self.model_settings = replace(self.model_settings, ends_by_action=by_action)
            self._bind()
            self._build()
            of_transfer = [name for name in state if name.startswith(OF_TRANSFER)]
            self._method.set_state({name.removeprefix(OF_TRANSFER): state[name] for name in of_transfer})
            self.model.set_state(state)
            self.planner.bounds = (float(state["lowest_value"][0]), self.planner.bounds[1])
            self._bound_values()
            self.planner.set_state(state)
            self._search()
            self.promises.restore(state["promises"])
            self.has_acted, self._cautious = bool(state["has_acted"][0] > 0.5), None
            # What a method draws once more is no part of learning on.
            self.rng.bit_generator.state = generator

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, lock=threading.RLock())

    def statistics(self) -> dict[str, float]:
        """Figures for the logger, by name."""
        with self.lock:
            modelled, known = float(self.mdp.arrays.modelled.mean()), float(self.model.known.mean())
            return {
                "model/instances": self.model.n_instances,
                "model/known": known,
                "model/transferred": modelled - known,
                "model/optimistic": 1.0 - modelled,
                "planner/max_value": self.planner.bounds[1],
                "planner/gamma": self.mdp.gamma,
                **self._method.statistics(),
            }
