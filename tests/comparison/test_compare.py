"""``sb3_combrel.compare``: does transfer help? Checks before any run, figures, sentence, picture."""

import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from helpers.own_method import Mine
from helpers.walk import Walk, walk_source

import sb3_combrel
from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping
from sb3_combrel.comparison import compare as module
from sb3_combrel.comparison.compare import compare
from sb3_combrel.comparison.controls import CONTROL, name_of_control, random_control
from sb3_combrel.comparison.curves import LearningCurves, returns_over_steps
from sb3_combrel.comparison.measures import compare_learning
from sb3_combrel.runs.episodes import EpisodeRecorder
from sb3_combrel.runs.runner import JobError
from sb3_combrel.transfer.report import MappingReport, TransferReport

LEARNER = dict(model_breadth=0.15, resolution=3, degree=0)
METHODS = {"none": None, "TIMBREL": TIMBREL(walk_source(), InterTaskMapping((0, 1), (0, 1)))}


@pytest.fixture(scope="module")
def result():
    with pytest.warns(UserWarning, match="Only 2 seeds"):
        return compare(Walk, METHODS, seeds=np.array([3, 1]), steps=150, controls=False, **LEARNER)


def test_each_run_is_that_of_the_learner_with_its_seed(result):
    for method, transfer in METHODS.items():
        for row, seed in enumerate([3, 1]):
            recorder = EpisodeRecorder()
            FittedRMax(Walk(), transfer=transfer, seed=seed, **LEARNER).learn(150, recorder, log_interval=None)
            curves, n = result.curves[method], len(recorder.episodes.steps)
            assert curves.n_episodes[row] == n > 1
            np.testing.assert_array_equal(curves.returns[row, :n], recorder.episodes.returns)
            np.testing.assert_array_equal(curves.steps[row, :n], recorder.episodes.steps)


def cells_of(table):
    """The cells of each line of a Markdown table, but for the rule, without the spaces around them."""
    lines = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table.splitlines()]
    return [lines[0], *lines[2:]]


def test_measures_are_those_of_taylor_and_stone(result):
    with_transfer, without = result.curves["TIMBREL"], result.curves["none"]
    n = min(10, *with_transfer.n_episodes, *without.n_episodes)
    measures = compare_learning(with_transfer, without, threshold=result.threshold, n_last=n, n_first=min(5, n))
    ours = result.measures["TIMBREL"]
    for name in ("jumpstart", "asymptotic_performance", "total_reward_by_steps", "time_to_threshold"):
        np.testing.assert_equal(getattr(ours, name)[2:], getattr(measures, name)[2:])
    last = [row[:count][-n:].mean() for row, count in zip(without.returns, without.n_episodes, strict=True)]
    assert result.threshold == pytest.approx(np.median(last))
    assert [[report.n_steps for report in reports] for reports in result.reports.values()] == [[150, 150]]
    assert result.n_steps == min(np.nansum(curves.steps, axis=1).min() for curves in (with_transfer, without))


def test_the_table_has_a_row_for_each_measure_and_the_figure_a_curve_for_each_method(result):
    assert len({len(line) for line in result.table.splitlines()}) == 1, "columns stand below each other"
    header, *lines = cells_of(result.table)
    assert [line[0] for line in lines] == [
        "jumpstart",
        "asymptotic performance",
        "mean return over steps",
        "transfer ratio, over steps",
        f"steps to a return of {result.threshold:.4g}",
    ]
    assert header == ["measure", "method", "none", "with", "difference", "95% interval", "p", "p (Holm)"]
    measure = result.measures["TIMBREL"].total_reward_by_steps
    assert lines[2][2:5] == [
        f"{measure.without.mean() / result.n_steps:.4g}",
        f"{measure.with_transfer.mean() / result.n_steps:.4g}",
        f"{measure.effect / result.n_steps:+.3g}",
    ]
    [axes] = result.figure().axes
    assert [line.get_label() for line in axes.get_lines()] == ["none (2 runs)", "TIMBREL (2 runs)"]
    curve = axes.get_lines()[1]
    expected = returns_over_steps(result.curves["TIMBREL"], curve.get_xdata()).mean(axis=0)
    np.testing.assert_allclose(curve.get_ydata(), expected)
    assert str(result) == "\n\n".join([result.sentence, *result.warnings, result.table])


