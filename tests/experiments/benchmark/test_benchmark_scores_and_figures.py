"""Performance, ranks, tests and tables against naive computations on made-up runs."""

import itertools
import re

import numpy as np
import pytest
from rich.console import Console

from sb3_combrel.comparison.curves import LearningCurves
from sb3_combrel.comparison.statistics import holm
from sb3_combrel.experiments.benchmark import report
from sb3_combrel.experiments.benchmark.figures import WINDOW, _by_episodes, _by_steps, draw_pair
from sb3_combrel.experiments.benchmark.methods import METHODS, NONE, Method
from sb3_combrel.experiments.benchmark.methods import method_of as named_method
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.runs import jobs_of
from sb3_combrel.experiments.benchmark.scores import (
    cells_of,
    compare,
    interquartile,
    mean_ranks,
    n_compared,
    performances,
    ranks,
)
from sb3_combrel.experiments.suite.tasks import Source
from sb3_combrel.runs.job import Result


def pair_of(name="made-up", **options):
    """A pair that nobody learns; 8 episodes unless ``n_steps`` is given."""
    budget = {} if "n_steps" in options else {"n_episodes": 8}
    return Pair(name, "Made up.", (Source("nothing", None),), "CartPole-v1", **budget, **options)


def method_of(name, same_as=None):
    return Method(name, f"Made-up {name}.", None, same_as=None if same_as is None else lambda pair: same_as)


def outcome(pair, method, seed, returns, steps=None, misfit="", error=""):
    steps = [10] * len(returns) if steps is None else steps
    more = {"known_share": 0.5, "mapping_steps": 3, **({"misfit": misfit} if misfit else {})}
    ends = [True] * len(steps)
    return Result("run", pair, method, seed, list(steps), list(returns), ends, sum(steps), more, 1.5, error)


def made_up(levels, pair="made-up", n_seeds=5, n_episodes=8, seed=0):
    """Outcomes of methods whose returns are normal around a level."""
    rng = np.random.default_rng(seed)
    return [
        outcome(pair, name, number, rng.normal(level, 1.0, n_episodes).tolist())
        for name, level in levels.items()
        for number in range(n_seeds)
    ]


def naive_iqm(values):
    """The mean of what is left when a quarter of the values, rounded down, is taken away at each end."""
    values, cut = sorted(values), len(values) // 4
    return np.mean(values[cut : len(values) - cut])


def cells_by(levels, **options):
    outcomes, pair = made_up(levels, **options), pair_of(options.get("pair", "made-up"))
    return pair, cells_of(pair, [method_of(name) for name in levels], outcomes, range(100))


class TestPerformance:
    def test_over_episodes_it_is_the_mean_return(self):
        pair, cells = cells_by({NONE: 0.0, "a": 3.0})
        for name, found in performances(pair, cells).items():
            np.testing.assert_allclose(found, [np.mean(each.returns) for each in cells[name].outcomes])

    def test_over_steps_each_step_counts_the_return_of_its_episode(self):
        pair = pair_of(n_steps=50)
        runs = {NONE: ([1.0, 4.0], [20, 30]), "a": ([2.0, 3.0, 5.0], [10, 10, 25])}
        outcomes = [outcome("made-up", name, 0, returns, steps) for name, (returns, steps) in runs.items()]
        found = performances(pair, cells_of(pair, [method_of(name) for name in runs], outcomes, [0]))
        # The shortest has 45 steps in episodes that have ended.
        for name, (returns, steps) in runs.items():
            np.testing.assert_allclose(found[name], [np.repeat(returns, steps)[:45].mean()])

    @pytest.mark.parametrize("n_seeds", [3, 4, 7, 10])
    def test_the_estimate_is_the_interquartile_mean_within_its_interval(self, n_seeds):
        values = np.random.default_rng(n_seeds).normal(size=n_seeds)
        found = interquartile(values)
        assert found.mean == pytest.approx(naive_iqm(values))
        assert values.min() <= found.low <= found.mean <= found.high <= values.max()

    def test_fewer_than_three_runs_have_no_interval(self):
        found = interquartile(np.array([1.0, 2.0]))
        assert found.mean == 1.5 and np.isnan(found.low) and np.isnan(found.high)
        assert report.estimate_text(found) == "1.5"


