"""One run of the benchmark: a pair's target learnt with one method and one seed."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.benchmark.methods import Method, Sources, run_as
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.result_files import run_name
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.episodes import EpisodeRecorder
from sb3_combrel.runs.job import UNLIMITED, chosen_on_purpose
from sb3_combrel.transfer.base import Transfer

# Limit of the episodes of a run that is made for compiling: some must end.
COMPILED_EPISODE = 30
# Pairs and methods that this process has learnt before.
_COMPILED: set[tuple[str, str]] = set()


@dataclass(frozen=True)
class Outcome:
    """
    What came of a run. All but ``seconds`` is the same wherever it is carried out.

    :param name: of the run; ``pair``, ``method`` and ``seed``: of its job
    :param steps: environment steps of each episode that has ended
    :param returns: undiscounted sum of rewards of each
    :param terminated: whether each ended in a terminal state, not at its time limit
    :param n_steps: environment steps of the run, with those of an episode that had not ended
    :param known_share: in which part of the decisions, those where something was transferred, the known mapping was chosen;
        None where nobody knows it or the method does not say what it chooses
    :param mapping_steps: target steps until the method had a mapping; None for one that has it from the start
    :param misfit: why the method does not fit the pair, or ""
    :param error: what was raised, in one line, or ""
    :param traceback: of the error
    :param seconds: processor time of learning, and of making the learner
    """

    name: str
    pair: str
    method: str
    seed: int
    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    n_steps: int = 0
    known_share: float | None = None
    mapping_steps: int | None = None
    misfit: str = ""
    error: str = ""
    traceback: str = ""
    seconds: tuple[float, float] = (0.0, 0.0)

    @property
    def succeeded(self) -> bool:
        """Whether the target was learnt for all of its budget."""
        return not (self.misfit or self.error)

    def text(self) -> str:
        """Return all but the times as JSON, the same to the byte for the same run."""
        return json.dumps({key: value for key, value in vars(self).items() if key != "seconds"}) + "\n"


@dataclass(frozen=True)
class BenchmarkJob:
    """
    A pair's target that is learnt from nothing with one method and one seed. It has all that a worker needs.

    :param pair: the pair
    :param method: the method
    :param seed: seed of the learner and its environment
    :param sources: instances of the pair's sources
    """

    pair: Pair
    method: Method
    seed: int
    sources: tuple[SourceInstances, ...]

    @property
    def name(self) -> str:
        """Name of the run in files."""
        return run_name(self.pair.name, self.method.name, self.seed)

    @property
    def title(self) -> str:
        """What the run is called in messages."""
        return f"{self.pair.name}, {self.method.name}, seed {self.seed}"

    def answered_by(self, result: Outcome) -> bool:
        """Whether a result is that of this job. A run that failed is tried again, for the reason may have gone."""
        return result.succeeded and (result.pair, result.method) == (self.pair.name, self.method.name)

    def outcome(self, **found: Any) -> Outcome:
        """Make an outcome of this job."""
        return Outcome(self.name, self.pair.name, self.method.name, self.seed, **found)

    def make_model(self, env: gym.Env, transfer: Transfer | None) -> FittedRMax:
        """Make the learner, which has learnt nothing yet."""
        return FittedRMax(env, transfer=transfer, seed=self.seed, **self.pair.learner)

    def make_transfer(self) -> Transfer | None:
        """Make the transfer method."""
        sources: Sources = self.sources[0] if len(self.sources) == 1 else list(self.sources)
        return self.method.make(sources, self.pair)


def has_mapping(transfer: Any) -> bool:
    """
    Whether a transfer method has chosen a mapping for any state and action.

    Where it does not name what it chooses for states of the sample, as methods of this package do, whether it has used one.
    """
    if getattr(transfer, "makes_choices", False):
        return bool((transfer.choices() >= 0).any())
    return bool(transfer.uses())


class MappingRecorder(BaseCallback):
    """Counts the steps until a transfer method has a mapping."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: int | None = None

    def _on_step(self) -> bool:
        if self.steps is None and has_mapping(self.model.agent.transfer):  # type: ignore[attr-defined]
            self.steps = self.num_timesteps
        return True


