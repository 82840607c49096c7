"""Curves over environment steps and episodes, against naive computations."""

import numpy as np
import pytest

from sb3_combrel.comparison.curves import LearningCurves
from sb3_combrel.experiments.benchmark.figures import WINDOW, _by_episodes, _by_steps, draw_pair
from sb3_combrel.experiments.benchmark.methods import NONE, Method
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.scores import cells_of, compare
from sb3_combrel.experiments.suite.tasks import Source
from sb3_combrel.runs.job import Result


@pytest.fixture
def curves():
    """Three runs of different numbers of episodes."""
    rng = np.random.default_rng(0)
    steps = [rng.integers(5, 40, size=n).tolist() for n in (4, 9, 15)]
    return LearningCurves.from_rows([rng.normal(size=len(row)).tolist() for row in steps], steps)


def test_over_steps_a_value_is_the_mean_of_the_last_episodes_that_have_ended(curves):
    where, values = _by_steps(curves)
    for run in range(3):
        ends = np.cumsum(curves.steps[run, : int(curves.n_episodes[run])])
        for at, value in zip(where, values[run], strict=True):
            ended = [curves.returns[run, k] for k, end in enumerate(ends) if end <= at]
            assert value == pytest.approx(np.mean(ended[-WINDOW:]))
    # From where every run has an episode to the end of the longest.
    assert where[0] == max(curves.steps[:, 0]) and where[-1] == curves.n_steps.max()


def test_over_episodes_it_is_the_moving_average_as_far_as_all_runs_go(curves):
    where, values = _by_episodes(curves)
    assert where.tolist() == [4] and values.shape == (3, 1)
    np.testing.assert_allclose(values[:, 0], [np.mean(row[:4]) for row in curves.returns])


def drawn_of(names, tmp_path, monkeypatch, n_seeds=4):
    """The panels of a pair's picture by title, and the axes with the performance of its methods."""
    figures = []
    monkeypatch.setattr(f"{draw_pair.__module__}.save", lambda figure, path: figures.append(figure) or [path])
    pair = Pair("made-up", "Made up.", (Source("nothing", None),), "CartPole-v1", n_steps=60)
    rng = np.random.default_rng(0)
    outcomes = [
        Result("run", pair.name, name, seed, [10] * 6, rng.normal(10.0 * number, 1.0, 6).tolist(), [True] * 6)
        for number, name in enumerate(names)
        for seed in range(n_seeds)
    ]
    cells = cells_of(pair, [Method(name, "", None) for name in names], outcomes, range(n_seeds))
    draw_pair(pair, cells, compare(pair, cells), tmp_path / "picture")
    of_curves, of_performance = figures[0].subfigs
    panels = {axes.get_title(): axes for axes in of_curves.axes if axes.get_visible()}
    return panels, of_performance.axes[0] if of_performance.axes else None


def test_each_method_has_a_panel_beside_no_transfer(tmp_path, monkeypatch):
    names = [NONE, *(f"method-{number}" for number in range(5))]
    panels, performance = drawn_of(names, tmp_path, monkeypatch)
    assert list(panels) == [f"{name} (4)" for name in names[1:]]
    for panel in panels.values():
        assert len(panel.lines) == 2 and len(panel.collections) == 2
    assert [label.get_text() for label in performance.get_yticklabels()] == names[::-1]


def test_markers_of_methods_that_differ_are_full(tmp_path, monkeypatch):
    _, performance = drawn_of([NONE, "a"], tmp_path, monkeypatch, n_seeds=8)
    markers = [line for line in performance.lines if line.get_marker() == "o"]
    # From below: the method, which is far better, and no transfer.
    assert [line.get_markerfacecolor() == "white" for line in markers] == [False, True]


def test_few_runs_have_no_bands_and_no_transfer_a_panel_if_it_is_alone(tmp_path, monkeypatch):
    panels, _ = drawn_of([NONE, "a"], tmp_path, monkeypatch, n_seeds=2)
    assert [len(panel.collections) for panel in panels.values()] == [0]
    panels, _ = drawn_of([NONE], tmp_path, monkeypatch)
    assert list(panels) == [f"{NONE} (4)"] and len(panels[f"{NONE} (4)"].lines) == 1
    assert drawn_of([], tmp_path, monkeypatch) == ({}, None)
