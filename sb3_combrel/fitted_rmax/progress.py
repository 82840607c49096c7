"""Warnings where learning cannot make progress, or makes none, which an unsuitable ``max_value`` often causes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import VecEnv

from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.fitted_rmax.optimism import RewardRange

# So many episodes in a row are no coincidence.
IDLE_EPISODES = 3
EQUAL_RETURNS = 20
# Longer than the time limits of most tasks.
MANY_STEPS = 1000


class ProgressWatch:
    """Looks at the episodes of learning, and warns once of each of seven things.

    - A return above ``max_value``: then that is no upper bound, and exploration ends too soon.
    - Episodes that cost nothing: all rewards are 0, and gamma is 1 or ``max_value`` is 0. What is known then keeps the value
      ``max_value`` of what is unknown, and nothing draws the agent to the unknown.
    - Episodes that all end by their time limit, with gamma 1.
    - No end of an episode, and no time limit that anybody knows of, with gamma 1.
    - Rewards none of which planning tells from 0.
    - Returns that are all exactly alike, at the time limit, while actions are still tried for the first time or nothing has
      told states apart: nothing that exploration reaches makes a difference.
    - Returns, discounted, that are all exactly alike from the first episode on, however they end, while actions are tried.
    """

    def __init__(self, rewards: RewardRange, tolerance: float):
        self.rewards, self.tolerance = rewards, float(tolerance)
        self._n_idle = self._n_equal = self._n_optimistic = 0
        self._last_return: float | None = None
        # Of the first episodes: discounted returns, whether actions were tried in any, and the largest reward in size.
        self._values: list[float] = []
        self._has_explored, self._largest, self._n_steps = False, 0.0, 0
        self._warned: set[str] = set()

    def note(self, rewards: Sequence[float], terminated: bool, n_optimistic_actions: int) -> None:
        """Look at an episode.

        :param terminated: whether it ended in a terminal state, not by its time limit
        :param n_optimistic_actions: how often an action without a model was chosen since learning began
        """
        # What follows a time limit may cost more than was gained until then.
        if terminated or min(rewards) >= 0.0:
            self._note_best_return(rewards)
        self._note_cost(rewards, terminated)
        self._note_endless()
        explored, self._n_optimistic = n_optimistic_actions > self._n_optimistic, n_optimistic_actions
        self._note_return(rewards, terminated, explored)
        if len(self._values) < EQUAL_RETURNS:
            self._note_first(rewards, explored)

    def note_step(self, env: VecEnv) -> None:
        """Look at the number of steps; ``env`` is the environment in which they are made."""
        self._n_steps += 1
        if self._n_steps != MANY_STEPS:
            return
        seen = self.rewards
        if seen.gamma == 1.0 and seen.n_ended == seen.n_truncated == 0 and not any(env.env_is_wrapped(TimeLimit)):
            self._warn(
                "endless",
                f"gamma=1, and after {MANY_STEPS} steps no episode has ended: if the task has no end, plans never settle; "
                "pass gamma=0.99, or gymnasium.wrappers.TimeLimit(env, max_episode_steps=...)",
            )

    def note_ends(self, rewards: np.ndarray) -> None:
        """Look at what ends of episodes have paid in past data, shape (n_ends,)."""
        if len(rewards) > 0:
            self._note_best_return([float(rewards.max())])

    def _note_best_return(self, rewards: Sequence[float]) -> None:
        gamma, max_value = self.rewards.gamma, self.rewards.max_value
        best = max(_discounted(rewards, gamma))
        if best > max_value + 1e-6 * max(1.0, abs(max_value)):
            advice = "pass a larger max_value"
            if self.rewards.finds_max_value and gamma == 1.0:
                advice = "with gamma=1 and rewards above 0 none is found: leave gamma out, pass one below 1, or pass max_value"
            self._warn(
                "exceeded",
                f"max_value={max_value:g} must be an upper bound on the return (discounted with gamma={gamma:g}), "
                f"but a return of {best:g} was observed; {advice}, or the agent will stop exploring too soon",
            )

    def _note_cost(self, rewards: Sequence[float], terminated: bool) -> None:
        gamma, max_value = self.rewards.gamma, self.rewards.max_value
        keeps_value = gamma == 1.0 or abs(max_value) <= self.tolerance
        idle = keeps_value and not terminated and sum(map(abs, rewards)) <= self.tolerance
        self._n_idle = self._n_idle + 1 if idle else 0
        if self._n_idle == IDLE_EPISODES:
            self._warn(
                "idle",
                f"max_value={max_value:g} with gamma={gamma:g}: {IDLE_EPISODES} episodes in a row had no reward but "
                "0, and steps that cost nothing keep the value of what is known at max_value, so that nothing draws the agent "
                "to what is unknown. Pass the largest return that the task can give as max_value, such as the reward of its "
                "goal, above 0, and a gamma below 1, such as gamma=0.99",
            )

    def _note_endless(self) -> None:
        seen = self.rewards
        if seen.gamma == 1.0 and seen.n_ended == 0 and seen.n_truncated >= EQUAL_RETURNS:
            self._warn(
                "endless",
                f"gamma=1, and all {seen.n_truncated} episodes have ended by their time limit: if the task has no end, "
                "returns grow without limit, and plans never settle; leave gamma out, or pass gamma=0.99",
            )

    def _note_return(self, rewards: Sequence[float], terminated: bool, explored: bool) -> None:
        total, gamma, max_value = sum(rewards), self.rewards.gamma, self.rewards.max_value
        # Where rewards are collected until the time limit it is a success to reach it.
        searches = explored or not self.rewards.differ
        stuck = searches and not terminated and min(rewards) <= 0.0
        self._n_equal = (self._n_equal + 1 if total == self._last_return else 1) if stuck else 0
        self._last_return = total
        if self._n_equal == EQUAL_RETURNS:
            self._warn(
                "equal",
                f"the last {EQUAL_RETURNS} returns are all {total:g}, though the agent explores, with "
                f"max_value={max_value:g} and gamma={gamma:g}: nothing that it has reached makes a difference. A "
                "max_value must be above the return of a good policy, but not by far; with a larger model_breadth, or a "
                "longer time limit, exploration gets farther",
            )

    def _note_first(self, rewards: Sequence[float], explored: bool) -> None:
        gamma = self.rewards.gamma
        self._values.append(_discounted(rewards, gamma)[-1])
        self._has_explored = self._has_explored or explored
        self._largest = max(self._largest, *map(abs, rewards))
        if len(self._values) < EQUAL_RETURNS:
            return
        if 0.0 < self._largest <= self.tolerance:
            self._warn(
                "tiny",
                f"no reward so far is larger than {self._largest:g}, and plans are good to planning_tolerance="
                f"{self.tolerance:g}: pass planning_tolerance={self.tolerance * self._largest:.2g}, or larger rewards",
            )
        if len(set(self._values)) == 1 and self._has_explored and "equal" not in self._warned:
            sooner = "; with gamma=1 it does not matter how soon an end pays, as it does with gamma=0.99"
            self._warn(
                "alike",
                f"all {EQUAL_RETURNS} episodes so far have the same return, {self._values[0]:g} (discounted with "
                f"gamma={gamma:g}), though the agent has tried other actions: nothing that it did has made a difference. "
                f"Unless something is yet to be found, look at the task's rewards and ends{sooner if gamma == 1.0 else ''}",
            )

    def _warn(self, of: str, message: str) -> None:
        if of not in self._warned:
            self._warned.add(of)
            warn_user(message)


def _discounted(rewards: Sequence[float], gamma: float) -> list[float]:
    """The discounted returns from each step of an episode on, that of the last step first."""
    return list(accumulate(reversed(rewards), lambda value, reward: reward + gamma * value))
