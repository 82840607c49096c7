"""What is kept of the baselines' evaluations."""

from helpers.paper_results import made_up

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baseline_runs import baselines_table, evaluation_rows
from sb3_combrel.experiments.paper.baselines import PLAIN, QUANTILE

EVALUATIONS = [[1000, -400.0, 0.0], [20_000, -30.0, 1.0]]
RESULTS = {
    "mountain_car": [made_up("mountain_car", m.COMBREL_PLAIN, 1, [5, 4])],
    "icub": [
        made_up("icub", QUANTILE, 1, [5, 4], evaluations=[[1000, -400.0, 0.2], [20_000, -400.0, 0.8]]),
        made_up("icub", PLAIN, 7, [5, 4], evaluations=EVALUATIONS),
        made_up("icub", PLAIN, 2, [5, 4], evaluations=EVALUATIONS[1:]),
    ],
}


def test_rows_are_all_evaluations_by_domain_algorithm_and_seed():
    header, *rows = evaluation_rows(RESULTS)
    assert header == ("domain", "algorithm", "seed", "steps", "greedy_return", "fraction_reached")
    assert rows == [
        ("icub", PLAIN, 2, 20_000, -30.0, 1.0),
        ("icub", PLAIN, 7, 1000, -400.0, 0.0),
        ("icub", PLAIN, 7, 20_000, -30.0, 1.0),
        ("icub", QUANTILE, 1, 1000, -400.0, 0.2),
        ("icub", QUANTILE, 1, 20_000, -400.0, 0.8),
    ]


def test_the_table_says_from_where_on_the_goal_is_always_reached():
    assert [row[1:] for row in baselines_table(RESULTS).rows] == [
        (PLAIN, "20,000", "2 of 2", "20,000", "-30"),
        (QUANTILE, "20,000", "0 of 1", "never", "-400"),
    ]
