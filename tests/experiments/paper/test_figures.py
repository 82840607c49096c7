"""Figures of few and many runs: both files are made, drawn with something, and the same to the byte for the same data."""

import itertools
import warnings

import numpy as np
import pytest
from helpers.paper_results import check_figure, made_up, made_up_runs

from sb3_combrel.experiments.paper import figures
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baselines import ALGORITHMS
from sb3_combrel.experiments.paper.domains import ICUB, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.jobs import BREADTHS, DIAGNOSED_METHODS, method_at


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def steps(n_runs, n_episodes):
    rng = np.random.default_rng([n_runs, n_episodes])
    names = (m.NO_TRANSFER, m.COMBREL_PLAIN, m.ORACLE)
    return {method: rng.integers(100, 800, size=(n_runs, n_episodes)) for method in names}


@pytest.mark.parametrize("draw", [figures.draw_curves, figures.draw_times])
@pytest.mark.parametrize(("n_runs", "n_episodes", "domain"), [(1, 1, ICUB), (4, 40, MOUNTAIN_CAR)])
def test_few_and_many_runs_and_episodes(draw, n_runs, n_episodes, domain, tmp_path):
    panels = {"methods": steps(n_runs, n_episodes), "controls": steps(n_runs, n_episodes)}
    files = draw(panels, domain, "some title", tmp_path / "made" / "fig")
    drawing = check_figure(tmp_path / "made", "fig", "some title", "controls", "oracle mapping")
    assert f"({n_runs} runs)" in drawing or draw is figures.draw_times
    if n_runs > 1:
        before = [file.read_bytes() for file in files]
        assert [file.read_bytes() for file in draw(panels, domain, "some title", tmp_path / "fig")] == before


@pytest.mark.parametrize("draw", [figures.draw_curves, figures.draw_times])
def test_steps_that_never_change_and_thresholds_never_reached(draw, tmp_path):
    draw({"methods": {m.NO_TRANSFER: np.full((3, 20), 4000)}}, MOUNTAIN_CAR, "title", tmp_path / "fig")
    assert ("no threshold was reached" in check_figure(tmp_path, "fig")) == (draw is figures.draw_times)


def test_a_method_that_never_reaches_a_threshold_has_no_point_there(tmp_path):
    def points_of(samples, name):
        _, svg = figures.draw_times({"methods": {m.COMBREL_PLAIN: samples}}, MOUNTAIN_CAR, "title", tmp_path / name)
        return svg.read_text().lower().count(f'style="fill: {figures.STYLES[m.COMBREL_PLAIN][0].lower()}; stroke')

    # Thresholds 400, 300 and 250.
    reached = [points_of(np.full((2, 10), n), f"fig{n}") for n in (200, 280, 380, 500)]
    assert [before - after for before, after in itertools.pairwise(reached)] == [1, 1, 1]


def test_every_method_has_a_colour_and_line_of_its_own():
    assert set(figures.STYLES) == {*m.METHODS, *ALGORITHMS}
    in_one_figure = set(m.METHODS) - {m.TIMBREL_FREQUENT, m.COMBREL_WHOLE}
    assert len({figures.STYLES[name] for name in in_one_figure}) == len(in_one_figure)


def test_selection_over_a_plane(tmp_path):
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 6), np.linspace(0, 2, 5)), axis=-1).reshape(-1, 2)
    names, nothing = ["Left", "Neutral", "Right"], np.full(len(grid), -1)
    panels = {"x and y": (grid, np.arange(len(grid)) % 4 - 1, names), "x and vx": (grid, nothing, [])}
    figures.draw_selection(panels, ("x", "y"), ("x", "vx"), title="title", path=tmp_path / "fig4")
    check_figure(tmp_path, "fig4", "Left", "Neutral", "Right", "nothing", "vx")


@pytest.mark.parametrize("n_runs", [1, 3])
def test_diagnosis_names_its_own_number_of_episodes(n_runs, tmp_path):
    # Beside the runs of a figure, which have more episodes.
    made = {"no transfer": np.full((2, 200), 300)}
    made |= {method_at(method, breadth): np.full((n_runs, 6), 300) for method in DIAGNOSED_METHODS for breadth in BREADTHS}
    figures.draw_diagnosis(made, MOUNTAIN_CAR, tmp_path / "diagnosis")
    check_figure(tmp_path, "diagnosis", "steps in 6 episodes")


def test_baselines_beside_methods(tmp_path):
    evaluations = [[[100, -300.0, 0.0], [400, -200.0, 0.4], [900, -90.0, 1.0]], [[400, -250.0, 0.2], [900, -95.0, 1.0]]]
    learnt = [made_up("icub", name, k, [9], evaluations=each) for name in ALGORITHMS for k, each in enumerate(evaluations)]
    results = {"icub": [*made_up_runs("icub", steps(2, 12)), *learnt]}
    figures.draw_baselines(results, (m.NO_TRANSFER, m.COMBREL_PLAIN), "title", tmp_path / "baselines")
    texts = (f"{m.COMBREL_PLAIN}, learning (2 runs)", *(f"{name}, greedy (2 runs)" for name in ALGORITHMS))
    drawing = check_figure(tmp_path, "baselines", *texts)
    assert m.ORACLE not in drawing