def test_returns_over_steps_are_those_of_the_episode_under_way():
    curves = LearningCurves.from_rows([[-3.0, -2.0, -4.0], [-5.0, -1.0]], [[3, 2, 4], [5, 1]])
    found = returns_over_steps(curves, np.arange(6.0))
    np.testing.assert_array_equal(found, [[-3, -3, -3, -2, -2, -4], [-5, -5, -5, -5, -5, -1]])


def made_up(monkeypatch, returns, **arguments):
    """Compare methods whose episodes have these returns, of 10 steps each; one row a seed."""

    def run_missing(jobs, **_):
        episodes = {job.name: returns[job.method][job.seed].tolist() for job in jobs}
        return [
            job.result([10] * len(of), of, [True] * len(of), 120, {"report": None})
            for job in jobs
            if (of := episodes[job.name])
        ]

    monkeypatch.setattr(module, "run_missing", run_missing)
    n = len(next(iter(returns.values())))
    # The learner itself is not asked.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        methods = {name: TIMBREL(walk_source(), "random") if name == CONTROL else None for name in returns}
        return compare(Walk, methods, **{"seeds": n, "steps": 120, "baseline": "none", **arguments})


def around(mean, n_runs, spread=1.0):
    return mean + spread * np.random.default_rng(int(abs(mean))).normal(size=(n_runs, 12))


@pytest.mark.parametrize(
    ("mean", "says"),
    [(-50.0, "transfer helped"), (-70.0, "transfer harmed"), (-60.2, "not shown that transfer helps or harms")],
)
def test_the_sentence_says_whether_transfer_helped(monkeypatch, mean, says):
    returns = around(mean, 6)
    found = made_up(monkeypatch, {"none": around(-60.0, 6), "COMBREL": returns})
    assert found.sentence.startswith("COMBREL: ") and says in found.sentence
    assert f"its mean return over 120 steps is {returns.mean():.4g}, that of none" in found.sentence
    assert (found.p_values["COMBREL"] < 0.05) == ("helped" in says or "harmed" in says)


@pytest.mark.parametrize(("mean", "says"), [(-50.0, "is better than"), (-70.0, "is worse than"), (-60.2, "not shown to be")])
def test_of_a_baseline_that_transfers_it_is_said_which_is_better(monkeypatch, mean, says):
    reports = {"COMBREL": (TransferReport("COMBREL()", "prior"),)}
    runs = {"COMBREL": around(-60.0, 6), "none": around(mean, 6)}
    found = replace(made_up(monkeypatch, runs, baseline="COMBREL"), reports=reports)
    assert found.sentence.startswith("none: it is ") and says in found.sentence and "COMBREL: its mean" in found.sentence
    assert "helped" not in found.sentence and "harm" not in found.sentence


@pytest.mark.parametrize("n_runs", [1, 2, 3])
def test_with_too_few_runs_nothing_is_claimed(monkeypatch, n_runs):
    found = made_up(monkeypatch, {"none": around(-60.0, n_runs), "COMBREL": around(-5.0, n_runs)})
    assert "too few runs to tell" in found.sentence and "helped" not in found.sentence


def test_with_several_methods_more_seeds_are_asked_for(monkeypatch):
    one = made_up(monkeypatch, {"none": around(-60.0, 3), "COMBREL": around(-5.0, 3)})
    assert "take at least 4 seeds, better 10" in one.sentence
    # Of 70 regroupings of four and four two are extreme: with two tests that is 0.057.
    two = made_up(monkeypatch, {"none": around(-60.0, 4), "COMBREL": around(-5.0, 4), "TIMBREL": around(-5.0, 4)})
    assert two.sentence.count("take at least 5 seeds, better 10") == 2
    enough = made_up(monkeypatch, {"none": around(-60.0, 5), "COMBREL": around(-5.0, 5), "TIMBREL": around(-5.0, 5)})
    assert enough.sentence.count("transfer helped") == 2


