"""Tasks that others made: returns after few steps of Fitted R-Max, by default, beside DQN, QR-DQN and SBX's CrossQ.

Run as ``python -m sb3_combrel.experiments.other_tasks``; a later call does what is missing. It needs the extra ``benchmarks``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import TransformAction
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.experiments.rivals import CROSSQ, FITTED_RMAX, check_names, folder_of, learner_of, published
from sb3_combrel.experiments.tasks.bsuite_tasks import FACES, make_bsuite
from sb3_combrel.experiments.tasks.dm_suite import make_dm_control
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder, play
from sb3_combrel.runs.job import Job, Result, chosen_on_purpose
from sb3_combrel.runs.runner import Backend, check_all_succeeded, run_missing

#: Environment steps after which the frozen policy is evaluated; the last one ends the run.
BUDGETS = (500, 1000, 2000, 5000, 10_000)
N_EPISODES = 10
#: RL-Zoo has hyperparameters for none of these tasks: each algorithm has those of one that it has some for. DQN and QR-DQN
#: make one update a step there and learn from the first step on.
ALIKE = {"DQN": "Acrobot-v1", "QRDQN": "Acrobot-v1", CROSSQ: "Pendulum-v1"}
ALGORITHMS = (FITTED_RMAX, *ALIKE)
SEEDS = (23000, 23001, 23002, 23003, 23004)
OUTPUT, TABLE = Path("other_tasks"), Path("docs/results/other_tasks.csv")


@dataclass(frozen=True)
class OtherTask:
    """A task as its makers have it, in the forms that learners take.

    :param make: called with whether the state is all that the makers' observation has, and not a few state variables
    :param few_actions: gives it Discrete actions; None where it has them
    :param unit: what a return is multiplied by, so that it is one of the makers'
    """

    make: Callable[[bool], gym.Env]
    few_actions: Callable[[gym.Env], gym.Env] | None = None
    unit: float = 1.0

    def made_for(self, algorithm: str) -> gym.Env:
        """Make it: with state variables for Fitted R-Max, as it is for CrossQ, and with a few actions for all but CrossQ."""
        env = self.make(algorithm != FITTED_RMAX)
        return env if algorithm == CROSSQ or self.few_actions is None else self.few_actions(env)


def with_values(env: gym.Env, n: int) -> gym.Env:
    """Let Discrete actions choose among ``n`` values of each number of a Box action, its limits and what lies between."""
    space = env.action_space
    assert isinstance(space, Box)
    values = np.array(list(product(*np.linspace(space.low, space.high, n).T)), dtype=space.dtype)
    return TransformAction(env, lambda action: values[int(action)], Discrete(len(values)))


def _of_the_suite(domain: str, task: str, values: int) -> OtherTask:
    # Rewards of two control steps are averaged: the makers sum them.
    return OtherTask(partial(make_dm_control, domain, task), partial(with_values, n=values), unit=2.0)


TASKS: dict[str, OtherTask] = {
    "pendulum-swingup": _of_the_suite("pendulum", "swingup", 5),
    "cartpole-balance": _of_the_suite("cartpole", "balance", 3),
    "cartpole-balance_sparse": _of_the_suite("cartpole", "balance_sparse", 3),
    "cartpole-swingup": _of_the_suite("cartpole", "swingup", 3),
    "cartpole-swingup_sparse": _of_the_suite("cartpole", "swingup_sparse", 3),
    "acrobot-swingup": _of_the_suite("acrobot", "swingup", 3),
    "reacher-easy": _of_the_suite("reacher", "easy", 3),
    **{f"bsuite-{name}": OtherTask(partial(make_bsuite, name)) for name in FACES},
}


class AtBudgets(BaseCallback):
    """Plays episodes with the frozen policy after some numbers of steps, and keeps mean returns and the time that it takes."""

    def __init__(self, env: gym.Env, budgets: Sequence[int], seed: int):
        super().__init__()
        self.env, self.budgets, self.seed = env, budgets, seed
        self.returns: dict[int, float] = {}
        self.spent = 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps in self.budgets:
            start = time.process_time()
            self.returns[self.num_timesteps] = float(play(self.model, self.env, N_EPISODES, self.seed).returns.mean())
            self.spent += time.process_time() - start
        return self.num_timesteps < max(self.budgets)


@dataclass(frozen=True, kw_only=True)
class BudgetJob(Job):
    """An algorithm, ``method``, that learns a task, ``group``, and is evaluated after some numbers of steps.

    :param budgets: these; the last one ends the run
    :param unit: what mean returns are multiplied by
    """

    budgets: tuple[int, ...]
    unit: float = 1.0

    def make_learner(self, env: gym.Env) -> tuple[Any, dict[str, Any]]:
        """Make the model that learns in an environment, and what the result says of how it begins."""
        return learner_of(self.method, env, self.seed, self.learner), {}

    def carry_out(self) -> Result:
        """Learn, and take the time without that of the evaluations, but with that of compiling."""
        with chosen_on_purpose(), closing(self.make_env()) as env, closing(self.make_env()) as evaluation_env:
            (model, more), recorder = self.make_learner(env), EpisodeRecorder()
            at_budgets = AtBudgets(evaluation_env, self.budgets, EVALUATION_SEED + self.seed)
            start = time.process_time()
            model.learn(max(self.budgets), [recorder, at_budgets], log_interval=None)
            seconds = time.process_time() - start - at_budgets.spent
        more |= {"returns": {str(steps): self.unit * mean for steps, mean in at_budgets.returns.items()}}
        episodes = (column.tolist() for column in recorder.episodes)
        return self.result(*episodes, int(model.num_timesteps), more, seconds)


def made_for(task: str, algorithm: str) -> gym.Env:
    """Make a task of :data:`TASKS` for an algorithm."""
    return TASKS[task].made_for(algorithm)


def check_budgets(budgets: Sequence[int]) -> None:
    """:raises ValueError: if there is none, or one is not positive"""
    if not budgets or min(budgets) < 1:
        raise ValueError(f"budgets must be numbers of steps, at least 1, got {budgets!r}")


def budget_jobs(
    tasks: Sequence[str], algorithms: Sequence[str], seeds: Sequence[int], budgets: Sequence[int]
) -> list[BudgetJob]:
    """Make the jobs, seed by seed; CrossQ has none where actions are discrete.

    :raises ValueError: if a name is unknown, or a budget is not positive
    :raises ModuleNotFoundError: if a package is not installed
    """
    check_names("tasks", tasks, TASKS)
    check_names("algorithms", algorithms, ALGORITHMS)
    check_budgets(budgets)
    for package, needed in (("sbx", CROSSQ in algorithms), ("bsuite", any(name.startswith("bsuite-") for name in tasks))):
        if needed:
            folder_of(package, "the comparison")
    hyperparameters: Mapping[str, dict[str, Any]] = {
        algorithm: published(algorithm, ALIKE[algorithm]) if algorithm in ALIKE else {} for algorithm in algorithms
    }
    return [
        BudgetJob(
            group=task,
            method=algorithm,
            seed=seed,
            env=partial(made_for, task, algorithm),
            n_steps=max(budgets),
            learner=hyperparameters[algorithm],
            budgets=tuple(budgets),
            unit=TASKS[task].unit,
        )
        for seed, task, algorithm in product(seeds, tasks, algorithms)
        if algorithm != CROSSQ or TASKS[task].few_actions is not None
    ]


def table_of(results: Sequence[Result]) -> pd.DataFrame:
    """Return the table, one row for each run and budget."""
    return pd.DataFrame(
        [
            {
                **{"task": each.group, "algorithm": each.method, "seed": each.seed},
                **{"steps": int(steps), "mean_return": mean, "seconds": each.seconds},
            }
            for each in results
            for steps, mean in each.more["returns"].items()
        ]
    ).round(2)


def learn_all(jobs: Sequence[BudgetJob], n_jobs: int, output: Path, table: Path) -> None:
    """Carry out what is missing in a folder, write the table of all, and print mean returns."""
    results = run_missing(jobs, output, Backend(n_jobs=n_jobs), Console())
    check_all_succeeded(results)
    rows = table_of(results)
    rows.to_csv(table, index=False)
    print(rows.pivot_table("mean_return", ["task", "algorithm"], "steps", sort=False).round(1))


def other_tasks(
    tasks: list[str] = list(TASKS),  # noqa: B006 - tyro shows it, nobody changes it
    algorithms: list[str] = list(ALGORITHMS),  # noqa: B006
    seeds: list[int] = list(SEEDS),  # noqa: B006
    budgets: list[int] = list(BUDGETS),  # noqa: B006
    jobs: int = 1,
    output: Path = OUTPUT,
    table: Path = TABLE,
) -> None:
    """Learn tasks that others made, by Fitted R-Max and its rivals, and write returns after few steps.

    :param tasks: pendulum-swingup and so on
    :param algorithms: FittedRMax, DQN, QRDQN, CrossQ
    :param seeds: one run each
    :param budgets: steps after which the frozen policy is evaluated
    :param jobs: processes at a time
    :param output: folder for the results; a later call goes on from there
    :param table: the CSV file
    """
    learn_all(budget_jobs(tasks, algorithms, seeds, budgets), jobs, output, table)


def main() -> None:
    """Run the command line."""
    import tyro

    try:
        tyro.cli(other_tasks)
    except (ValueError, ModuleNotFoundError) as error:
        sys.exit(f"other_tasks: {error}")


if __name__ == "__main__":
    main()