def carry_out(job: BenchmarkJob) -> Outcome:
    """
    Learn as a job says. Nothing is written: a worker may have no folder in common with the caller.

    :return: the outcome; what the method or the pair raises is in it
    """
    try:
        with chosen_on_purpose():
            # If the learner alone cannot be made, it is not the method that does not fit.
            with closing(job.pair.make_target()) as env:
                job.make_model(env, None)
            try:
                with closing(job.pair.make_target()) as env:
                    job.make_model(env, job.make_transfer())
            except ValueError as error:
                return job.outcome(misfit=_line(error))
            _compile(job)
            return _learn(job)
    except Exception as error:  # a third party's code raises what it likes, and the other runs must go on
        return job.outcome(error=f"{type(error).__name__}: {_line(error)}", traceback=traceback.format_exc())


def _compile(job: BenchmarkJob) -> None:
    """Learn for some steps, so that compiling is not in the time of learning."""
    key = (job.pair.name, job.method.name)
    if key in _COMPILED:
        return
    with closing(job.pair.make_target()) as env:
        model = job.make_model(gym.wrappers.TimeLimit(env, COMPILED_EPISODE), job.make_transfer())
        model.learn(job.method.compiled_steps, log_interval=None)
    _COMPILED.add(key)


def _learn(job: BenchmarkJob) -> Outcome:
    episodes, mapping = EpisodeRecorder(job.pair.n_episodes), MappingRecorder()
    with closing(job.pair.make_target()) as env:
        start = time.process_time()
        model = job.make_model(env, job.make_transfer())
        made = time.process_time()
        callbacks: list[BaseCallback] = [episodes]
        if job.method.finds_mapping and hasattr(model.agent.transfer, "uses"):
            callbacks.append(mapping)
        model.learn(job.pair.n_steps or UNLIMITED, callbacks, log_interval=None)
        learnt = time.process_time()
    rows = episodes.episodes
    if not len(rows.steps):
        raise RuntimeError(f"no episode has ended within n_steps={job.pair.n_steps}: the pair's target needs a shorter limit")
    return job.outcome(
        steps=rows.steps.tolist(),
        returns=rows.returns.tolist(),
        terminated=rows.terminated.tolist(),
        n_steps=int(model.num_timesteps),
        known_share=known_share(job.pair, model.agent.transfer),
        mapping_steps=_mapping_steps(job.method, model, mapping),
        seconds=(learnt - start, made - start),
    )


def known_share(pair: Pair, transfer: Any) -> float | None:
    """
    Compute in which part of a method's decisions the known mapping was chosen.

    A decision is a use of a candidate, as ``uses`` counts them: with instances a state and action of the agent for which
    instances were transferred, with a prior a transition of the target while a mapping was chosen.

    :param pair: the pair
    :param transfer: the transfer method after learning, or None
    :return: None if nobody knows the mapping, nothing was decided, or the method has no ``uses`` and ``mapped_variables``
    """
    if pair.known_by_action is None or not (hasattr(transfer, "uses") and hasattr(transfer, "mapped_variables")):
        return None
    uses: dict[int, int] = transfer.uses()
    total = sum(uses.values())
    if not total:
        return None
    return sum(n for number, n in uses.items() if pair.agrees(transfer.mapped_variables(number))) / total


def _mapping_steps(method: Method, model: Any, mapping: MappingRecorder) -> int | None:
    """What the method says of itself; or the steps until it first had a mapping, all if it never had."""
    transfer = model.agent.transfer
    if hasattr(transfer, "mapping_steps"):
        return int(transfer.mapping_steps())
    if not (method.finds_mapping and hasattr(transfer, "uses")):
        return None
    return int(model.num_timesteps) if mapping.steps is None else mapping.steps


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())


def jobs_of(
    pairs: Sequence[Pair], methods: Sequence[Method], seeds: Sequence[int], sources: dict[str, tuple[SourceInstances, ...]]
) -> list[BenchmarkJob]:
    """
    Make the jobs, seed by seed, so that methods can be compared before all are complete; equal ones once.

    :param pairs: the pairs
    :param methods: the methods
    :param seeds: the seeds
    :param sources: instances of each pair's sources, by name; a pair without them has no jobs
    """
    by_name = {method.name: method for method in methods}
    jobs: dict[str, BenchmarkJob] = {}
    for seed in seeds:
        for pair in (pair for pair in pairs if pair.name in sources):
            for method in methods:
                job = BenchmarkJob(pair, by_name[run_as(method, methods, pair)], seed, sources[pair.name])
                jobs.setdefault(job.name, job)
    return list(jobs.values())