def test_several_methods_are_corrected_for_their_number(monkeypatch):
    runs = {"none": around(-60.0, 5), "one": around(-50.0, 5), "two": around(-40.0, 5)}
    found = made_up(monkeypatch, runs, threshold=-10)
    assert ["steps to a return of -10", "one", "not reached", "not reached", "—"] in [row[:5] for row in cells_of(found.table)]
    assert "inf" not in str(found) and "nan" not in str(found)
    smallest = 2 / 252
    assert found.p_values == pytest.approx({"one": 2 * smallest, "two": 2 * smallest})
    assert found.sentence.count("transfer helped") == 2
    assert found.sentence.count("(p = 0.016, by Holm's correction for 2 comparisons)") == 2
    [mean_of_one, _] = [row for row in cells_of(found.table) if row[0] == "mean return over steps"]
    assert mean_of_one[-2:] == ["0.0079", "0.016"]
    assert [row[1] for row in cells_of(found.table)[1:]] == ["one"] * 5 + ["two"] * 5
    # Ratios above different floors could not be compared: the third method has the lowest return of all.
    lowest = made_up(monkeypatch, {**runs, "three": around(-90.0, 5)}, threshold=-10)
    floors = [each.floor for each in lowest.measures.values()]
    assert floors == [float(np.nanmin(lowest.curves["three"].returns))] * 3


def test_few_seeds_and_few_episodes_are_warned_of(monkeypatch):
    few = made_up(monkeypatch, {"none": around(-60.0, 4)[:, :9], "COMBREL": around(-5.0, 4)[:, :9]})
    assert [warning[:30] for warning in few.warnings] == ["Only 4 seeds: runs differ more", "The shortest run has only 9 ep"]
    assert all(warning in str(few) for warning in few.warnings)
    assert not made_up(monkeypatch, {"none": around(-60.0, 5), "COMBREL": around(-5.0, 5)}).warnings


def test_rows_that_say_the_same_are_one(monkeypatch):
    """With so few episodes the first are the last, and these all there are."""
    found = made_up(monkeypatch, {"none": around(-60.0, 5)[:, :3], "COMBREL": around(-5.0, 5)[:, :3]})
    _, rows = found.rows
    assert rows[0][0] == "jumpstart, asymptotic performance, mean return over steps"
    assert len({row[1:] for row in rows}) == len(rows) == 3


def test_a_random_mapping_that_does_as_well_is_mentioned(monkeypatch):
    runs = {"none": around(-60.0, 5), "COMBREL": around(-50.0, 5), "random mapping": around(-40.0, 5)}
    reports = (TransferReport("COMBREL()", "prior", mappings=(MappingReport("go", "went"),)),)
    found = replace(made_up(monkeypatch, runs), reports={"COMBREL": reports})
    assert "transfer helped" in found.sentences["COMBREL"]
    but = "But it is not shown to be better than random mapping (-40"
    assert but in found.sentences["COMBREL"] and "But" not in found.sentences["random mapping"]
    better = replace(made_up(monkeypatch, {**runs, "COMBREL": around(-30.0, 5)}), reports={"COMBREL": reports})
    assert "But" not in better.sentence
    # A little better is as good, and a control of the user's own, under another name, is one.
    own = {"none": runs["none"], "COMBREL": around(-39.9, 5), "drawn": runs["random mapping"]}
    assert "But" not in replace(made_up(monkeypatch, own), reports={"COMBREL": reports}).sentence
    found = replace(made_up(monkeypatch, own), reports={"COMBREL": reports}, control="drawn")
    assert "better than drawn (-40" in found.sentences["COMBREL"]


def test_a_control_is_known_by_what_it_is():
    drawn = TIMBREL(walk_source(), "random", use="prior")
    assert name_of_control({"none": None, "mine": drawn}) == "mine" and name_of_control({"none": None}) == "random mapping"


def controls_of(methods, **learner):
    """The control that is added to some methods, each bound as ``compare`` finds it."""
    bound = {name: FittedRMax(Walk(), transfer=each, seed=0, **LEARNER | learner).transfer for name, each in methods.items()}
    return random_control(bound)


