"""Recording transitions from vectorised environments: with a given behaviour, or while an SB3 algorithm learns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.sources.transitions import (
    TransitionLog,
    Transitions,
    as_transition_count,
    check_observation,
    count_actions,
    describe_origin,
    make_env,
    task_names,
)

Behaviour = PolicyPredictor | Callable[[NDArray[Any]], int]
"""What can be recorded: anything with SB3's ``predict``, or a function from one state to an action."""

_fitted_rmax: list[Callable[..., BaseAlgorithm]] = []


class TransitionRecorder(BaseCallback):
    """See :class:`~sb3_combrel.sources.source_recorder.SourceRecorder`; gives :meth:`transitions`."""

    def __init__(
        self, max_instances: int | None = None, bounds: Bounds | None = None, seed: int | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.bounds = bounds
        self.seed = seed
        self.log = TransitionLog(max_instances, seed)
        self._states: NDArray[Any] | None = None

    def _on_training_start(self) -> None:
        # Refuse spaces now, not after hours of learning.
        self._scaling = StateScaling.from_space(self.training_env.observation_space, self.bounds)
        self._n_actions = count_actions(self.training_env.action_space)
        self._names = task_names(self.training_env)
        self._origin = describe_origin(self.training_env, type(self.model).__name__, self.model.seed)
        self._states = _raw_states(self.training_env, self.model._last_obs)  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        missing = {"actions", "new_obs", "rewards", "dones", "infos"} - set(self.locals)
        if missing or self._states is None:
            raise ValueError(
                f"{type(self).__name__} cannot record {type(self.model).__name__}: its callbacks have no {sorted(missing)}; "
                "record the trained model with SourceInstances.record(model, env)"
            )
        step = (self.locals["new_obs"], self.locals["rewards"], self.locals["dones"], self.locals["infos"])
        self._states = _log_step(self.log, self.training_env, self._states, self.locals["actions"], step)
        return True

    def transitions(self) -> Transitions:
        """What has been recorded so far; ``ValueError`` if nothing has been."""
        if self._states is None:
            raise ValueError("nothing has been recorded yet: pass the recorder to learn(callback=...) first")
        origin = {**self._origin, "recorded_while_learning": True, "n_seen": self.log.n_seen}
        return self.log.transitions(self._scaling, self._n_actions, self._names, origin)


def register_fitted_rmax(fitted_rmax: Callable[..., BaseAlgorithm]) -> None:
    """Hand in the learner, defined above this package, that :func:`learn_fitted_rmax` uses; ``import sb3_combrel`` does."""
    _fitted_rmax[:] = [fitted_rmax]


def learn_fitted_rmax(env: str | gym.Env[Any, Any], seed: int | None, n_episodes: int, learner: dict[str, Any]) -> Transitions:
    """All transitions while Fitted R-Max learns a task; for the parameters see :meth:`SourceInstances.from_fitted_rmax`."""
    n_episodes = as_transition_count("n_episodes", n_episodes)
    if not _fitted_rmax:
        raise RuntimeError("Fitted R-Max is not registered as a learner of source tasks: import sb3_combrel first")
    task = make_env(env)
    try:
        model: Any = _fitted_rmax[0](task, seed=seed, **learner)
        recorder = TransitionRecorder(bounds=learner.get("bounds"), seed=seed)
        # Episodes end the learning, not steps: the task may end them at any length.
        model.learn(10**9, callback=[recorder, StopTrainingOnMaxEpisodes(n_episodes)])
        # The learner's, which need not be the environment's.
        return recorder.transitions()._replace(periodic=model.policy.agent.periodic)
    finally:
        if isinstance(env, str):
            task.close()


def record(
    model: Behaviour | None,
    env: str | gym.Env[Any, Any] | VecEnv,
    n_instances: int,
    seed: int | None,
    deterministic: bool,
    bounds: Bounds | None,
) -> Transitions:
    """Let a behaviour act in a task; for the parameters see :meth:`SourceInstances.record`."""
    n_instances = as_transition_count("n_instances", n_instances)
    task = env if isinstance(env, VecEnv) else make_env(env)
    venv = task if isinstance(task, VecEnv) else DummyVecEnv([lambda: task])
    try:
        scaling = StateScaling.from_space(venv.observation_space, bounds)
        n_actions = count_actions(venv.action_space)
        log = TransitionLog()
        act = _actor(model, venv, seed, deterministic)
        with _seeded(model, seed):
            if seed is not None:
                venv.seed(seed)
            seen: Any = venv.reset()
            states = _raw_states(venv, seen)
            check_observation(states, "at the reset")
            starts = np.ones(venv.num_envs, dtype=bool)
            while len(log) < n_instances:
                actions = act(seen, states, starts)
                step = venv.step(actions)
                states = _log_step(log, venv, states, actions, step, n_instances)
                seen, _, starts, _ = step
        recorder = "random actions" if model is None else getattr(model, "__name__", type(model).__name__)
        origin = describe_origin(venv, recorder, seed)
        return log.transitions(scaling, n_actions, task_names(venv), origin)
    finally:
        if isinstance(env, str):
            venv.close()


def _raw_states(env: VecEnv, seen: Any) -> NDArray[Any]:
    """The present states as they are under ``VecNormalize``, if there is one."""
    normalize = unwrap_vec_normalize(env)
    return np.array(seen if normalize is None else normalize.get_original_obs())


def _log_step(
    log: TransitionLog,
    env: VecEnv,
    states: NDArray[Any],
    actions: NDArray[Any],
    step: tuple[Any, NDArray[Any], NDArray[Any], Sequence[Mapping[str, Any]]],
    max_transitions: int | None = None,
) -> NDArray[Any]:
    """
    Add one step of all environments, up to ``max_transitions`` in all, and return the raw states that it led to.

    :param states: raw states in which the step began
    :param step: what ``env.step`` returned: states as a model sees them, rewards, dones, infos
    """
    seen, rewards, dones, infos = step
    normalize = unwrap_vec_normalize(env)
    following = _raw_states(env, seen)
    rewards = rewards if normalize is None else normalize.get_original_reward()
    start = int(env.action_space.start)  # type: ignore[attr-defined]
    for i, (done, info) in enumerate(zip(dones, infos, strict=True)):
        if max_transitions is not None and len(log) >= max_transitions:
            break
        next_state = following[i]
        if done:
            # `following` is already the first state of the next episode.
            last = info["terminal_observation"]
            next_state = np.array(last if normalize is None else normalize.unnormalize_obs(last))
        terminated = bool(done) and not info.get("TimeLimit.truncated", False)
        log.add(states[i], int(actions[i]) - start, rewards[i], next_state, terminated)
    return following


def _actor(
    model: Behaviour | None, env: VecEnv, seed: int | None, deterministic: bool
) -> Callable[[Any, NDArray[Any], NDArray[np.bool_]], NDArray[Any]]:
    """A function from (states as the model sees them, raw states, episode starts) to the actions of all environments."""
    if model is None:
        rng = np.random.default_rng(seed)
        first = int(env.action_space.start)  # type: ignore[attr-defined]
        n_actions = count_actions(env.action_space)
        return lambda seen, states, starts: first + rng.integers(n_actions, size=len(states))
    predict_action = getattr(model, "predict", None)
    if predict_action is None:
        if not callable(model):
            raise ValueError(f"model must be an SB3 model or policy, a function of the state, or None, got {model!r}")
        function = model
        return lambda seen, states, starts: np.array([int(function(state)) for state in states])
    memory: list[Any] = [None]

    def predict(seen: Any, states: NDArray[Any], starts: NDArray[np.bool_]) -> NDArray[Any]:
        # Recurrent policies carry a hidden state from step to step.
        actions, memory[0] = predict_action(seen, state=memory[0], episode_start=starts, deterministic=deterministic)
        return np.asarray(actions)

    return predict


@contextmanager
def _seeded(model: Behaviour | None, seed: int | None) -> Iterator[None]:
    """Fix what SB3 models draw from, PyTorch's, NumPy's and their action space's generators, and restore the global ones."""
    if seed is None:
        yield
        return
    numpy_state = np.random.get_state()
    with th.random.fork_rng():
        th.manual_seed(seed)
        np.random.seed(seed % 2**32)
        action_space = getattr(model, "action_space", None)
        if action_space is not None:
            action_space.seed(seed)
        try:
            yield
        finally:
            np.random.set_state(numpy_state)