class TestRanks:
    def test_the_best_has_1_and_equal_ones_share(self):
        _, cells = cells_by({"a": 0.0, "b": 5.0, "c": 10.0})
        performance = {name: np.array(values) for name, values in {"a": [1.0] * 4, "b": [7.0] * 4, "c": [1.0] * 4}.items()}
        assert ranks(performance, cells) == {"a": 2.5, "b": 1.0, "c": 2.5}

    def test_methods_with_the_same_runs_count_as_one(self):
        pair = pair_of()
        methods = [method_of("a"), method_of("b", same_as="c"), method_of("c"), method_of("d")]
        cells = cells_of(pair, methods, made_up({"a": 0.0, "c": 5.0, "d": -5.0}), range(5))
        assert cells["b"].outcomes == cells["c"].outcomes and cells["b"].run_as == "c"
        assert [each.seed for each in cells_of(pair, methods, cells["a"].outcomes, [1, 3])["a"].outcomes] == [1, 3]
        assert ranks(performances(pair, cells), cells) == {"a": 2.0, "b": 1.0, "c": 1.0, "d": 3.0}
        compared = compare(pair, cells)
        assert report.note_of("b", cells["b"]) == "the same as c"
        np.testing.assert_array_equal(compared["b"].performance, compared["c"].performance)

    def test_a_method_is_run_by_itself_where_the_one_that_makes_the_same_is_not_chosen(self):
        pair, methods = pair_of(), [method_of(NONE), method_of("b", same_as="c")]
        jobs = jobs_of([pair], methods, range(5), {(pair.name, seed): () for seed in range(5)})
        assert [job.method for job in jobs[:2]] == [NONE, "b"]
        cells = cells_of(pair, methods, [job.result([1 + job.seed], [1.0], [True], 1) for job in jobs], range(5))
        assert len(cells["b"].outcomes) == 5 and report.note_of("b", cells["b"]) == ""

    def test_the_table_says_where_seeds_make_no_difference(self):
        pair, methods = pair_of(), [method_of(NONE), method_of("a")]
        same = [outcome(pair.name, "a", seed, [1.0, 2.0]) for seed in range(3)]
        differs, notes = outcome(pair.name, "a", 3, [2.0, 1.0]), {}
        for runs in (same[:1], same, [*same, differs]):
            notes[len(runs)] = report.note_of("a", cells_of(pair, methods, runs, range(4))["a"])
        assert notes == {1: "", 3: "all runs alike", 4: ""}

    def test_mean_ranks_are_those_of_a_naive_computation(self):
        levels = {"one": {"a": 0.0, "b": 0.2, "c": 0.4}, "two": {"a": 0.3, "b": 0.0, "c": 0.2}}
        cells = {name: cells_by(of, pair=name, seed=k)[1] for k, (name, of) in enumerate(levels.items())}
        performance = {name: performances(pair_of(name), cells[name]) for name in levels}
        found = mean_ranks(performance, cells)
        for method in "abc":
            places = []
            for of_methods in performance.values():
                mine = naive_iqm(of_methods[method])
                places.append(1 + sum(naive_iqm(other) > mine for other in of_methods.values()))
            assert found[method].rank == pytest.approx(np.mean(places)) and found[method].n_pairs == 2
        # All places are taken.
        assert sum(each.rank for each in found.values()) == pytest.approx(6.0)

    def test_where_cells_are_empty_ranks_are_stretched(self):
        cells = {
            "one": cells_by({"a": 0.0, "b": 10.0, "c": 20.0}, pair="one")[1],
            "two": cells_by({"a": 0.0, "b": 10.0}, pair="two")[1],
        }
        found = mean_ranks({name: performances(pair_of(name), cells[name]) for name in cells}, cells)
        assert {name: (each.rank, each.n_pairs) for name, each in found.items()} == {
            "a": (3.0, 2),
            "b": (1.5, 2),
            "c": (1.0, 1),
        }


LEVELS = {NONE: 0.0, "a": 5.0, "b": 0.1, "c": -5.0}


