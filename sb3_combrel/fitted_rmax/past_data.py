"""Past data of the same task, which count as the learner's own experience, whatever has kept them."""

from __future__ import annotations

import os
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_combrel.common.scaling import LARGEST_BOUND, StateScaling
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.fitted_rmax.progress import ProgressWatch
from sb3_combrel.fitted_rmax.saving import SavedAlgorithm
from sb3_combrel.sources.experience import KINDS, read_experience, read_named
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.sources.transitions import describe_origin

# Warnings: an angle that spans more periods, and a value that lies beyond nearly all others by more ranges of theirs.
MANY_PERIODS, MANY_RANGES = 10, 20


class PastData(SavedAlgorithm):
    """What :class:`~sb3_combrel.FittedRMax` does with experience that it has not made itself."""

    env: VecEnv | None
    _last_states: np.ndarray | None
    _progress: ProgressWatch

    def load_instances(self, instances: Any, n_instances: int = 1000) -> Self:
        """Take in past transitions of the same task, as if the agent had made them: known at once, and planned with.

        They do not count as time steps. Scales that are found from observations, ``gamma`` and ``max_value`` follow them.
        For experience of a task with other states or actions there is ``transfer=COMBREL(source)``.

        :param instances: what holds experience, as of a source, see :func:`~sb3_combrel.sources.experience.read_experience`:
            :class:`~sb3_combrel.SourceInstances`, a file of them, a CSV file or that of a saved model, a pandas DataFrame
            (columns: :meth:`SourceInstances.from_table`), a Minari dataset or its id, a replay buffer, a model of this class
            or with a replay buffer; or any other model, or a function from one state, raw units, to an action, which then acts
            in the model's environment
        :param n_instances: steps that such a model or function makes in the environment
        :return: this model
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if they are of another task, by names or numbers of variables and actions, or are damaged; nothing
            is taken in then
        """
        past = self._of_this_task(self._read_instances(instances, n_instances))
        self.policy.take_in(past)
        self._progress.note_ends(past.rewards[past.terminated])
        if self._last_states is not None:
            # A callback has called this: scales may be other ones now.
            self._last_states = self.policy.to_unit(np.asarray(self._last_obs))
        return self

    def source_instances(self) -> SourceInstances:
        """The experience so far, raw units, in its order; a ValueError if there is none.

        With ``max_instances`` it is what has been kept; for observations outside the user's ``bounds`` the nearest inside.
        """
        agent = self.policy.agent
        transitions = agent.model.transitions()
        if not transitions:
            raise ValueError("the model has no experience yet: call learn(total_timesteps) or load_instances(...) first")
        states, actions, rewards, next_states, terminated = map(np.array, zip(*transitions, strict=True))
        scaling, task = agent.task.scaling, agent.task
        try:
            origin = {} if self.env is None else describe_origin(self.env, type(self).__name__, self.seed)
        except OSError:
            # The workers of a vectorised environment that has been closed do not answer.
            origin = {}
        return SourceInstances(
            *(scaling.to_raw(states), actions, rewards, scaling.to_raw(next_states), terminated, scaling.low, scaling.high),
            *(task.n_actions, tuple(task.state_names), tuple(task.action_names), origin, tuple(map(bool, agent.periodic))),
        )

    def _read_instances(self, given: Any, n_instances: int) -> SourceInstances:
        task = self.policy.agent.task
        names: dict[str, Any] = {
            "state_names": None if _are_numbered(task.state_names) else tuple(task.state_names),
            "action_names": () if _are_numbered(task.action_names) else tuple(task.action_names),
        }
        if isinstance(given, str | os.PathLike):
            return read_named("instances", given, names)
        if (found := read_experience(given, names)) is not None:
            return found
        if isinstance(given, type) or not (hasattr(given, "predict") or callable(given)):
            raise ValueError(
                f"instances must be {KINDS}; or a model or a controller, a function of the state that returns an action, got "
                f"{reprlib.repr(given)}"
            )
        return self._act(given, n_instances)

    def _act(self, controller: Callable[[np.ndarray], int] | Any, n_instances: int) -> SourceInstances:
        if self.env is None:
            raise ValueError("instances must be data where the model has no environment to act in: call set_env(env) first")
        if self._last_states is not None:
            raise ValueError(
                "instances must be data while the model learns, as its environment is in use: record a controller in another, "
                "load_instances(SourceInstances.record(controller, env, n_instances))"
            )
        found = SourceInstances.record(controller, self.env, n_instances, self.seed)
        # The environment is in the middle of an episode of the controller's: the next ``learn`` begins one of its own.
        self._last_obs = None
        return found

    def _of_this_task(self, found: SourceInstances) -> SourceInstances:
        """The instances with the variables and actions in the task's own order; a ValueError if they are of another task."""
        task = self.policy.agent.task
        other = "; for experience of another task there is transfer=COMBREL(source)"
        first = int(self.action_space.start)  # type: ignore[attr-defined]
        if found.n_variables != task.scaling.n_variables or found.n_actions > task.n_actions:
            if found.n_variables > task.scaling.n_variables:
                chosen = 'load_instances(SourceInstances.from_table(table, state_names=["x", ...]))'
                other = f"; where a table has other columns too, name those of the state: {chosen}{other}"
            if first != 0 and found.n_actions == task.n_actions + first:
                other = f"; actions are numbered from 0 on, those of the environment from {first}: subtract that{other}"
            raise ValueError(
                f"instances must have {task.scaling.n_variables} state variables and at most {task.n_actions} actions, as the "
                f"task has, got {found.n_variables} {found.state_names} and {found.n_actions} {found.action_names}{other}"
            )
        # What this package has recorded in an environment counts from 0 on.
        is_recorded = "package" in found.origin
        fits_both = first != 0 and found.actions.min() >= first and found.actions.max() < first + task.n_actions
        if fits_both and not is_recorded and _are_numbered(found.action_names):
            warn_user(
                f"the instances have actions from {found.actions.min()} to {found.actions.max()}, which count from 0 on; "
                f"those of the environment count from {first}: if the instances do so too, subtract that"
            )
        columns = _columns_of_variables(found.state_names, tuple(task.state_names), other)
        self._check_units(np.concatenate([found.states, found.next_states]), columns)
        numbers = _numbers_of_actions(found.action_names, tuple(task.action_names), other)
        return replace(
            found,
            states=found.states[:, columns],
            next_states=found.next_states[:, columns],
            actions=numbers[found.actions],
            low=found.low[columns],
            high=found.high[columns],
            n_actions=task.n_actions,
            state_names=tuple(task.state_names),
            action_names=tuple(task.action_names),
            periodic=tuple(np.array(found.periodic)[columns].tolist()),
        )

    def _check_units(self, states: np.ndarray, columns: np.ndarray) -> None:
        """Refuse states that lie farther beyond the observation space than it is wide: they are in other units, or damaged."""
        task, periodic = self.policy.agent.task, self.policy.agent.periodic
        low, high = StateScaling.limits_of(self.observation_space)
        for k, name in enumerate(task.state_names):
            least, most, width = states[:, columns[k]].min(), states[:, columns[k]].max(), high[k] - low[k]
            if not periodic[k] and (least < low[k] - width or most > high[k] + width):
                raise ValueError(
                    f"instances must be in the units of the task, got {name} from {least:.4g} to {most:.4g}; the observation "
                    f"space has it from {low[k]:.4g} to {high[k]:.4g}"
                )
            _warn_of_values(name, states[:, columns[k]], width, bool(periodic[k]))


