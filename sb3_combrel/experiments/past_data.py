"""What a controller's log of the same task saves: ``python -m sb3_combrel.experiments.past_data``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.runs.job import Job, Result
from sb3_combrel.runs.runner import check_all_succeeded, run_missing

TASK, N_ROWS, RANDOM_PART = "MountainCar-v0", 1000, 0.3
SEEDS = range(9200, 9210)
NONE, LOG = "none", "log"
#: Own steps, the same number between two evaluations, and their episodes.
N_STEPS, EVERY, N_EPISODES = 1500, 100, 10
OUTPUT, TABLE = Path("past_data"), Path("docs/results/past_data.csv")


class Controller:
    """PID control of the velocity with the derivative term alone: it pushes as the car moves; some actions are random."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)

    def __call__(self, state: np.ndarray) -> int:
        if self.rng.random() < RANDOM_PART:
            return int(self.rng.integers(3))
        return 2 if state[1] >= 0.0 else 0


class Evaluation(BaseCallback):
    """The mean return of the greedy policy, before learning and every so many steps; ``found``: (steps, return)."""

    def __init__(self, job: Job):
        super().__init__()
        self.job = job
        self.found: list[tuple[int, float]] = []

    def evaluate(self, model: FittedRMax, steps: int) -> None:
        env = Monitor(self.job.make_env())
        env.reset(seed=10**6 + self.job.seed)
        mean, _ = evaluate_policy(model, env, N_EPISODES)
        self.found.append((steps, float(mean)))  # type: ignore[arg-type]

    def _on_training_start(self) -> None:
        self.evaluate(self.model, 0)  # type: ignore[arg-type]

    def _on_step(self) -> bool:
        if self.num_timesteps % EVERY == 0:
            self.evaluate(self.model, self.num_timesteps)  # type: ignore[arg-type]
        return True


@dataclass(frozen=True, kw_only=True)
class PastDataJob(Job):
    """A run with or without a log, which is recorded with a seed of its own."""

    def make_model(self, env: Any) -> FittedRMax:
        model = super().make_model(env)
        if self.method == LOG:
            model.load_instances(SourceInstances.record(Controller(self.seed), TASK, N_ROWS, 10**5 + self.seed))
        return model

    def callbacks(self) -> list[BaseCallback]:
        return [Evaluation(self)]

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        return {"evaluations": callbacks[0].found}  # type: ignore[attr-defined]


def main() -> None:
    """Carry out what is missing, and write the table."""
    jobs = [PastDataJob(group=TASK, method=m, seed=s, env=TASK, n_steps=N_STEPS) for m in (NONE, LOG) for s in SEEDS]
    results = run_missing(jobs, OUTPUT, console=Console())
    check_all_succeeded(results)
    rows = [
        {"task": TASK, "method": each.method, "seed": each.seed, "steps": steps, "greedy": greedy}
        for each in results
        for steps, greedy in each.more["evaluations"]
    ]
    table = pd.DataFrame(rows)
    table.to_csv(TABLE, index=False)
    print(table.groupby(["method", "steps"])["greedy"].agg(["mean", "min"]).unstack("method").round(1))


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
