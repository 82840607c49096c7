"""Recording transitions from vectorised environments: with a given behaviour, or while an SB3 algorithm learns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.sources.source_instances import SourceInstances, count_actions

Behaviour = PolicyPredictor | Callable[[NDArray[Any]], int]
"""What can be recorded: anything with SB3's ``predict``, or a function from one state to an action."""


class TransitionLog:
    """
    Transitions in the order in which they came; of too many, a uniform random sample.

    :param max_instances: how many to hold at most (reservoir sampling); None for all
    :param seed: seed of the sample
    """

    def __init__(self, max_instances: int | None = None, seed: int | None = None) -> None:
        if max_instances is not None and max_instances < 1:
            raise ValueError(f"max_instances must be at least 1 or None, got {max_instances}")
        self.max_instances = max_instances
        self.n_seen = 0
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
        """
        row = (self.n_seen, state, int(action), float(reward), next_state, bool(terminated))
        self.n_seen += 1
        if self.max_instances is None or len(self._rows) < self.max_instances:
            self._rows.append(row)
            return
        place = int(self._rng.integers(self.n_seen))
        if place < self.max_instances:
            self._rows[place] = row

    def instances(
        self, scaling: StateScaling, n_actions: int, names: Mapping[str, Sequence[str]], origin: Mapping[str, Any]
    ) -> SourceInstances:
        """
        The transitions as source instances.

        :param scaling: holds the bounds of the states
        :param n_actions: number of actions of the task
        :param names: ``state_names`` and ``action_names``, as far as known
        :param origin: where the transitions came from
        :raises ValueError: if there are no transitions
        """
        if not self._rows:
            raise ValueError("nothing has been recorded yet: no step was taken in the source task")
        _, states, actions, rewards, next_states, terminated = zip(*sorted(self._rows, key=lambda row: row[0]), strict=True)
        return SourceInstances(
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
        )


class SourceRecorder(BaseCallback):
    """
    Callback that records every transition while an SB3 algorithm learns; read them from :meth:`source_instances`.

    Under ``VecNormalize`` the original states and rewards are recorded.

    :param max_instances: how many to hold at most, a uniform random sample of all; None for all
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
                f"SourceRecorder cannot record {type(self.model).__name__}: its callbacks are not told {sorted(missing)}; "
                "record the trained model with SourceInstances.record(model, env)"
            )
        step = (self.locals["new_obs"], self.locals["rewards"], self.locals["dones"], self.locals["infos"])
        self._states = _log_step(self.log, self.training_env, self._states, self.locals["actions"], *step)
        return True

    def source_instances(self) -> SourceInstances:
        """
        What has been recorded so far.

        :raises ValueError: if nothing has been
        """
        if self._states is None:
            raise ValueError("nothing has been recorded yet: pass the recorder to learn(callback=...) first")
        origin = {**self._origin, "recorded_while_learning": True, "n_seen": self.log.n_seen}
        return self.log.instances(self._scaling, self._n_actions, self._names, origin)


def record(
    model: Behaviour | None,
    env: str | gym.Env[Any, Any] | VecEnv,
    n_instances: int = 1000,
    seed: int | None = None,
    *,
    deterministic: bool = False,
    bounds: Bounds | None = None,
) -> SourceInstances:
    """Record source instances; see :meth:`SourceInstances.record`."""
    if n_instances < 1:
        raise ValueError(f"n_instances must be at least 1, got {n_instances}")
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
            starts = np.ones(venv.num_envs, dtype=bool)
            while len(log) < n_instances:
                actions = act(seen, states, starts)
                seen, rewards, starts, infos = venv.step(actions)  # type: ignore[assignment]
                states = _log_step(log, venv, states, actions, seen, rewards, starts, infos, n_instances)
        origin = describe_origin(venv, _recorder_name(model), seed)
        return log.instances(scaling, n_actions, task_names(venv), origin)
    finally:
        if ours:
            venv.close()


def make_env(env: str | gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """
    The environment of an id, or the one given.

    :param env: an environment or its id; ids of this project's environments need no import of ``combrel_envs``
    """
    if not isinstance(env, str):
        return env
    return gym.make(f"combrel_envs:{env}" if env.startswith("combrel/") else env)


def task_names(env: VecEnv | gym.Env[Any, Any]) -> dict[str, tuple[str, ...]]:
    """``state_names`` and ``action_names`` of a task, as far as it has them."""
    names = {}
    for attribute in ("state_names", "action_names"):
        if isinstance(env, VecEnv):
            value = env.get_attr(attribute, 0)[0] if env.has_attr(attribute) else None
        else:
            value = getattr(env.unwrapped, attribute, None)
        if value is not None:
            names[attribute] = tuple(value)
    return names


def describe_origin(env: VecEnv | gym.Env[Any, Any], recorder: str, seed: int | None) -> dict[str, Any]:
    """
    Where instances come from: id of the environment, recorder, seed and version of this package.

    :param env: the environment
    :param recorder: what acted in it
    :param seed: its seed
    """
    if isinstance(env, VecEnv):
        spec = env.get_attr("spec", 0)[0] if env.has_attr("spec") else None
    else:
        spec = env.spec
    return {
        "env": None if spec is None else spec.id,
        "recorder": recorder,
        "seed": seed,
        "package": f"sb3-combrel {metadata.version('sb3-combrel')}",
    }


def _log_step(
    log: TransitionLog,
    env: VecEnv,
    states: NDArray[Any],
    actions: NDArray[Any],
    seen: Any,
    rewards: NDArray[Any],
    dones: NDArray[Any],
    infos: Sequence[Mapping[str, Any]],
    at_most: int | None = None,
) -> NDArray[Any]:
    """Add one step of all environments (no more than ``at_most`` in all); returns the raw states in which they now are."""
    normalize = unwrap_vec_normalize(env)
    following = np.array(seen if normalize is None else normalize.get_original_obs())
    rewards = rewards if normalize is None else normalize.get_original_reward()
    start = int(env.action_space.start)  # type: ignore[attr-defined]
    for i, (done, info) in enumerate(zip(dones, infos, strict=True)):
        if at_most is not None and len(log) >= at_most:
            break
        # After an episode `following` is the first state of the next one.
        next_state = _last_state(info, normalize) if done else following[i]
        terminated = bool(done) and not info.get("TimeLimit.truncated", False)
        log.add(states[i], int(actions[i]) - start, float(rewards[i]), next_state, terminated)
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
