"""One run of a method with a seed: a job that any process can carry out, and its result, which is written as it arrives."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.experiments.paper.recording import SelectionRecorder, selections_at_sample, uses_of
from sb3_combrel.experiments.result_files import RESULTS, RunFiles, run_name
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.episodes import EpisodeRecorder
from sb3_combrel.runs.job import UNLIMITED, chosen_on_purpose, make_env
from sb3_combrel.transfer.base import Transfer


@dataclass(frozen=True)
class Job:
    """
    A target task that is learnt from nothing by one method with one seed. It has all that a worker needs.

    :param domain: name of the domain
    :param method: name of the method
    :param seed: seed of the learner and its environment
    :param env_id: id of the target task
    :param n_episodes: episodes to learn
    :param max_episode_steps: steps after which an episode is cut off
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`
    :param transfer: transfer method, not bound; None for none
    :param records_selections: whether each selection of a mapping is recorded, with the state
    """

    domain: str
    method: str
    seed: int
    env_id: str
    n_episodes: int
    max_episode_steps: int
    learner: Mapping[str, Any] = field(default_factory=dict)
    transfer: Transfer | None = None
    records_selections: bool = False

    @property
    def name(self) -> str:
        """Name of the run in files."""
        return run_name(self.domain, self.method, self.seed)

    @property
    def title(self) -> str:
        """What the run is called in messages."""
        return f"{self.domain}, {self.method}, seed {self.seed}"

    def answered_by(self, result: Result) -> bool:
        """Whether a result is that of this job: of as many episodes."""
        return len(result.steps) == self.n_episodes


@dataclass(frozen=True)
class Result:
    """
    What a run found. All but ``seconds`` is the same wherever it is carried out.

    :param name: of the run; ``domain``, ``method`` and ``seed``: of its job
    :param steps: environment steps of each episode
    :param returns: undiscounted sum of rewards of each episode
    :param terminated: whether each episode ended in a terminal state, not at its time limit
    :param uses: how often instances of each candidate were used: [target action, source action, state mapping, action mapping
        or "", times]
    :param selections: each such use with the state, raw units: [number in ``uses``, *state]; [] unless asked for
    :param at_sample: source action selected in the end for each state of the finite sample, by target action; {} unless
        asked for
    :param evaluations: of a baseline: [steps, mean greedy return, fraction of episodes that ended in a terminal state]
    :param seconds: processor time: of learning, and of the first episode
    """

    name: str
    domain: str
    method: str
    seed: int
    steps: list[int]
    returns: list[float]
    terminated: list[bool]
    uses: list[list[Any]] = field(default_factory=list)
    selections: list[list[float]] = field(default_factory=list)
    at_sample: dict[str, list[str]] = field(default_factory=dict)
    evaluations: list[list[float]] = field(default_factory=list)
    seconds: tuple[float, float] = (0.0, 0.0)

    def text(self) -> str:
        """Return all but the times as JSON, the same to the byte for the same run."""
        content = {key: value for key, value in vars(self).items() if key != "seconds"}
        return json.dumps(content) + "\n"


class TimedRecorder(EpisodeRecorder):
    """:class:`EpisodeRecorder` that also measures the processor time until the end of the first episode."""

    def __init__(self, n_episodes: int):
        super().__init__(n_episodes)
        self.first_episode_ended: float | None = None

    def _on_step(self) -> bool:
        goes_on = super()._on_step()
        if self._rows and self.first_episode_ended is None:
            self.first_episode_ended = time.process_time()
        return goes_on


def carry_out(job: Job) -> Result:
    """
    Learn as a job says. Nothing is written: a worker may have no folder in common with the caller.

    :return: the result
    """
    episodes = TimedRecorder(job.n_episodes)
    selections = SelectionRecorder()
    with closing(make_env(job.env_id, max_episode_steps=job.max_episode_steps)) as env, chosen_on_purpose():
        model = FittedRMax(env, transfer=job.transfer, seed=job.seed, **job.learner)
        start = time.process_time()
        callbacks: list[BaseCallback] = [episodes, selections] if job.records_selections else [episodes]
        model.learn(UNLIMITED, callbacks, log_interval=None)
        end = time.process_time()
    learnt = episodes.episodes
    transfer = model.agent.transfer
    uses = uses_of(transfer)
    first = episodes.first_episode_ended or end
    return Result(
        job.name,
        job.domain,
        job.method,
        job.seed,
        [int(n) for n in learnt.steps],
        [float(r) for r in learnt.returns],
        [bool(t) for t in learnt.terminated],
        [row for _, row in uses],
        selections.rows([number for number, _ in uses]) if job.records_selections else [],
        selections_at_sample(transfer) if job.records_selections else {},
        seconds=(end - start, first - start),
    )


class ResultFiles(RunFiles[Result]):
    """
    The results in a folder, see :class:`~sb3_combrel.experiments.result_files.RunFiles`.

    :param folder: the folder
    """

    def __init__(self, folder: Path):
        super().__init__(folder, Result)

    def read_domain(self, domain: str) -> list[Result]:
        """Read all results of a domain that are in the folder, whichever call they are from."""
        found = (self.read(path.stem) for path in sorted((self.folder / RESULTS).glob(f"{domain}_*.json")))
        return [result for result in found if result is not None]


def steps_by_method(results: Iterable[Result]) -> dict[str, np.ndarray]:
    """
    Return for each method the steps of each run's episodes, shape (n_runs, n_episodes), by seed.

    :param results: of one domain, all of the same number of episodes
    """
    by_method: dict[str, list[Result]] = {}
    for result in sorted(results, key=lambda each: each.seed):
        by_method.setdefault(result.method, []).append(result)
    return {method: np.array([result.steps for result in its_own]) for method, its_own in by_method.items()}
