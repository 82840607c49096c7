"""Figures of few and many runs: both files are made, drawn with something, and the same to the byte for the same data."""

import itertools
import warnings
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from imageio.v3 import imread
from sb3_combrel.experiments.figures import moving_average

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.curves import STYLES, WINDOW, draw_curves, draw_selection, draw_times
from sb3_combrel.experiments.paper.domains import DOMAINS, MOUNTAIN_CAR


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def steps(n_runs, n_episodes, low=100, high=800):
    rng = np.random.default_rng([n_runs, n_episodes])
    return {
        method: rng.integers(low, high, size=(n_runs, n_episodes)) for method in (m.NO_TRANSFER, m.COMBREL_PLAIN, m.ORACLE)
    }


def check(files, *texts, size=(400, 600)):
    """Both files exist, the image has something on it, and the drawing is XML with the texts."""
    png, svg = files
    assert (png.suffix, svg.suffix) == (".png", ".svg")
    image = imread(png)
    assert image.shape[0] > size[0] and image.shape[1] > size[1]
    assert len(np.unique(image.reshape(-1, image.shape[-1]), axis=0)) > 10
    drawing = svg.read_text()
    ElementTree.fromstring(drawing)
    for text in texts:
        assert text in drawing
    return drawing


@pytest.mark.parametrize("draw", [draw_curves, draw_times])
@pytest.mark.parametrize(("n_runs", "n_episodes"), [(1, 1), (2, 2), (3, WINDOW), (4, 40)])
def test_few_runs_and_episodes(draw, n_runs, n_episodes, tmp_path):
    domain = DOMAINS["icub" if n_runs % 2 else "mountain_car"]
    panels = {"methods": steps(n_runs, n_episodes), "controls": steps(n_runs, n_episodes)}
    drawing = check(draw(panels, domain, "some title", tmp_path / "made" / "fig"), "some title", "controls", "oracle mapping")
    assert f"({n_runs} runs)" in drawing or draw is draw_times


@pytest.mark.parametrize("draw", [draw_curves, draw_times])
def test_steps_that_never_change_and_thresholds_never_reached(draw, tmp_path):
    panels = {"methods": {m.NO_TRANSFER: np.full((3, 20), 4000), m.COMBREL_PLAIN: np.full((3, 20), 4000)}}
    drawing = check(draw(panels, MOUNTAIN_CAR, "title", tmp_path / "fig"))
    assert ("no threshold was reached" in drawing) == (draw is draw_times)


def test_thresholds_that_some_runs_reach(tmp_path):
    some = np.array([[900] * 8 + [240] * 8, [900] * 16, [900] * 8 + [350] * 8])
    all_runs = np.full((3, 16), 200)
    panels = {"methods": {m.NO_TRANSFER: some, m.COMBREL_PLAIN: all_runs}, "controls": {m.ORACLE: np.full((3, 16), 900)}}
    drawing = check(draw_times(panels, MOUNTAIN_CAR, "title", tmp_path / "fig"))
    assert "no threshold was reached" not in drawing


def test_a_method_that_never_reaches_a_threshold_has_no_point_there(tmp_path):
    def uses_of(samples, name):
        _, svg = draw_times({"methods": {m.COMBREL_PLAIN: samples}}, MOUNTAIN_CAR, "title", tmp_path / name)
        return svg.read_text().lower().count(f'style="fill: {STYLES[m.COMBREL_PLAIN][0].lower()}; stroke')

    # Thresholds 400, 300 and 250.
    reached = [uses_of(np.full((2, 10), n), f"fig{n}") for n in (200, 280, 380, 500)]
    assert [before - after for before, after in itertools.pairwise(reached)] == [1, 1, 1]


def test_the_same_data_give_the_same_bytes(tmp_path):
    for draw in (draw_curves, draw_times):
        files = [draw({"methods": steps(3, 20)}, MOUNTAIN_CAR, "title", tmp_path / part / "fig") for part in ("one", "two")]
        for one, two in zip(*files, strict=True):
            assert one.read_bytes() == two.read_bytes()


def test_moving_averages_of_fewer_episodes_than_the_window_are_of_all():
    samples = np.arange(14).reshape(2, 7) ** 2
    expected = [[np.mean(row[k : k + WINDOW]) for k in range(7 - WINDOW + 1)] for row in samples]
    np.testing.assert_allclose(moving_average(samples, WINDOW), expected)
    np.testing.assert_allclose(moving_average(samples[:, :2], WINDOW), samples[:, :2].mean(axis=1, keepdims=True))


def test_every_method_has_a_colour_and_line_of_its_own():
    assert set(STYLES) >= set(m.METHODS)
    in_one_figure = [name for name in STYLES if name not in (m.TIMBREL_FREQUENT, m.COMBREL_WHOLE)]
    assert len({STYLES[name] for name in in_one_figure}) == len(in_one_figure)


def test_selection_over_a_plane(tmp_path):
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 6), np.linspace(0, 2, 5)), axis=-1).reshape(-1, 2)
    action = np.arange(len(grid)) % 4 - 1
    names = ["Left", "Neutral", "Right"]
    nothing = np.full(len(grid), -1)
    panels = {"x and y": (grid, action, names), "x and vx": (grid, nothing, names)}
    drawn = draw_selection(panels, ("x", "y"), ("x", "vx"), title="title", path=tmp_path / "fig4")
    check(drawn, "Left", "Neutral", "Right", "nothing", "vx")
    none = {"x and y": (grid, nothing, [])}
    check(draw_selection(none, ("x", "y"), title="title", path=tmp_path / "none"), "nothing")