class TestComparison:
    def test_p_values_are_corrected_over_the_methods_of_a_pair(self):
        pair, cells = cells_by(LEVELS)
        found, performance = compare(pair, cells), performances(pair, cells)
        raw = []
        for name in "abc":
            together = np.concatenate([performance[name], performance[NONE]])
            difference = abs(performance[name].mean() - performance[NONE].mean())
            splits = [set(chosen) for chosen in itertools.combinations(range(10), 5)]
            means = [
                abs(np.mean([together[k] for k in s]) - np.mean([together[k] for k in range(10) if k not in s]))
                for s in splits
            ]
            raw.append(np.mean(np.array(means) >= difference - 1e-12))
        np.testing.assert_allclose([found[name].p_value for name in "abc"], list(holm(dict(enumerate(raw))).values()))
        assert np.isnan(found[NONE].p_value) and found[NONE].measures is None
        assert [found[name].better for name in "ac"] == [True, False]

    def test_measures_are_differences_to_no_transfer(self):
        pair, cells = cells_by(LEVELS)
        found = compare(pair, cells)["a"].measures
        returns = {name: np.array([each.returns for each in cells[name].outcomes]) for name in ("a", NONE)}
        difference = returns["a"] - returns[NONE]
        assert found.jumpstart.effect == pytest.approx(difference[:, :5].mean())
        assert found.asymptotic_performance.effect == pytest.approx(difference.mean())
        assert found.total_reward.effect == pytest.approx(difference.sum(axis=1).mean())
        assert found.floor == pytest.approx(min(min(each.returns) for cell in cells.values() for each in cell.outcomes))

    def test_areas_over_steps_end_at_the_same_step_in_all_rows(self):
        steps = {NONE: 10, "a": 10, "shorter": 4}
        runs = [(name, seed) for name in steps for seed in range(3)]
        outcomes = [outcome("made-up", name, seed, [1.0 * seed] * 8, [steps[name]] * 8) for name, seed in runs]
        pair = pair_of(n_steps=80)
        found = compare(pair, cells_of(pair, [method_of(name) for name in steps], outcomes, range(3)))
        # The shortest run of all methods has 32 steps; the returns are the seed's.
        assert found["a"].measures.total_reward_by_steps.with_transfer.tolist() == [0.0, 32.0, 64.0]

    def test_without_no_transfer_nothing_is_compared(self):
        pair, cells = cells_by({"a": 0.0, "b": 1.0})
        found = compare(pair, cells)
        assert set(found) == {"a", "b"} and all(each.measures is None and np.isnan(each.p_value) for each in found.values())

    def test_two_runs_are_not_tested(self):
        pair, cells = cells_by(LEVELS, n_seeds=2)
        found = compare(pair, cells)
        assert all(np.isnan(each.p_value) for each in found.values())
        assert all(np.isnan(p) for p in found["a"].p_values.values())