def test_a_random_mapping_of_the_same_set_is_the_control():
    prior, instances = COMBREL(walk_source(), "signed_factored"), COMBREL(walk_source(), "surjective", breadth=0.2)
    control = controls_of({"none": None, "COMBREL": prior}, degree=1)
    assert (control.mapping, control.mappings, control.use) == ("random", "signed_factored", "prior")
    control = controls_of({"none": None, "given": METHODS["TIMBREL"], "COMBREL": instances})
    assert (control.mapping, control.mappings, control.use, control.breadth) == ("random", "surjective", "instances", 0.2)
    # Of a mapping that is given, the default set.
    control = controls_of(METHODS)
    assert (control.mapping, control.mappings, control.use) == ("random", "injective", "instances")


@pytest.mark.parametrize(
    "methods",
    [
        {"none": None, "mine": Mine()},
        {"none": None, "COMBREL": COMBREL(walk_source()), "any": TIMBREL(walk_source(), "random")},
    ],
)
def test_there_is_no_control_where_nothing_is_mapped_or_there_is_one(methods):
    assert controls_of(methods) is None


def test_the_control_is_run_unless_it_is_left_out(monkeypatch):
    carried_out = []

    def run_missing(jobs, **_):
        carried_out.extend(jobs)
        return [job.result([10] * 12, [-1.0] * 12, [True] * 12, 120, {"report": None}) for job in jobs]

    monkeypatch.setattr(module, "run_missing", run_missing)
    for controls, names in ((True, ["none", "TIMBREL", "random mapping"]), (False, ["none", "TIMBREL"])):
        carried_out.clear()
        found = compare(Walk, METHODS, seeds=[7, 8, 9, 10, 11], steps=120, controls=controls, **LEARNER)
        assert list(found.curves) == names
        assert [job.seed for job in carried_out] == [7, 8, 9, 10, 11] * len(names)
        assert [job.seed for job in carried_out if job.is_shown] == [7] * len(names)


def test_a_control_that_cannot_be_made_is_warned_of(monkeypatch):
    def refuse(self, *_):
        if self.mapping == "random":
            raise ValueError("too many variables")

    monkeypatch.setattr(TIMBREL, "bind", refuse)
    monkeypatch.setattr(
        module,
        "run_missing",
        lambda jobs, **_: [job.result([10] * 12, [-1.0] * 12, [True] * 12, 120, {"report": None}) for job in jobs],
    )
    with pytest.warns(UserWarning, match=r"there is no control \(random mapping: too many variables\): controls=False"):
        compare(Walk, {"none": None, "COMBREL": COMBREL(walk_source())}, seeds=5, steps=120, **LEARNER)


SHORT = InterTaskMapping((0,), (0, 1))
GOOD = dict(env=Walk, methods=METHODS, seeds=2, steps=50, **LEARNER)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(env="Nowhere-v0"), "env must be the id of an environment .*; there is no 'Nowhere-v0'"),
        (dict(env=Walk()), r"a function that makes one, as each run has its own, got .*lambda: MyEnv\(\)"),
        (dict(env=lambda: 3), "none: env must make Gymnasium environments, got 3"),
        (dict(env="Pendulum-v1"), "none: FittedRMax needs Discrete actions"),
        (dict(methods=[None]), "methods must be a dict from names to transfer methods"),
        (dict(methods={"none": None}), "methods must have at least two"),
        (dict(methods={"none": None, "x": 3}), "got 3 for 'x'"),
        (dict(methods={"none": None, "x": COMBREL}), "got .*COMBREL.* for 'x'"),
        (dict(methods={"a": None, "b": None}), "baseline must be one of a, b, as 2 methods are without transfer"),
        (dict(methods={"a": Mine(), "b": Mine()}), "baseline must be one of a, b, as 0 methods are without transfer"),
        (dict(methods={"a": {}, "b": {"degree": 0}}), "a dict in methods must be a method's name and .*, got {} for 'a'"),
        (dict(methods={"a": None, "b": {"degree": 0}}), "got {'degree': 0} for 'b'; arguments of the learner are those of"),
        (dict(baseline="nobody"), "baseline must be one of none, TIMBREL, got 'nobody'"),
        (dict(methods={"none": None, "x": "sb3_combrel.Nothing"}), "x: transfer names 'sb3_combrel.Nothing', which is no"),
        (dict(methods={"none": None, "x": TIMBREL(walk_source(), SHORT)}), "x: state must have 2 entries"),
        (dict(seeds=0), "seeds must be a whole number of at least 1, got 0"),
        (dict(seeds=[]), "seeds must be different whole numbers"),
        (dict(seeds=[1, 1]), "seeds must be different whole numbers"),
        (dict(seeds=[-1]), "seeds must be a whole number from 0"),
        (dict(steps=0), "steps must be a whole number"),
        (dict(n_jobs=0), "n_jobs must be a whole number"),
        (dict(threshold=np.inf), "threshold must be a finite number"),
        (dict(controls="no"), "controls must be"),
        (dict(progress_bar="yes"), "progress_bar must be"),
        (dict(model_breadth=-1), "none: model_breadth must be"),
        (dict(methods={**METHODS, "random mapping": METHODS["TIMBREL"]}), "methods must call none but .*, got TIMBREL"),
        (
            dict(methods={"TIMBREL": METHODS["TIMBREL"], "random mapping": None}, controls=False),
            "the control's name, got None",
        ),
    ],
)
def test_bad_input_is_refused_before_any_run(change, message, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("the error should have come before")

    monkeypatch.setattr(module, "run_missing", refuse)
    with pytest.raises(ValueError, match=message):
        compare(**{**GOOD, **change})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(model_bread=1), "got 'model_bread'; did you mean 'model_breadth'"),
        (dict(seed=1), "got 'seed'; did you mean 'seeds'"),
        (
            dict(learner={"gamma": 0.9}),
            "those of FittedRMax, such as gamma=0.99, got 'learner'; FittedRMax has .*model_breadth",
        ),
    ],
)
def test_arguments_that_the_learner_does_not_have_are_refused_with_one_that_it_has(wrong, message):
    with pytest.raises(TypeError, match=message):
        compare(**GOOD, **wrong)


