"""The iCub experiment from the source task to the tables, with few episodes."""

import csv

import numpy as np
import pytest
from rich.console import Console

from sb3_combrel.experiments import ball_striking
from sb3_combrel.experiments.statistics import steps_to_reach

METHODS = (
    ball_striking.NO_TRANSFER,
    ball_striking.PAPERS_MAPPINGS,
    ball_striking.ALL_MAPPINGS,
    ball_striking.FREQUENT,
)


@pytest.mark.slow
def test_the_experiment_runs_to_its_end_and_is_not_done_twice(tmp_path):
    console = Console(record=True, width=200)
    arguments = (tmp_path, 1, 6, METHODS, 1, console)
    ball_striking.run_experiment(*arguments, first_seed=7)
    with (tmp_path / "summary.csv").open(newline="") as file:
        summary = list(csv.DictReader(file))
    with (tmp_path / "results.csv").open(newline="") as file:
        results = list(csv.DictReader(file))
    assert [(row["method"], row["seed"]) for row in summary] == [(method, "7") for method in METHODS]
    for row in summary:
        steps = np.array([int(each["steps"]) for each in results if each["method"] == row["method"]])
        assert len(steps) == 6
        assert int(row["steps"]) == steps.sum()
        for threshold in ball_striking.THRESHOLDS:
            assert float(row[f"steps_to_{threshold}"]) == steps_to_reach(steps[None], threshold, ball_striking.WINDOW)[0]
    tables = (tmp_path / "tables.md").read_text()
    assert all(name in tables for name in (*METHODS, "T1-", "S2+", "r_elbow"))
    assert (tmp_path / "learning_curves.png").stat().st_size > 10_000

    before = [path.stat().st_mtime_ns for path in sorted((tmp_path / "runs").glob("*.zip"))]
    ball_striking.run_experiment(*arguments, first_seed=7)
    assert [path.stat().st_mtime_ns for path in sorted((tmp_path / "runs").glob("*.zip"))] == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(n_seeds=0), "n_seeds must be .* got 0"),
        (dict(n_episodes=0), "n_episodes must be .* got 0"),
        (dict(methods=["Q-learning"]), "some of no transfer, .* got .*Q-learning"),
        (dict(methods=[]), "some of no transfer"),
        (dict(methods=[ball_striking.FREQUENT]), "methods needs both"),
    ],
)
def test_bad_input_is_refused_before_anything_is_learnt(tmp_path, change, message):
    arguments = dict(output=tmp_path / "results", n_seeds=1, n_episodes=1, methods=METHODS, workers=1) | change
    with pytest.raises(ValueError, match=message):
        ball_striking.run_experiment(**arguments)
    assert not (tmp_path / "results").exists()
