"""One run of the suite: a task learnt with one variant and one seed, then played without exploration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.comparison.tables import write_csv
from sb3_combrel.experiments.suite.measures import summary_of_evaluation, summary_of_learning
from sb3_combrel.experiments.suite.tasks import Source, Task
from sb3_combrel.experiments.suite.transfers import TRANSFERS, source_for
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.episodes import EVALUATION_SEED, Episodes, play
from sb3_combrel.runs.job import Job, Result
from sb3_combrel.runs.runner import read_results
from sb3_combrel.sources.source_instances import SourceInstances

RUNS_FILE, EPISODES_FILE = "runs.csv", "episodes.csv"


@dataclass(frozen=True)
class Variant:
    """One way to set the learner."""

    name: str  # in tables and file names
    learner: Mapping[str, Any] = field(default_factory=dict)  # of FittedRMax, before the task's own
    transfer: str | None = None  # a name of :data:`~sb3_combrel.experiments.suite.transfers.TRANSFERS`, or None

    def source(self, task: Task) -> Source | None:
        """The source task that is transferred from to a task; None without transfer."""
        return None if self.transfer is None else source_for(self.transfer, task)


@dataclass(frozen=True, kw_only=True)
class SuiteRun(Job):
    """A task learnt with one variant and one seed, then evaluated without exploration."""

    compiled_steps: ClassVar[int] = 60

    task: Task
    variant: Variant
    evaluation_episodes: int

    def settings(self) -> dict[str, Any]:
        """What the result depends on besides the names."""
        budget = {"n_steps": self.n_steps, "n_episodes": self.n_episodes, "evaluation_episodes": self.evaluation_episodes}
        source = self.variant.source(self.task)
        transfer = {
            "transfer": self.variant.transfer,
            "source": None if source is None else f"{source.name}, seed {self.seed}",
        }
        return {"learner": dict(self.learner), **transfer, **budget}

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        """Measure the learning, and play the task without exploration: a row of ``runs.csv``."""
        rows = list(zip(result.steps, result.returns, result.terminated, strict=True))
        learnt = Episodes.from_rows(rows)
        task, variant, seed = self.task.name, self.variant.name, self.seed
        row: dict[str, Any] = {"run": f"{task}_{variant}_seed{seed}", "task": task, "variant": variant, "seed": seed}
        row |= {"episodes": len(rows), "steps": result.n_steps, "ms_per_step": 1000.0 * result.seconds / result.n_steps}
        row |= {measure.name: measure.of(learnt) for measure in self.task.measures}
        row |= summary_of_learning(learnt, self.task.failure_return)
        with closing(self.make_env()) as env:
            played = play(model, env, self.evaluation_episodes, EVALUATION_SEED + self.seed)
        summary = summary_of_evaluation(played, self.task.failure_return, row["last10_return"])
        return {"row": row | {f"greedy_{key}": value for key, value in summary.items()}}


def suite_runs(
    tasks: Sequence[Task],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    evaluation_episodes: int,
    sources: Mapping[tuple[str, int], SourceInstances],
) -> list[SuiteRun]:
    """Make the runs, seed by seed; ``sources``: instances of the source tasks, by name and seed."""

    def transfer_of(task: Task, variant: Variant, seed: int) -> Any:
        source = variant.source(task)
        return None if source is None else TRANSFERS[str(variant.transfer)](sources[source.name, seed], task.name)

    return [
        SuiteRun(
            group=task.name,
            method=variant.name,
            seed=seed,
            env=task.make,
            n_steps=task.n_steps,
            n_episodes=task.n_episodes,
            learner={**task.learner, **variant.learner},
            transfer=transfer_of(task, variant, seed),
            task=task,
            variant=variant,
            evaluation_episodes=evaluation_episodes,
        )
        for seed in seeds
        for task in tasks
        for variant in variants
    ]


def records(folder: Path) -> list[tuple[dict[str, Any], Result]]:
    """Return settings and results of all complete runs in a folder, by task, variant and seed."""
    return sorted(read_results(folder), key=lambda each: (each[1].group, each[1].method, each[1].seed))


def write_csv_files(folder: Path) -> None:
    """Write ``runs.csv``, one row a run, and ``episodes.csv``, one row an episode of learning, of all complete runs."""
    found = records(folder)
    if not found:
        return
    runs = pd.DataFrame([result.more["row"] for _, result in found])
    write_csv(runs.assign(settings=[json.dumps(settings) for settings, _ in found]), folder / RUNS_FILE)
    episodes = [
        pd.DataFrame(
            {
                "run": result.more["row"]["run"],
                "episode": range(1, len(result.steps) + 1),
                "steps": result.steps,
                "return": result.returns,
                "terminated": np.array(result.terminated, dtype=int),
                "truncated": np.logical_not(result.terminated).astype(int),
            }
        )
        for _, result in found
    ]
    write_csv(pd.concat(episodes), folder / EPISODES_FILE)