@pytest.mark.parametrize(
    ("terminal", "asked", "shown"), [("", None, False), ("1", None, True), ("", True, True), ("1", False, False)]
)
def test_progress_is_shown_in_a_terminal_or_if_asked_for(terminal, asked, shown, monkeypatch, capsys):
    # Rich takes any output for a terminal where this is set.
    monkeypatch.setenv("FORCE_COLOR", terminal)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        compare(**GOOD, controls=False, progress_bar=asked)
    assert bool(capsys.readouterr().err) == shown


def test_runs_that_cannot_begin_or_end_are_named():
    with pytest.raises(ValueError, match="steps=3 is too few: no episode ended in the run of none, seed 0"):
        compare(**{**GOOD, "steps": 3})
    # This error takes more than a message.
    with pytest.raises(ValueError, match="none: 'utf-8' codec can't decode"):
        compare(**{**GOOD, "env": lambda: bytes([0xFF]).decode("utf-8")})


@pytest.mark.long
def test_in_processes_the_results_are_the_same(result):
    here = compare(Walk, METHODS, seeds=[3, 1], steps=150, controls=False, n_jobs=2, **LEARNER)
    assert str(here) == str(result)
    assert list(map(str, here.reports["TIMBREL"])) == list(map(str, result.reports["TIMBREL"]))


class Breaking(Walk):
    """A walk that breaks in the first step."""

    def step(self, action):
        raise OSError("broken")


def test_an_error_within_a_run_is_named_with_its_run_and_traceback():
    with pytest.raises(JobError, match=r"(?s)^none, seed 0: OSError: broken \(5 other runs failed, too\)\nTraceback.*step"):
        compare(**{**GOOD, "env": Breaking})


def test_methods_may_differ_in_case_and_punctuation_alone():
    with pytest.warns(UserWarning, match="Only 1 seed:"):
        found = compare(Walk, dict.fromkeys(["none", "None"]), seeds=1, steps=30, baseline="none")
    assert list(found.curves) == ["none", "None"]


def test_it_is_exported_and_imported_only_when_asked_for():
    assert sb3_combrel.compare is compare and "compare" in sb3_combrel.__all__
    code = (
        "import sys, sb3_combrel; assert 'sb3_combrel.comparison.compare' not in sys.modules; "
        "assert 'scipy.stats' not in sys.modules; sb3_combrel.compare; assert 'sb3_combrel.comparison.compare' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
    with pytest.raises(AttributeError, match="has no attribute 'contrast'"):
        _ = sb3_combrel.contrast
