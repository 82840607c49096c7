"""Recording transitions from vectorised environments: with a given behaviour, or while an SB3 algorithm learns."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_combrel.common.observations import last_observation, with_own_arrays
from sb3_combrel.common.scaling import Bounds
from sb3_combrel.sources.transitions import (
    AnyEnv,
    TransitionLog,
    Transitions,
    as_transition_count,
    check_observation,
    count_actions,
    describe_origin,
    limits_of_task,
    make_env,
    task_names,
)

Behaviour = PolicyPredictor | Callable[[NDArray[Any]], int]
"""What can be recorded: anything with SB3's ``predict``, or a function from one state to an action."""


def record(
    model: Behaviour | None, env: str | AnyEnv, n_instances: int, seed: int | None, deterministic: bool, bounds: Bounds | None
) -> Transitions:
    """Let a behaviour act in a task; for the parameters see :meth:`SourceInstances.record`."""
    n_instances = as_transition_count("n_instances", n_instances)
    task = with_own_arrays(env if isinstance(env, VecEnv) else make_env(env))
    venv = task if isinstance(task, VecEnv) else DummyVecEnv([lambda: task])
    try:
        limits = limits_of_task(venv, bounds)
        n_actions = count_actions(venv.action_space)
        log = TransitionLog()
        act = _actor(model, venv, seed, deterministic)
        with _seeded(model, seed):
            if seed is not None:
                venv.seed(seed)
            seen: Any = venv.reset()
            states = raw_states(venv, seen)
            check_observation(states, "at the reset")
            starts = np.ones(venv.num_envs, dtype=bool)
            while len(log) < n_instances:
                actions = act(seen, states, starts)
                step = venv.step(actions)
                states = log_step(log, venv, states, actions, step, n_instances)
                seen, _, starts, _ = step
        recorder = "random actions" if model is None else getattr(model, "__name__", type(model).__name__)
        return log.transitions(limits, n_actions, task_names(venv), describe_origin(venv, recorder, seed))
    finally:
        if isinstance(env, str):
            venv.close()


def raw_states(env: VecEnv, seen: Any) -> NDArray[Any]:
    """The present states as they are under ``VecNormalize``, if there is one."""
    normalize = unwrap_vec_normalize(env)
    return np.array(seen if normalize is None else normalize.get_original_obs())


def log_step(
    log: TransitionLog,
    env: VecEnv,
    states: NDArray[Any],
    actions: NDArray[Any],
    step: tuple[Any, NDArray[Any], NDArray[Any], Sequence[Mapping[str, Any]]],
    max_transitions: int | None = None,
) -> NDArray[Any]:
    """Add what ``env.step`` returned to the log, which began in raw ``states``; return the raw states that it led to."""
    seen, rewards, dones, infos = step
    normalize = unwrap_vec_normalize(env)
    following = raw_states(env, seen)
    rewards = rewards if normalize is None else normalize.get_original_reward()
    start = int(env.action_space.start)  # type: ignore[attr-defined]
    for i, (done, info) in enumerate(zip(dones, infos, strict=True)):
        if max_transitions is not None and len(log) >= max_transitions:
            break
        next_state = following[i]
        if done:
            # `following` is already the first state of the next episode.
            last = last_observation(info, seen[i])
            next_state = np.array(last if normalize is None else normalize.unnormalize_obs(last))
        terminated = bool(done) and not info.get("TimeLimit.truncated", False)
        log.add(states[i], int(actions[i]) - start, rewards[i], next_state, terminated)
    return following


def _actor(
    model: Behaviour | None, env: VecEnv, seed: int | None, deterministic: bool
) -> Callable[[Any, NDArray[Any], NDArray[np.bool_]], NDArray[Any]]:
    """A function from (states as the model sees them, raw states, episode starts) to the actions of all environments."""
    first, n_actions = int(env.action_space.start), count_actions(env.action_space)  # type: ignore[attr-defined]
    if model is None:
        rng = np.random.default_rng(seed)
        return lambda seen, states, starts: first + rng.integers(n_actions, size=len(states))
    possible = range(first, first + n_actions)
    predict_action = getattr(model, "predict", None)
    if predict_action is None:
        if not callable(model):
            raise ValueError(f"model must be an SB3 model or policy, a function of the state, or None, got {model!r}")
        function = model
        return lambda seen, states, starts: np.array([_checked(function(state), possible, state) for state in states])
    memory: list[Any] = [None]

    def predict(seen: Any, states: NDArray[Any], starts: NDArray[np.bool_]) -> NDArray[Any]:
        # Recurrent policies carry a hidden state from step to step.
        actions, memory[0] = predict_action(seen, state=memory[0], episode_start=starts, deterministic=deterministic)
        return np.array([_checked(action, possible, state) for action, state in zip(actions, states, strict=True)])

    return predict


def _checked(action: Any, possible: range, state: NDArray[Any]) -> int:
    """What a behaviour has returned, or an array of it alone, as a number; ``ValueError`` if it is no action of the task."""
    number = np.asarray(action)
    if number.size == 1 and number.dtype.kind in "iuf" and number.item() in possible:
        return int(number.item())
    raise ValueError(
        f"model must return a whole number from {possible[0]} to {possible[-1]}, got {reprlib.repr(action)} in the state "
        f"{state.tolist()}; of a continuous action return the number of the nearest of those that the task has"
    )


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
