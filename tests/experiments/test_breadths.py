"""The iCub's tasks at several breadths, with few episodes."""

import csv
import sys

import numpy as np
import pytest
from rich.console import Console

from sb3_combrel.experiments import breadths
from sb3_combrel.experiments.statistics import episodes_to_reach, steps_to_reach


@pytest.mark.integration
def test_the_experiment_writes_a_line_for_each_run_and_a_table(tmp_path):
    breadths.run_experiment(tmp_path, 1, 6, (0.2,), 1, Console(record=True, width=200))
    with (tmp_path / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["setting"] for row in rows] == ["torso 0.2", "torso 0.2 noisy", "arm 0.2", "arm 0.2 noisy"]
    assert float(rows[0]["episodes_until_learnt"]) == 6.0
    assert rows[2]["episodes_until_learnt"] == "inf", "six episodes are not enough for the arm"
    assert all(int(row["steps"]) <= 6 * breadths.MAX_EPISODE_STEPS for row in rows)
    table = (tmp_path / "tables.md").read_text()
    assert "| torso 0.2 | 1 of 1 | 6 (6 to 6) |" in table and "| arm 0.2 | 0 of 1 |" in table


@pytest.mark.parametrize("change", [dict(n_seeds=0), dict(n_episodes=-1), dict(workers=0), dict(breadths=(0.1, 0.0))])
def test_bad_input_is_refused(tmp_path, change):
    arguments = dict(output=tmp_path / "results", n_seeds=1, n_episodes=1, breadths=(0.1,), workers=1) | change
    with pytest.raises(ValueError, match=next(iter(change))):
        breadths.run_experiment(**arguments)
    assert not (tmp_path / "results").exists()


def test_results_of_another_learner_are_refused_with_a_remedy_that_the_command_has(tmp_path, monkeypatch):
    (tmp_path / "settings.json").write_text('{"tasks": [], "learner": {"degree": 1}}')
    monkeypatch.setattr(sys, "argv", ["breadths", "--output", str(tmp_path)])
    with pytest.raises(ValueError, match=r"learner was {'degree': 1} and is .*; use another --output$"):
        breadths.main()
    assert [path.name for path in tmp_path.iterdir()] == ["settings.json"]


def test_episodes_and_steps_until_a_threshold():
    rng = np.random.default_rng(0)
    steps = rng.integers(1, 100, (30, 12))
    for window, threshold in ((1, 20), (5, 40), (13, 99)):
        episodes = episodes_to_reach(steps, threshold, window)
        for row, n, in_steps in zip(steps, episodes, steps_to_reach(steps, threshold, window), strict=True):
            first = next((i for i in range(window, 13) if np.median(row[i - window : i]) <= threshold), np.inf)
            assert n == first
            assert in_steps == (row[: int(n)].sum() if np.isfinite(n) else np.inf)
