"""Runs behind the tables of the documentation come again, to the last bit: one or two of each, where they are quick."""

from functools import partial
from pathlib import Path

import pandas as pd
import pytest

from sb3_combrel.experiments import other_tasks
from sb3_combrel.experiments.benchmark.methods import METHODS
from sb3_combrel.experiments.benchmark.pairs import PAIRS
from sb3_combrel.experiments.benchmark.runs import jobs_of
from sb3_combrel.experiments.suite.runs import Variant, suite_runs
from sb3_combrel.experiments.suite.tasks import TASKS

RESULTS = Path(__file__).parents[2] / "docs" / "results"
pytestmark = pytest.mark.long


def row_of(file, **values):
    """The one row of a file of results that has these values; without empty cells."""
    rows = pd.read_csv(RESULTS / file)
    for name, value in values.items():
        rows = rows[rows[name] == value]
    [(_, row)] = rows.iterrows()
    return row.dropna()


@pytest.mark.parametrize(
    ("file", "task", "variant", "transfer", "seed", "n_played"),
    [
        ("learner/runs.csv", "Pendulum-v1", "default", None, 21001, 100),
        ("learner/runs.csv", "PointRobot3D", "default", None, 21002, 100),
        ("learner/runs.csv", "CartPole-v1", "default", None, 21002, 100),
        ("transfer.csv", "MountainCar4D", "COMBREL", "COMBREL", 22003, 20),
        ("transfer.csv", "CartPole-long", "oracle", "oracle", 22000, 20),
    ],
)
def test_runs_of_the_suite(file, task, variant, transfer, seed, n_played):
    of_task, of_variant = TASKS[task], Variant(variant, transfer=transfer)
    source = of_variant.source(of_task)
    sources = {} if source is None else {(source.name, seed): source.learn(seed)}
    [run] = suite_runs([of_task], [of_variant], [seed], n_played, sources)
    found = run.carry_out().more["row"]
    row = row_of(file, task=task, variant=variant, seed=seed).drop(["run", "task", "variant", "ms_per_step", "settings"])
    expected = row.astype(float).to_dict()
    assert {name: float(found[name]) for name in expected} == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("pair", "method"),
    [
        ("cart-pole", "oracle"),
        ("cart-pole", "COMBREL"),
        ("mirrored-car", "COMBREL-factored"),
        ("point-robot", "random-by-state"),
    ],
)
def test_runs_of_the_benchmark(pair, method, seed=25000):
    sources = {(pair, seed): tuple(source.learn(seed) for source in PAIRS[pair].sources)}
    [run] = jobs_of([PAIRS[pair]], [METHODS[method]], [seed], sources)
    expected = row_of("benchmark/runs.csv", pair=pair, method=method, seed=seed)
    assert " ".join(map(str, run.carry_out().steps)) == str(expected["steps_of_episodes"])


@pytest.mark.parametrize("name", ["reacher-easy", "cartpole-balance"])
def test_runs_of_other_tasks(name, seed=23000, budgets=(500, 1000)):
    task = other_tasks.TASKS[name]
    env = partial(task.made_for, other_tasks.FITTED_RMAX)
    run = other_tasks.BudgetJob(
        group=name, method=other_tasks.FITTED_RMAX, seed=seed, env=env, n_steps=max(budgets), budgets=budgets, unit=task.unit
    )
    found = run.carry_out().more["returns"]
    for steps in budgets:
        expected = row_of("other_tasks.csv", task=name, algorithm=other_tasks.FITTED_RMAX, seed=seed, steps=steps)
        assert found[str(steps)] == pytest.approx(expected["mean_return"], abs=0.01)