def _warn_of_values(name: str, values: np.ndarray, width: float, periodic: bool) -> None:
    """Warn of an angle in other units, and, where the space has no bounds, of a value far from all others."""
    if periodic and np.ptp(values) > MANY_PERIODS * width:
        wrong = f"{name} from {values.min():.4g} to {values.max():.4g}, many periods of {width:.4g}"
        warn_user(f"the instances have {wrong}: convert it if its units are others than the task's, degrees")
    low, high = np.percentile(values, [1.0, 99.0])
    beyond = np.maximum(low - values, values - high)
    if not width < LARGEST_BOUND and beyond.max() > MANY_RANGES * (high - low) > 0.0:
        warn_user(
            f"the instances have {name}={values[beyond.argmax()]:.4g}, far from nearly all others, and variables without "
            "bounds are scaled by the range of what is observed: leave such rows out if they are errors of a sensor"
        )


def _are_numbered(names: Sequence[str]) -> bool:
    """Whether names are those that are given where a task has none: s0, s1, ... or a0, a1, ..."""
    return all(name[1:] == str(k) for k, name in enumerate(names))


def _columns_of_variables(given: tuple[str, ...], own: tuple[str, ...], other: str) -> np.ndarray:
    """Where each of the task's variables is among those given: by its name, or its place if one side has no names of its own.

    :raises ValueError: if both have names, and some are missing
    """
    lacking = [name for name in own if name not in given]
    if not lacking:
        return np.array([given.index(name) for name in own])
    numbered = _are_numbered(given), _are_numbered(own)
    if not any(numbered):
        raise ValueError(f"instances must have the state variables {own}, got {given}, without {lacking}{other}")
    if not all(numbered):
        taken = ", ".join(f"{name} as {of_task}" for name, of_task in zip(given, own, strict=True))
        warn_user(f"state variables of the instances have other names than the task's and are taken in their order: {taken}")
    return np.arange(len(own))


def _numbers_of_actions(given: tuple[str, ...], own: tuple[str, ...], other: str) -> np.ndarray:
    """The task's number of each given action; the same where one side has no names of its own."""
    if _are_numbered(given) or _are_numbered(own):
        return np.arange(len(given))
    unknown = [name for name in given if name not in own]
    if unknown:
        raise ValueError(f"instances must have the actions {own}, or some of them, got {given}, with {unknown}{other}")
    return np.array([own.index(name) for name in given])
