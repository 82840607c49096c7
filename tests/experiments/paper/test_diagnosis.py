"""What transfer saves at each breadth, of made-up results; and the jobs."""

import numpy as np
import pytest
from imageio.v3 import imread
from sb3_combrel.experiments.statistics import holm, p_value_of_difference

from sb3_combrel.experiments.paper.diagnosis import (
    BREADTHS,
    METHODS,
    MOST_EPISODES,
    diagnosis_jobs,
    diagnosis_table,
    draw_diagnosis,
    method_at,
)
from sb3_combrel.experiments.paper.domains import EXPLORE, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.verdicts import p_text

MEANS = dict(zip(METHODS, (400, 200, 300), strict=True))


def steps(n_runs=8, n_episodes=6, spread=10):
    rng = np.random.default_rng(0)
    return {
        method_at(method, breadth): rng.normal(MEANS[method], spread, size=(n_runs, n_episodes)).astype(int)
        for method in METHODS
        for breadth in BREADTHS
    }


def test_what_is_saved_at_each_breadth():
    table = diagnosis_table(steps(spread=0))
    assert [row[0] for row in table.rows] == ["0.05", "0.1", "0.2", "0.3", "0.4"]
    assert "6 episodes, 8 runs" in table.title
    for row in table.rows:
        assert row[1:4] == ("2,400", "50% (50% to 50%)", "25% (25% to 25%)")
        # Of five tests, each of 2 in 12,870 regroupings at 10,000 draws.
        assert float(row[4]) < 0.01


def test_p_values_are_corrected_over_the_breadths():
    rng = np.random.default_rng(1)
    made = {name: rng.integers(290, 330, size=(8, 6)) for name in steps()}
    raw = [
        p_value_of_difference(*(made[method_at(method, breadth)].sum(axis=1) for method in METHODS[1:]), "permutation")
        for breadth in BREADTHS
    ]
    assert len(set(raw)) == 5 and min(raw) < 0.2
    assert [row[4] for row in diagnosis_table(made).rows] == [p_text(p) for p in holm(np.array(raw))]


def test_a_single_run():
    for row in diagnosis_table(steps(n_runs=1, spread=0)).rows:
        assert row[2:] == ("50% (-)", "25% (-)", "-")


def test_no_difference_between_combrel_and_random_mappings():
    both = steps()
    for breadth in BREADTHS:
        both[method_at(METHODS[1], breadth)] = both[method_at(METHODS[2], breadth)]
    assert {row[4] for row in diagnosis_table(both).rows} == {"1.00"}


@pytest.mark.parametrize("n_runs", [1, 3])
def test_the_figure_names_its_own_number_of_episodes(n_runs, tmp_path):
    # Beside the runs of a figure, which have more episodes.
    others = {"no transfer": np.full((2, 200), 300)}
    png, svg = draw_diagnosis({**others, **steps(n_runs)}, MOUNTAIN_CAR, tmp_path / "diagnosis")
    assert imread(png).std() > 5
    assert "steps in 6 episodes" in svg.read_text()


def test_the_jobs_differ_in_breadth_alone(sources):
    jobs = diagnosis_jobs(MOUNTAIN_CAR, EXPLORE, sources["mountain_car"], 2, 300)
    assert len(jobs) == len(BREADTHS) * len(METHODS) * 2
    assert len({job.name for job in jobs}) == len(jobs)
    assert {job.n_episodes for job in jobs} == {MOST_EPISODES}
    assert {job.n_episodes for job in diagnosis_jobs(MOUNTAIN_CAR, EXPLORE, sources["mountain_car"], 1, 3)} == {3}
    for job in jobs:
        method, breadth = job.method.split(" at ")
        assert method in METHODS
        assert job.learner == {**MOUNTAIN_CAR.settings[EXPLORE].learner, "model_breadth": float(breadth)}
        assert (job.transfer is None) == (method == METHODS[0])
        assert not job.records_selections
