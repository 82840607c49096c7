"""The policy of Fitted R-Max: Q at a state, the greedy action, and how it learns."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_combrel.common.compiled import SameTypes
from sb3_combrel.common.scaling import StateScaling, scale_into_box
from sb3_combrel.common.transferred import Supply
from sb3_combrel.fitted_rmax.loop_detection import (
    HOPEFUL,
    TRUSTING,
    TRYING,
    EpisodeMemory,
    memories,
    predicted_reward,
    small_cell,
)
from sb3_combrel.fitted_rmax.restorable_policy import RestorablePolicy
from sb3_combrel.models.kernel_average import NO_PAIRS, KernelModel
from sb3_combrel.planning.corrections import PATIENCE, CorrectionArrays
from sb3_combrel.planning.grid import StateGrid, fitting_grid
from sb3_combrel.planning.q_values import QueryScratch, choose, find_near
from sb3_combrel.planning.sweeping import NOWHERE, Planner
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.by_name import describe_transfer, restore_transfer

# Lowest return that a state is given, in steps of the worst reward seen: far below every sensible plan, and near
# enough that one hopeless grid point does not drown its neighbours' interpolated values for long.
LONGEST_PLAN = 10_000

# By default so many corners of grid cells are looked at in a step: a backup costs as much as a cell has corners.
CORNERS_A_STEP = 400
# Backups in multiples of max_backups, passes over the grid, and backups for each pair that transfer has changed.
AT_EPISODE_END = 400
BEFORE_THE_FIRST_STEP = 300
BACKUPS_PER_RENEWED_PAIR = 2
NOBODY = (-1, 0.0, 0)


class FittedRMaxPolicy(RestorablePolicy):
    """
    Acts greedily on the action values of a kernel model (see :class:`FittedRMax` for the parameters).

    :param observation_space: a one-dimensional Box
    :param action_space: Discrete
    :param lr_schedule: not used; SB3 passes one to every policy
    :param transfer: a transfer method of the policy's own, bound here; or what a file has of one
    :param rng: source of all chance (ties, transfer)
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        *,
        model_breadth: float = 1 / 16,
        min_fraction: float = 0.01,
        min_weight: float = 0.01,
        exploration_threshold: float = 1.0,
        resolution: int | Sequence[int] | None = None,
        max_value: float = 0.0,
        gamma: float = 1.0,
        planning_tolerance: float = 0.001,
        max_backups: int | None = None,
        max_instances: int | None = 20_000,
        bounds: tuple[Any, Any] | None = None,
        transfer: Transfer | dict[str, Any] | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        rng: np.random.Generator | None = None,
    ):
        super().__init__(observation_space, action_space, normalize_images=False)
        self.kernel = (float(model_breadth), float(min_weight), float(min_fraction))
        self.gamma = float(gamma)
        self.n_truncated = 0
        self.transfer: Transfer | None = restore_transfer(transfer)
        self.rng = np.random.default_rng() if rng is None else rng
        self.scaling = StateScaling.from_space(observation_space, bounds)
        self.max_backups = max(1, CORNERS_A_STEP // 2**self.scaling.n_variables) if max_backups is None else max_backups
        self._low, self._range = self.scaling.low.copy(), self.scaling.high - self.scaling.low
        self._scale_into_box = SameTypes(scale_into_box)
        self._find_near, self._choose = SameTypes(find_near), SameTypes(choose)
        self._flat = (-1, self.scaling.n_variables)
        self.n_actions = int(action_space.n)
        self._first_action = int(action_space.start)
        self._constructor_parameters = dict(
            model_breadth=model_breadth,
            min_fraction=min_fraction,
            min_weight=min_weight,
            exploration_threshold=exploration_threshold,
            resolution=resolution,
            max_value=max_value,
            gamma=gamma,
            planning_tolerance=planning_tolerance,
            max_backups=max_backups,
            max_instances=max_instances,
            bounds=bounds,
        )
        grid = fitting_grid(self.scaling.n_variables, self.n_actions, resolution, model_breadth, min_weight)
        self.state_names = tuple(state_names or (f"s{k}" for k in range(grid.n_variables)))
        self.action_names = tuple(action_names or (f"a{k}" for k in range(self.n_actions)))
        if self.transfer is not None:
            self._task = self._target_task(grid, exploration_threshold)
            self.transfer.bind(self._task, self.rng)
        self.model = KernelModel(
            grid,
            self.n_actions,
            model_breadth=model_breadth,
            min_weight=min_weight,
            min_fraction=min_fraction,
            exploration_threshold=exploration_threshold,
            gamma=gamma,
            transfer=self.transfer,
            max_instances=max_instances,
        )
        self.planner = Planner(
            self.model, max_value=max_value, min_value=min(0.0, max_value) - 1.0, tolerance=planning_tolerance
        )
        if self.transfer is not None:
            self._widen(self.transfer.lowest_reward())
        self.corrections = CorrectionArrays.empty(grid.n_variables)
        self._query = QueryScratch.empty(self.n_actions, grid.n_variables, self.model.list_room)
        self._no_supply = self._supply = Supply.empty(self.n_actions, grid.n_variables)
        self._q = np.empty(self.n_actions)
        self._handed_on: tuple[Any, Any] = (None, None)
        self._episodes: list[EpisodeMemory] = []
        self._unsettled: list[np.ndarray] = []
        self._warned_outside = False
        self.timed, self.reporting = False, True
        self.planning_seconds = 0.0

    def _target_task(self, grid: StateGrid, exploration_threshold: float) -> TargetTask:
        return TargetTask(
            scaling=self.scaling,
            n_actions=self.n_actions,
            sample_states=grid.points(),
            exploration_threshold=float(exploration_threshold),
            min_weight=self.kernel[1],
            min_fraction=self.kernel[2],
            state_names=self.state_names,
            action_names=self.action_names,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        spaces_of_both = dict(observation_space=self.observation_space, action_space=self.action_space)
        return {**spaces_of_both, **self._constructor_parameters, "transfer": describe_transfer(self.transfer)}

    # ------------------------------------------------------------------ acting

    def to_unit(self, observations: np.ndarray) -> np.ndarray:
        """
        Unit coordinates of observations; what lies outside the bounds is moved to the boundary, with one warning.

        :param observations: raw units, shape (..., n_variables)
        :raises ValueError: if an observation is not finite
        """
        raw = np.asarray(observations, dtype=np.float64)
        inside = np.empty_like(raw)
        if self._scale_into_box(raw.reshape(self._flat), self._low, self._range, inside.reshape(self._flat)):
            self._check_outside(observations, self.scaling.to_unit(raw) - inside)
        return inside

    def _check_outside(self, observations: np.ndarray, excess: np.ndarray) -> None:
        """Refuse what is not finite, warn once of what is outside the bounds by more than rounding."""
        if not np.isfinite(excess).all():
            raise ValueError(f"the environment returned an observation that is not finite: {observations}")
        if not self._warned_outside and np.abs(excess).max() > 1e-6:
            self._warned_outside = True
            warnings.warn(
                f"the observation {observations} is outside the bounds low={self.scaling.low}, high={self.scaling.high} "
                "and counts as the nearest state inside; if this happens often, pass wider bounds=(low, high)",
                stacklevel=3,
            )

    def q_values(self, state: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        """
        Action values at an exact state; optimistic actions have ``max_value``.

        :param state: unit coordinates, shape (n_variables,)
        :param values: at the grid points; by default the planner's, optimistic ones
        :return: shape (n_actions,)
        """
        exact = np.ascontiguousarray(state, dtype=np.float64)
        self._choose_at(exact, self.planner.values if values is None else values, NOBODY)
        return self._q.copy()

    def _choose_at(self, state: np.ndarray, values: np.ndarray, visitor: tuple[int, float, int]) -> int:
        """Work out ``_q`` at a state, and note a visit there (see ``choose``); the best action, -1 if several are."""
        model = self.model
        least = self._find_near(model.instances, state, self.kernel, self._query)
        supply = self._no_supply
        if self.transfer is not None and least < model.exploration_threshold:
            supply = self.transfer.supply_at(state, self._query.total)
            supply.check(self.n_actions, len(state), self.transfer)
        # For whoever asks what stands behind ``_q``.
        self._supply = supply
        best: int = self._choose(
            model.instances,
            state,
            model.exploration_threshold,
            self.gamma,
            values,
            self.corrections,
            model.grid.arrays,
            self.planner.bounds,
            supply,
            self._query,
            self._q,
            visitor,
        )
        return best

    def explore(self, state: np.ndarray, episode: int) -> int:
        """
        The action to learn from: greedy, ties broken at random, so optimistic actions come first.

        :param state: unit coordinates, shape (n_variables,)
        :param episode: a number that tells the episodes of all environments apart
        :return: action, from 0 on
        """
        if self.corrections.count[0] == len(self.corrections.key):
            self.corrections = self.corrections.with_room()
        best = self._choose_at(state, self.planner.values, (episode, 5 * self.planner.tolerance, PATIENCE))
        if best >= 0:
            return best
        ties = np.flatnonzero(self._q == self._q.max())
        return int(ties[self.rng.integers(len(ties))])

    def exploit(self, state: np.ndarray, episode: EpisodeMemory | None = None) -> int:
        """
        The best action of those that are known; where none is, of those that have a model, from transferred instances.

        An evaluation must not depend on trying things out, and what a wrong mapping promises it would try for ever.

        :param state: unit coordinates, shape (n_variables,)
        :param episode: what is remembered of the episode so far; where it goes round in circles, things are tried out
        """
        mode = TRUSTING if episode is None else episode.mode
        q = self.q_values(state, self.planner.exploitation_values() if mode == TRUSTING else None)
        eligible = self._query.total >= self.model.exploration_threshold
        if not eligible.any():
            eligible = self._supply.count[: self.n_actions] > 0
        if mode == TRYING or (mode == HOPEFUL and not eligible.any()):
            eligible = np.ones(self.n_actions, dtype=np.bool_)
        action = int(np.where(eligible, q, -np.inf).argmax()) if eligible.any() else 0
        if episode is not None:
            of_model = self.model.instances, self._query, self._supply, self.model.exploration_threshold
            reward = predicted_reward(action, *of_model)
            episode.note(small_cell(state, self.model.grid), float(q[action]), reward, self.gamma)
        return action

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for observations.

        :param observation: one, or a batch of them
        :param state: what the last call returned, of the same environments. Who hands it on, as ``evaluate_policy`` and
            RL-Zoo do, gets a deterministic policy that notices when it goes round in circles; who doesn't, one that
            depends on the observation alone.
        :param episode_start: bool, one for each observation: whether an episode begins with it
        :param deterministic: the best known action; otherwise optimistic actions first, as in learning
        :return: actions, and the state for the next call (None if not deterministic)
        :raises ValueError: if ``state`` is not what a call for as many observations returned
        """
        self._handed_on = (state, episode_start)
        try:
            actions, _ = super().predict(observation, None, None, deterministic)
        finally:
            self._handed_on = (None, None)
        return actions, (np.array(self._episodes, dtype=object),) if deterministic else None

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        states = self.to_unit(np.asarray(observation.cpu().numpy(), dtype=np.float64))  # type: ignore[union-attr]
        if deterministic:
            self._episodes = memories(*self._handed_on, len(states))
            # With no state handed on there may be nobody who will: what costs time begins with the next call.
            remembered = self._episodes if self._handed_on[0] is not None else [None] * len(states)
            actions = list(map(self.exploit, states, remembered))
        else:
            actions = [self._sample(state) for state in states]
        return th.as_tensor(np.array(actions) + self._first_action, device=observation.device)  # type: ignore[union-attr]

    def _sample(self, state: np.ndarray) -> int:
        """Greedy with optimistic actions first, as in learning, but without a trace."""
        q = self.q_values(state)
        return int(self.rng.choice(np.flatnonzero(q == q.max())))

    # ---------------------------------------------------------------- learning

    def learn_from(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> int:
        """
        Take up one transition and plan.

        :param state: unit coordinates; ``next_state``: the same
        :param action: from 0 on
        :param terminated: in a terminal state; a time limit is none
        :return: backups done
        """
        self._widen(reward)
        self._unsettled.append(self.model.add(state, action, reward, next_state, terminated))
        if self.transfer is not None:
            self.transfer.observe(state, action, reward, next_state, terminated)
        return self._plan(self.max_backups, NOWHERE if terminated else next_state)

    def end_episode(self, truncated: bool) -> int:
        """Time to think: plan on while no action is due; backups done."""
        if truncated:
            self.n_truncated += 1
            self._unsettled.append(self.model.lower_threshold(self.n_truncated))
        if self.transfer is not None:
            self.transfer.end_episode(truncated)
            self._unsettled.append(self.model.waiting())
        return self._plan(AT_EPISODE_END * self.max_backups)

    def prepare(self) -> int:
        """Take up what transfer has to say before the first step, and plan until that is thought through."""
        # Episodes are numbered anew.
        self.corrections.visits.fill(0)
        backups = self._plan(0)
        if self.transfer is None and self.model.n_instances == 0:
            return backups
        self.planner.start_anew()
        return backups + self.planner.sweep_all(BEFORE_THE_FIRST_STEP)

    def _plan(self, max_backups: int, around: np.ndarray = NOWHERE) -> int:
        """Plan, and note how long it took if that is wanted (``timed``); backups done."""
        if not self.timed:
            return self._settle_and_plan(max_backups, around)
        began = perf_counter()
        backups = self._settle_and_plan(max_backups, around)
        self.planning_seconds += perf_counter() - began
        return backups

    def _settle_and_plan(self, max_backups: int, around: np.ndarray) -> int:
        """Settle the pairs that changed, and plan; longer where transfer changed many pairs at once."""
        passes = 0
        if self.transfer is not None:
            renewed = self.transfer.renewed(self.model.arrays.known)
            if len(renewed):
                self._unsettled.append(renewed)
                backups = BACKUPS_PER_RENEWED_PAIR * len(renewed)
                passes = backups // self.model.grid.n_points
                max_backups += backups if passes == 0 else 0
        if not self._unsettled:
            return self.planner.update(NO_PAIRS, max_backups, around)
        # Left on the list until all is done: an interrupt in between loses no change.
        pairs = self._unsettled[0] if len(self._unsettled) == 1 else np.unique(np.concatenate(self._unsettled))
        backups = self.planner.update(pairs, max_backups, around)
        self._unsettled.clear()
        return backups + (self.planner.sweep_all(passes) if passes else 0)

    def _widen(self, reward: float) -> None:
        """Keep the lower bound of the values below what the worst reward seen could add up to."""
        low, high = self.planner.bounds
        lowest = min(0.0, high) + LONGEST_PLAN * min(0.0, reward)
        if lowest < low:
            self.planner.bounds = (lowest, high)

    def statistics(self) -> dict[str, float]:
        """Figures for the logger, by name."""
        arrays = self.model.arrays
        settled = float(arrays.settled.mean())
        known = float(arrays.known.mean())
        figures = {
            "model/instances": self.model.n_instances,
            "model/known": known,
            "model/transferred": settled - known,
            "model/optimistic": 1.0 - settled,
            "model/threshold": self.model.exploration_threshold,
            "planner/waiting": self.planner.n_waiting,
            "planner/corrections": int(self.corrections.count[0]),
        }
        return figures if self.transfer is None else {**figures, **self.transfer.statistics()}
