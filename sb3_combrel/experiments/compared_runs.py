"""One run of a comparison: Fitted R-Max learns a task with one method of transfer, or without, and one seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_combrel.experiments.runs import coarse_on_purpose, outside_bounds_on_purpose
from sb3_combrel.experiments.suite_runs import EpisodeRecorder
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.report import TransferReport

MakeEnv = Callable[[], gym.Env[Any, Any]]
TransferLike = Transfer | dict[str, Any] | str | None


@dataclass(frozen=True)
class ComparedRun:
    """
    One run: Fitted R-Max learns the task with one method and one seed.

    :param method: its name
    :param seed: of learner and environment
    :param env: specification of the task, which need not be registered where the run is carried out; or a function that makes
        the environment
    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it
    :param steps: environment steps
    :param learner: further arguments of :class:`~sb3_combrel.FittedRMax`
    """

    method: str
    seed: int
    env: EnvSpec | MakeEnv
    transfer: TransferLike
    steps: int
    learner: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the run in messages."""
        return f"{self.method}, seed {self.seed}"

    def make_model(self) -> FittedRMax:
        """Make environment and learner, which has learned nothing yet."""
        env = gym.make(self.env) if isinstance(self.env, EnvSpec) else self.env()
        if not isinstance(env, gym.Env):
            raise ValueError(f"env must make Gymnasium environments, got {env!r}")
        with coarse_on_purpose():
            return FittedRMax(env, transfer=self.transfer, seed=self.seed, **self.learner)


@dataclass(frozen=True)
class RunResult:
    """
    What a run has brought.

    :param returns: of each complete episode
    :param steps: of each complete episode
    :param report: what transfer did; None without
    """

    returns: tuple[float, ...]
    steps: tuple[float, ...]
    report: TransferReport | None


def carry_out(run: ComparedRun) -> RunResult:
    """
    Learn.

    :raises ValueError: if no episode has ended
    """
    recorder = EpisodeRecorder()
    model = run.make_model()
    assert model.env is not None
    with closing(model.env), outside_bounds_on_purpose():
        model.learn(run.steps, recorder, log_interval=None)
    episodes = recorder.episodes
    if len(episodes.steps) == 0:
        raise ValueError(
            f"steps={run.steps} is too few: no episode ended in the run of {run.name}; take more, or a time limit"
        )
    report = None if model.transfer is None else model.transfer.report()
    return RunResult(tuple(map(float, episodes.returns)), tuple(map(float, episodes.steps)), report)
