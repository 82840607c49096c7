"""Transitions of a task as arrays, before they become source instances, and the log that collects them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_combrel.common.checks import as_count
from sb3_combrel.common.scaling import StateScaling

Floats = NDArray[np.float64]

MAX_STEPS = 10**8
WHY_MAX_STEPS = "more transitions do not fit into memory"


class Transitions(NamedTuple):
    """
    Transitions and the spaces that they come from; the fields are those of :class:`~sb3_combrel.SourceInstances`.

    :param states: where each transition starts, raw units, shape (n, n_variables)
    :param actions: int64, from 0 on, shape (n,)
    :param rewards: shape (n,)
    :param next_states: where it ends, raw units, shape (n, n_variables)
    :param terminated: bool, shape (n,): whether it reached a terminal state
    :param low: lower bounds of the states, raw units, shape (n_variables,)
    :param high: upper bounds of the states, raw units, shape (n_variables,)
    :param n_actions: number of actions of the task
    :param state_names: names of the state variables, () if not known
    :param action_names: names of the actions, () if not known
    :param origin: where the transitions came from, a dict that JSON can hold
    :param periodic: which state variables are periodic, () for none
    """

    states: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    next_states: Floats
    terminated: NDArray[np.bool_]
    low: Floats
    high: Floats
    n_actions: int
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    origin: Mapping[str, Any]
    periodic: tuple[bool, ...] = ()


class TransitionLog:
    """
    Transitions in the order in which they came; of too many, a uniform random sample.

    :param max_instances: how many to keep at most (reservoir sampling); None for all
    :param seed: seed of the sample
    :param giver: where transitions come from, for messages
    :raises ValueError: if ``max_instances`` is not a whole number of at least 1 or None
    """

    def __init__(self, max_instances: int | None = None, seed: int | None = None, giver: str = "the environment") -> None:
        self.max_instances = None if max_instances is None else as_count("max_instances", max_instances)
        self.n_seen = 0
        self._giver = giver
        self._rng = np.random.default_rng(seed)
        self._rows: list[tuple[int, NDArray[Any], int, float, NDArray[Any], bool]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, state: NDArray[Any], action: int, reward: float, next_state: NDArray[Any], terminated: bool) -> None:
        """
        Add a transition. The arrays are kept, not copied.

        :param state: raw units, shape (n_variables,)
        :param action: its action, from 0 on
        :param reward: its reward
        :param next_state: raw units, shape (n_variables,)
        :param terminated: whether ``next_state`` is terminal
        :raises ValueError: if a state or the reward is not finite
        """
        when = f"in transition {self.n_seen}"
        check_observation(state, when, self._giver)
        check_observation(next_state, when, self._giver)
        row = (self.n_seen, state, int(action), check_reward(reward, when, self._giver), next_state, bool(terminated))
        self.n_seen += 1
        if self.max_instances is None or len(self._rows) < self.max_instances:
            self._rows.append(row)
            return
        position = int(self._rng.integers(self.n_seen))
        if position < self.max_instances:
            self._rows[position] = row

    def transitions(
        self, scaling: StateScaling, n_actions: int, names: Mapping[str, Sequence[Any]], origin: Mapping[str, Any]
    ) -> Transitions:
        """
        What is in the log.

        :param scaling: bounds of the states
        :param n_actions: number of actions of the task
        :param names: ``state_names``, ``action_names`` and ``periodic``, as far as known
        :param origin: where the transitions came from
        :raises ValueError: if there are no transitions
        """
        if not self._rows:
            raise ValueError("nothing has been recorded yet: no step was taken in the source task")
        _, states, actions, rewards, next_states, terminated = zip(*sorted(self._rows, key=lambda row: row[0]), strict=True)
        return Transitions(
            np.array(states, dtype=np.float64),
            np.array(actions, dtype=np.int64),
            np.array(rewards, dtype=np.float64),
            np.array(next_states, dtype=np.float64),
            np.array(terminated, dtype=np.bool_),
            scaling.low,
            scaling.high,
            n_actions,
            tuple(names.get("state_names", ())),
            tuple(names.get("action_names", ())),
            origin,
            tuple(names.get("periodic", ())),
        )


def check_observation(observation: Any, when: str, giver: str = "the environment") -> None:
    """
    :param observation: one state, shape (n_variables,), or several
    :param when: when it was returned, for the message
    :param giver: what returned it, for the message
    :raises ValueError: if it is not finite
    """
    try:
        finite = bool(np.isfinite(observation).all())
    except TypeError:
        finite = False
    if not finite:
        raise ValueError(f"{giver} returned an observation that is not finite, {when}: {observation!r}")


def check_reward(reward: Any, when: str, giver: str = "the environment") -> float:
    """
    :param reward: one reward
    :param when: when it was returned, for the message
    :param giver: what returned it, for the message
    :return: the reward as a float
    :raises ValueError: if it is not a finite number
    """
    try:
        number = float(reward)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise ValueError(f"{giver} returned a reward that is not a finite number, {when}: {reward!r}")
    return number


def count_actions(space: spaces.Space[Any]) -> int:
    """
    Number of actions of a discrete action space.

    :param space: the action space
    :raises ValueError: if it is not a ``Discrete``
    """
    if not isinstance(space, spaces.Discrete):
        raise ValueError(f"the action space must be Discrete, got {space}")
    return int(space.n)
