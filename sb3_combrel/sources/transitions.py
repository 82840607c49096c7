"""Transitions of a task as arrays, before they become source instances, the log that collects them, and what the task says."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_combrel.common.attributes import attribute, names_of, periodic_of
from sb3_combrel.common.checks import as_count
from sb3_combrel.common.periodic import check_periods, flag_array
from sb3_combrel.common.scaling import Bounds, Limits, StateScaling
from sb3_combrel.common.version import __version__

Floats = NDArray[np.float64]
AnyEnv = VecEnv | gym.Env[Any, Any]

_MAX_TRANSITIONS = 10**8


def as_transition_count(name: str, value: object) -> int:
    """A number of transitions, steps or episodes; ``ValueError`` unless it is whole, at least 1 and fits into memory."""
    return as_count(name, value, max=_MAX_TRANSITIONS, why_max="more transitions do not fit into memory")


class Transitions(NamedTuple):
    """Transitions and the spaces that they come from; the fields are those of :class:`~sb3_combrel.SourceInstances`."""

    states: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    next_states: Floats
    terminated: NDArray[np.bool_]
    low: Floats
    high: Floats
    n_actions: int
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    origin: Mapping[str, Any] = MappingProxyType({})
    periodic: tuple[bool, ...] = ()

    @classmethod
    def within(
        cls, limits: Limits, columns: Iterable[Any], n_actions: int, names: Mapping[str, Any], origin: Mapping[str, Any]
    ) -> Transitions:
        """Take the first five fields, ``columns``, with names, and (low, high) of the states; what is infinite is found."""
        states, actions, rewards, next_states, terminated = columns
        scaling = StateScaling.from_observed(limits, np.concatenate([states, next_states]))
        bounds = scaling.low, scaling.high
        return cls(states, actions, rewards, next_states, terminated, *bounds, n_actions, origin=origin, **names)


#: By name, what learns a source task: called with the environment or its id, the seed, how long, and a dict of arguments.
LEARNERS: dict[str, Callable[[str | gym.Env[Any, Any], int | None, int, dict[str, Any]], Transitions]] = {}


class TransitionLog:
    """Transitions in the order in which they came; of more than ``max_instances`` a uniform random sample."""

    def __init__(self, max_instances: int | None = None, seed: int | None = None) -> None:
        self.max_instances = None if max_instances is None else as_count("max_instances", max_instances)
        self.n_seen = 0
        self._rng = np.random.default_rng(seed)
        self._rows: list[tuple[int, NDArray[Any], int, float, NDArray[Any], bool]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, state: NDArray[Any], action: int, reward: float, next_state: NDArray[Any], terminated: bool) -> None:
        """Add a transition, in raw units; states are not copied. ``ValueError`` if a state or the reward is not finite."""
        when = f"in transition {self.n_seen}"
        check_observation(state, when)
        check_observation(next_state, when)
        row = (self.n_seen, state, int(action), check_reward(reward, when), next_state, bool(terminated))
        self.n_seen += 1
        if self.max_instances is None or len(self._rows) < self.max_instances:
            self._rows.append(row)
            return
        position = int(self._rng.integers(self.n_seen))
        if position < self.max_instances:
            self._rows[position] = row

    def transitions(self, limits: Limits, n_actions: int, names: Mapping[str, Any], origin: Mapping[str, Any]) -> Transitions:
        """What is in the log, see :meth:`Transitions.within`; ``ValueError`` if that is nothing."""
        if not self._rows:
            raise ValueError("nothing has been recorded yet: no step was taken in the source task")
        _, *columns = zip(*sorted(self._rows, key=lambda row: row[0]), strict=True)
        kinds = np.float64, np.int64, np.float64, np.float64, np.bool_
        arrays: list[Any] = [np.array(column, dtype=kind) for column, kind in zip(columns, kinds, strict=True)]
        return Transitions.within(limits, arrays, n_actions, names, origin)


def check_observation(observation: Any, when: str) -> None:
    """Raise ``ValueError`` if an observation of one or more states is not finite, saying when it was returned."""
    try:
        finite = bool(np.isfinite(observation).all())
    except TypeError:
        finite = False
    if not finite:
        raise ValueError(f"the environment returned an observation that is not finite, {when}: {observation!r}")


def check_reward(reward: Any, when: str) -> float:
    """Return a reward as a float; ``ValueError`` if it is not a finite number, saying when it was returned."""
    try:
        number = float(reward)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise ValueError(f"the environment returned a reward that is not a finite number, {when}: {reward!r}")
    return number


def count_actions(space: spaces.Space[Any]) -> int:
    """Number of actions of an action space; ``ValueError`` if it is not a ``Discrete``."""
    if not isinstance(space, spaces.Discrete):
        raise ValueError(f"the action space must be Discrete, got {space}")
    return int(space.n)


def limits_of_task(env: VecEnv, bounds: Bounds | None) -> Limits:
    """Bounds of the states of a task: those given, or those of its space, some of which may be infinite.

    :raises ValueError: if the space is no one-dimensional Box, the bounds do not fit it, or a periodic variable has none
    """
    low, high = StateScaling.limits_of(env.observation_space, bounds)
    check_periods(~(np.isfinite(low) & np.isfinite(high)) & flag_array(task_names(env).get("periodic"), len(low)))
    return low, high


def make_env(env: str | gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """The environment of an id, see :func:`full_id`, or the one given."""
    return gym.make(full_id(env)) if isinstance(env, str) else env


def full_id(env: Any) -> Any:
    """An id with its module, as this project's environments need no import of ``combrel_envs`` then; or what else is given."""
    return f"combrel_envs:{env}" if isinstance(env, str) and env.startswith("combrel/") else env


def task_names(env: AnyEnv) -> dict[str, tuple[Any, ...]]:
    """``state_names`` and ``action_names`` of a task, and which of its states are ``periodic``, as far as it says so."""
    found = {**names_of(env), "periodic": periodic_of(env) or ()}
    return {name: tuple(values) for name, values in found.items() if values}


def describe_origin(env: AnyEnv, recorder: str, seed: int | None) -> dict[str, Any]:
    """Where instances come from: id of the environment, what acted in it (``recorder``), seed and version of this package."""
    spec = attribute(env, "spec")
    package = f"sb3-combrel {__version__}"
    return {"env": None if spec is None else spec.id, "recorder": recorder, "seed": seed, "package": package}