class TestTables:
    METHODS = (method_of(NONE), method_of("a"), method_of("b"), method_of("c"))

    @pytest.fixture
    def found(self):
        """Cells and comparisons: "b" does not fit, one run of "c" failed."""
        outcomes = made_up({NONE: 0.0, "a": 5.0, "c": -5.0})
        outcomes = [each for each in outcomes if (each.method, each.seed) != ("c", 4)]
        outcomes += [outcome("made-up", "c", 4, [], error="ValueError: no"), outcome("made-up", "b", 0, [], misfit="too wide")]
        pair = pair_of()
        cells = cells_of(pair, self.METHODS, outcomes, range(5))
        return pair, cells, compare(pair, cells), outcomes

    def test_a_row_for_each_method(self, found):
        pair, cells, compared, _ = found
        table = report.pair_table(pair, cells, compared)
        rows = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
        assert [rows[name]["runs"] for name in (NONE, "a", "b", "c")] == ["5", "5", "", "4"]
        assert [rows[name]["rank"] for name in (NONE, "a", "c")] == ["2", "1", "3"]
        assert rows["b"]["note"] == "does not fit: too wide" and rows["c"]["note"] == "failed (seed 4): ValueError: no"
        assert rows["a"]["known mapping"] == "50%" and rows["a"]["steps to a mapping"] == "3" and rows["a"]["seconds"] == "1.5"
        assert rows["a"]["performance"].startswith(f"{naive_iqm([np.mean(e.returns) for e in cells['a'].outcomes]):.1f} [")

    def test_over_steps_it_says_how_many_are_measured_and_whose_run_ends_them(self, tmp_path):
        pair, outcomes = pair_of(n_steps=200), [outcome("made-up", NONE, seed, [-1.0] * 20) for seed in (0, 1)]
        outcomes += [outcome("made-up", "a", 0, [-1.0] * 20), outcome("made-up", "a", 1, [-1.0] * 3)]
        made = report.write_report([pair], self.METHODS, [0, 1], outcomes, tmp_path, ["command"], Console(quiet=True))
        assert "over the first 30 steps, as many as all runs have" in made[-1].read_text()
        assert "(fewest: a, seed 1)" in made[-1].read_text()

    def test_better_and_worse_than_none_are_counted(self, found):
        pair, cells, compared, _ = found
        table = report.rank_table(self.METHODS, {pair.name: cells}, {pair.name: compared})
        assert [row[0] for row in table.rows] == ["a", NONE, "c", "b"]
        assert [row[-2:] for row in table.rows] == [("1", "0"), ("-", "-"), ("0", "1"), ("", "")]

    @pytest.mark.parametrize(("names", "n_seeds"), [((NONE, "a"), 2), (("a", "b"), 5)])
    def test_where_nothing_is_tested_nothing_is_counted(self, names, n_seeds):
        methods, pair = [method_of(name) for name in names], pair_of()
        cells = cells_of(pair, methods, made_up(dict.fromkeys(names, 0.0), n_seeds=n_seeds), range(n_seeds))
        table = report.rank_table(methods, {pair.name: cells}, {pair.name: compare(pair, cells)})
        assert {row[-2:] for row in table.rows} == {("-", "-")}

    @pytest.mark.parametrize(
        ("n_seeds", "n_methods", "words"),
        [
            (1, 1, "seeds=1 is too few for intervals and tests, .* alone; take at least 4, better 10"),
            (
                3,
                1,
                r"seeds=3 is too few for p < 0\.05: of 1 method compared with none the smallest possible is 0\.10, by Holm",
            ),
            (5, 17, r"of 17 methods .* is 0\.13, by Holm's method; take at least 6, better 10"),
        ],
    )
    def test_too_few_seeds_for_any_difference_are_said(self, n_seeds, n_methods, words):
        assert re.search(words, report.few_runs(n_seeds, n_methods))
        assert not report.few_runs(10, n_methods) and not report.few_runs(3, 0)

    def test_methods_that_are_compared_are_counted_once_a_run(self):
        methods = [method_of(NONE), method_of("a"), method_of("b", same_as="a")]
        assert n_compared([pair_of()], methods) == 1 and n_compared([pair_of()], methods[1:]) == 0

    def test_performance_of_all_pairs(self, found):
        pair, cells, compared, _ = found
        table = report.performance_table([pair], self.METHODS, {pair.name: cells}, {pair.name: compared})
        assert [row[1].endswith(end) for row, end in zip(table.rows, (" (2)", "* (1)", "", "* (3)"), strict=True)] == [
            True
        ] * 4
        assert table.rows[2] == ("b", "")

    def test_a_report_without_any_run(self, tmp_path):
        pair = pair_of()
        outcomes = [outcome("made-up", each.name, 0, [], error="RuntimeError: never") for each in self.METHODS]
        made = report.write_report([pair], self.METHODS, [0], outcomes, tmp_path, ["command"], Console(quiet=True))
        assert all(path.exists() for path in made) and "RuntimeError: never" in (tmp_path / "made-up.md").read_text()

    def test_names_with_dots_have_files_of_their_own(self, tmp_path):
        pairs = [pair_of(name) for name in ("walk.1", "walk.2")]
        made = report.write_report(pairs, self.METHODS, [0], [], tmp_path, ["command"], Console(quiet=True))
        assert len(set(made)) == len(made) and {"walk.1.md", "walk.1.png", "walk.2.md"} <= {path.name for path in made}


def test_a_method_whose_name_is_no_file_name_is_refused():
    with pytest.raises(ValueError, match=r'name must be of letters, digits, "-", "_" and "\.", got \'a/b\''):
        method_of("a/b")


def test_each_method_of_the_package_says_what_it_is():
    assert next(iter(METHODS)) == NONE
    assert all(method.description and name == method.name for name, method in METHODS.items())


def test_a_method_of_ones_own_is_described_by_its_own_words_alone(tmp_path):
    lines = [
        "from sb3_combrel import COMBREL",
        "class Silent(COMBREL):",
        "    pass",
        "class Said(COMBREL):",
        '    """What."""',
    ]
    (tmp_path / "own.py").write_text("\n".join(lines))
    found = [named_method(f"{tmp_path / 'own.py'}:{name}") for name in ("Silent", "Said")]
    assert [method.description for method in found] == ["", "What."]


# Curves over environment steps and episodes, against naive computations.
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
