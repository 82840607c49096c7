"""An upper bound on what a target's states are worth: the value of the source's, through a mapping."""

from __future__ import annotations

import dataclasses

import numpy as np

from sb3_combrel.common.constants import MAX_MODEL_STEPS, SWEEPS_AT_EPISODE_END
from sb3_combrel.planning.planner import Planner
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.prior.copies import Copies, distinct_rows
from sb3_combrel.transfer.prior.prior_choice import Choice
from sb3_combrel.transfer.source_policy import plan_source

#: States, rewards and effects.
Episode = list[tuple[np.ndarray, float, np.ndarray]]
# What a source's data must weigh to bound a value: an instance that lies one and a half breadths away does.
LEAST_WEIGHT = 0.1


class ValueBound:
    """Bounds the values of the target's states by those of the source's states that they are taken for.

    R-Max with an admissible potential (Asmuth, Littman & Zinkov, "Potential-based shaping in model-based reinforcement
    learning", AAAI 2008), which comes from another task through a mapping, as in Mann & Choe, "Directed exploration in
    reinforcement learning with transferred knowledge", EWRL 2012.

    The source's values are those of Fitted R-Max's planning with its local linear model: where it has no data to speak of (a
    weight below ``LEAST_WEIGHT``), a pair is worth ``max_value``. Actions that no instance has taken are left out: they would
    be worth that everywhere, and so would every state. A target of several copies ends when all of them have ended:
    if every step costs the same, the least of their values bounds it. Otherwise nothing is said of several.

    A bound is contradicted by one thing only: a return to go that exceeds it, see :meth:`excess`.
    """

    def __init__(self, copies: Copies, task: TargetTask):
        self._copies = copies
        self._task = task
        #: By number of the source: a planner that has its values.
        self._planners: dict[int, Planner] = {}
        self._of_copy: dict[int, np.ndarray] = {}

    def through(self, choice: Choice) -> np.ndarray | None:
        """Bound the values of all states of the target's sample, shape (n_points,).

        :param choice: of copies that have all variables of their source
        :return: None if nothing bounds them: if actions are taken for those of different copies or for some that the source's
            instances lack, there is no copy, or several do not cost the same at every step
        """
        used = choice.same_copies()
        if not self._copies.taken[choice.copies, choice.actions][(choice.copies >= 0) & (choice.actions >= 0)].all():
            return None
        if len(used) > 1 and not self._costs_are_alike(used):
            return None
        return np.minimum.reduce([self._bound(copy) for copy in used]) if used else None

    def excess(self, choice: Choice, episode: Episode) -> float:
        """Return by how much the returns to go of an episode exceed what the source's values bound them by, at least 0.

        Within a cell of the source's grid a value is no more than the largest at its corners.

        :param choice: that bounds values
        :param episode: states, unit coordinates, rewards and effects
        """
        states, returns, to_go = np.array([state for state, *_ in episode]), np.zeros(len(episode)), 0.0
        for i in range(len(episode) - 1, -1, -1):
            returns[i] = to_go = episode[i][1] + self._task.gamma * to_go
        seen = [self._seen_by(copy, states) for copy in choice.same_copies()]
        bounds = np.minimum.reduce([of.values[of.mdp.grid.cells_around(at)].max(axis=1) for of, at in seen])
        return float((returns - bounds).max(initial=0.0))

    def _costs_are_alike(self, used: list[int]) -> bool:
        rewards = np.concatenate([self._copies.sources[self._copies.source[copy]].rewards for copy in used])
        return bool(rewards.max() <= 0.0 and rewards.max() - rewards.min() <= 1e-9)

    def _bound(self, copy: int) -> np.ndarray:
        """The source's value at the state that each state of the target's sample is in a copy."""
        if copy not in self._of_copy:
            planner, at = self._seen_by(copy, self._task.sample_states)
            different, kind = distinct_rows(at)
            self._of_copy[copy] = np.array([planner.mdp.grid.interpolate(planner.values, at[i]) for i in different])[kind]
        return self._of_copy[copy]

    def _seen_by(self, copy: int, states: np.ndarray) -> tuple[Planner, np.ndarray]:
        """The planner of a copy's source, and states of the target as states of it."""
        number = int(self._copies.source[copy])
        if number not in self._planners:
            self._planners[number] = self._plan(self._copies.sources[number])
        planner = self._planners[number]
        return planner, self._copies.as_copy(copy, states)[:, : planner.mdp.grid.n_variables]

    def _plan(self, source: SourceInstances) -> Planner:
        """Plan in a source, from above: values are upper bounds after any number of sweeps."""
        taken, actions = np.unique(source.actions, return_inverse=True)
        source = dataclasses.replace(source, actions=actions, n_actions=len(taken), action_names=())
        gamma, max_value = self._task.gamma, self._task.max_value
        # Lower than so many sweeps can get.
        n_steps = (SWEEPS_AT_EPISODE_END + 1) * MAX_MODEL_STEPS
        lowest = min(0.0, max_value) + n_steps * min(0.0, float(source.rewards.min())) - 1.0
        _, planner = plan_source(source, gamma, self._copies.breadth, LEAST_WEIGHT, (lowest, max_value))
        planner.sweep(SWEEPS_AT_EPISODE_END)
        return planner
