"""Recording transitions from vectorised environments: with a given behaviour, or while an SB3 algorithm learns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_combrel.common.checks import as_count
from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.sources.tasks import describe_origin, make_env, task_names
from sb3_combrel.sources.transitions import (
    MAX_STEPS,
    WHY_MAX_STEPS,
    TransitionLog,
    Transitions,
    check_observation,
    count_actions,
)

Behaviour = PolicyPredictor | Callable[[NDArray[Any]], int]
"""What can be recorded: anything with SB3's ``predict``, or a function from one state to an action."""


class TransitionRecorder(BaseCallback):
    """
    Callback that records every transition while an SB3 algorithm learns; read them from :meth:`transitions`.

    Under ``VecNormalize`` the original states and rewards are recorded.

    :param max_instances: how many to keep at most, a uniform random sample of all; None for all
    :param bounds: ``(low, high)`` of the states if the observation space has none
    :param seed: seed of the sample
    :param verbose: SB3's verbosity
    """

    def __init__(
        self,
        max_instances: int | None = None,
        bounds: Bounds | None = None,
        seed: int | None = None,
        verbose: int = 0,
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
        normalize = unwrap_vec_normalize(self.training_env)
        last = self.model._last_obs if normalize is None else normalize.get_original_obs()  # type: ignore[attr-defined]
        self._states = np.array(last)

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
        """
        What has been recorded so far.

        :raises ValueError: if nothing has been
        """
        if self._states is None:
            raise ValueError("nothing has been recorded yet: pass the recorder to learn(callback=...) first")
        origin = {**self._origin, "recorded_while_learning": True, "n_seen": self.log.n_seen}
        return self.log.transitions(self._scaling, self._n_actions, self._names, origin)


def record(
    model: Behaviour | None,
    env: str | gym.Env[Any, Any] | VecEnv,
    n_instances: int = 1000,
    seed: int | None = None,
    *,
    deterministic: bool = False,
    bounds: Bounds | None = None,
) -> Transitions:
    """Let a behaviour act in a task; for the parameters see :meth:`SourceInstances.record`."""
    n_instances = as_count("n_instances", n_instances, max=MAX_STEPS, why_max=WHY_MAX_STEPS)
    venv, ours = _vectorised(env)
    try:
        scaling = StateScaling.from_space(venv.observation_space, bounds)
        n_actions = count_actions(venv.action_space)
        log = TransitionLog()
        act = _actor(model, venv, seed, deterministic)
        normalize = unwrap_vec_normalize(venv)
        with _seeded(model, seed):
            if seed is not None:
                venv.seed(seed)
            seen = venv.reset()
            states = np.array(seen if normalize is None else normalize.get_original_obs())
            check_observation(states, "at the reset")
            starts = np.ones(venv.num_envs, dtype=bool)
            while len(log) < n_instances:
                actions = act(seen, states, starts)
                step = venv.step(actions)
                states = _log_step(log, venv, states, actions, step, n_instances)
                seen, _, starts, _ = step  # type: ignore[assignment]
        origin = describe_origin(venv, _recorder_name(model), seed)
        return log.transitions(scaling, n_actions, task_names(venv), origin)
    finally:
        if ours:
            venv.close()


def _log_step(
    log: TransitionLog,
    env: VecEnv,
    states: NDArray[Any],
    actions: NDArray[Any],
    step: tuple[Any, NDArray[Any], NDArray[Any], Sequence[Mapping[str, Any]]],
    max_transitions: int | None = None,
) -> NDArray[Any]:
    """
    Add one step of all environments.

    :param states: raw states in which the step began; ``actions``: what was done there
    :param step: what ``env.step`` returned: states as a model sees them, rewards, dones, infos
    :param max_transitions: up to so many in all
    :return: the raw states in which the environments now are
    """
    seen, rewards, dones, infos = step
    normalize = unwrap_vec_normalize(env)
    following = np.array(seen if normalize is None else normalize.get_original_obs())
    rewards = rewards if normalize is None else normalize.get_original_reward()
    start = int(env.action_space.start)  # type: ignore[attr-defined]
    for i, (done, info) in enumerate(zip(dones, infos, strict=True)):
        if max_transitions is not None and len(log) >= max_transitions:
            break
        # After an episode `following` is the first state of the next one.
        next_state = _last_state(info, normalize) if done else following[i]
        terminated = bool(done) and not info.get("TimeLimit.truncated", False)
        log.add(states[i], int(actions[i]) - start, rewards[i], next_state, terminated)
    return following


def _last_state(info: Mapping[str, Any], normalize: VecNormalize | None) -> NDArray[Any]:
    last = info["terminal_observation"]
    return np.array(last if normalize is None else normalize.unnormalize_obs(last))


def _vectorised(env: str | gym.Env[Any, Any] | VecEnv) -> tuple[VecEnv, bool]:
    """The environment as a vectorised one, and whether it was made here and must be closed."""
    if isinstance(env, VecEnv):
        return env, False
    made = make_env(env)
    return DummyVecEnv([lambda: made]), isinstance(env, str)


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


def _recorder_name(model: Behaviour | None) -> str:
    if model is None:
        return "random actions"
    return type(model).__name__ if hasattr(model, "predict") else getattr(model, "__name__", type(model).__name__)
