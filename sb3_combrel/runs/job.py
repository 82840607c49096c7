"""A run: a task that is learnt from nothing with one method and one seed, as plain data that any process can carry out."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.described import data_of, described
from sb3_combrel.runs.episodes import EpisodeRecorder
from sb3_combrel.transfer.base import Transfer

#: An environment: its id, its specification, or a function that makes it.
Task = str | EnvSpec | Callable[[], gym.Env[Any, Any]]
TransferLike = Transfer | dict[str, Any] | str | None

#: Where the number of episodes is given, the number of steps must not end the learning first.
UNLIMITED = 10**9
# Limit of the episodes of a run that is made for compiling: some must end.
_COMPILED_EPISODE = 30
# What this process has learnt before.
_compiled: set[tuple[str, str]] = set()


@dataclass(frozen=True)
class Result:
    """What came of a run. All but ``seconds`` is the same wherever it is carried out.

    :param name: of the run in files; ``group``, ``method`` and ``seed``: of its job
    :param steps: environment steps of each episode that has ended
    :param returns: undiscounted sum of rewards of each
    :param terminated: whether each ended in a terminal state, not at its time limit
    :param n_steps: environment steps of the run, with those of an episode that had not ended
    :param more: what the kind of job measures besides
    :param seconds: processor time of learning
    :param error: what was raised, in one line, or ""
    :param traceback: of the error
    """

    name: str
    group: str
    method: str
    seed: int
    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    n_steps: int = 0
    more: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    error: str = ""
    traceback: str = ""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A run of Fitted R-Max. Kinds of jobs add callbacks and measures, or learn by another algorithm.

    :param group: what the run is compared within, such as a task or a pair of tasks
    :param method: in tables and figures
    :param seed: of the learner and its environment
    :param env: the task
    :param n_steps: environment steps to learn; or
    :param n_episodes: episodes to learn
    :param max_episode_steps: steps after which an episode is cut off, if ``env`` is an id; None for the task's own limit
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`
    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it
    """

    #: Steps that are learnt before the time is taken, so that compiling is not in it; 0 for none.
    compiled_steps: ClassVar[int] = 0

    group: str
    method: str
    seed: int
    env: Task
    n_steps: int | None = None
    n_episodes: int | None = None
    max_episode_steps: int | None = None
    learner: Mapping[str, Any] = field(default_factory=dict)
    transfer: TransferLike = None

    @property
    def name(self) -> str:
        """Name of the run in files."""
        return file_name(self.group, self.method, self.seed)

    @property
    def title(self) -> str:
        """What the run is called in messages."""
        return ", ".join(filter(None, (self.group, self.method, f"seed {self.seed}")))

    def settings(self) -> dict[str, Any]:
        """What the result depends on, as JSON can hold it; of past data in a file the content."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        if "instances" in self.learner:
            values["learner"] = {**self.learner, "instances": data_of(self.learner["instances"])}
        return {name: described(value) for name, value in values.items()}

    def make_env(self) -> gym.Env:
        """Make the environment."""
        return make_env(self.env, self.max_episode_steps)

    def make_transfer(self) -> TransferLike:
        """Make the transfer method."""
        return self.transfer

    def make_model(self, env: gym.Env) -> FittedRMax:
        """Make the learner, which has learnt nothing yet."""
        return FittedRMax(env, transfer=self.make_transfer(), seed=self.seed, **self.learner)

    def callbacks(self) -> list[BaseCallback]:
        """Make the callbacks that learning has besides the one that records episodes."""
        return []

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        """Measure what the result has in ``more``, after learning; ``callbacks`` are those of :meth:`callbacks`."""
        return {}

    def carry_out(self) -> Result:
        """Learn."""
        with chosen_on_purpose():
            self._compile()
            episodes, callbacks = EpisodeRecorder(self.n_episodes), self.callbacks()
            with closing(self.make_env()) as env:
                model = self.make_model(env)
                start = time.process_time()
                model.learn(self.n_steps or UNLIMITED, [episodes, *callbacks], log_interval=None)
                seconds = time.process_time() - start
            steps, returns, terminated = (column.tolist() for column in episodes.episodes)
            learnt = (steps, returns, terminated, int(model.num_timesteps))
            result = self.result(*learnt, seconds=seconds)
            return self.result(*learnt, self.measure(model, result, callbacks), seconds)

    def result(self, *values: Any, **named: Any) -> Result:
        """Make a result of this job from the fields that follow the seed."""
        return Result(self.name, self.group, self.method, self.seed, *values, **named)

    def _compile(self) -> None:
        """Learn for some steps, once a process, so that compiling, or loading what was compiled before, takes no part."""
        key = (self.group, self.method)
        if not self.compiled_steps or key in _compiled:
            return
        with closing(self.make_env()) as env:
            model = self.make_model(gym.wrappers.TimeLimit(env, _COMPILED_EPISODE))
            model.learn(self.compiled_steps, log_interval=None)
        _compiled.add(key)


def file_name(group: str, method: str, seed: int) -> str:
    """Return the name of a run in files."""
    words = re.sub(r"[^\w.+@-]+", "_", f"{group} {method}".strip().lower().replace(",", ""))
    return f"{words}_seed{seed}"


def make_env(task: Task, max_episode_steps: int | None = None, **kwargs: Any) -> Any:
    """Make an environment; those of this repository are registered if need be.

    :param max_episode_steps: steps after which an episode is cut off, unless a function makes it; None: the task's own
    :raises ValueError: if the function makes something else
    """
    if not isinstance(task, str | EnvSpec):
        env = task()
        if not isinstance(env, gym.Env):
            raise ValueError(f"env must make Gymnasium environments, got {env!r}")
        return env
    if isinstance(task, str) and task.startswith("combrel/"):
        import combrel_envs  # noqa: F401 - registers them
    if max_episode_steps is not None:
        kwargs["max_episode_steps"] = max_episode_steps
    return gym.make(task, **kwargs)


@contextmanager
def chosen_on_purpose() -> Iterator[None]:
    """Suppress warnings of what an experiment has chosen: few or many grid points, misleading sources, narrow bounds."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="resolution=.* (is coarse|means)")
        warnings.filterwarnings("ignore", message="what was transferred from")
        warnings.filterwarnings("ignore", message="(?s)the observation .* is outside the bounds")
        yield
