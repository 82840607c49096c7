"""``sb3-combrel reproduce``: figures, tables, resuming, engines, bad input. Most runs are cut off early, to take a second."""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import pytest
from helpers import command_line
from helpers.clusters import HOST, dask_cluster, free_port
from helpers.paper_results import made_up
from imageio.v3 import imread
from sb3_combrel.experiments.result_files import RESULTS, TIMES

from sb3_combrel.experiments import carrying_out
from sb3_combrel.experiments.paper import baseline_runs, reproduce
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baselines import ALGORITHMS
from sb3_combrel.experiments.paper.domains import DOMAINS
from sb3_combrel.experiments.paper.runs import ResultFiles

# Of the paper's setting.
FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig6")
TABLES = {"table2": 3, "table4": 2, "table5": 1, "table6": 4, "measures": 2}
TINY = ("--runs", "2", "--episodes", "2", "--jobs", "2")


call, succeed, fail = (partial(each, "reproduce") for each in (command_line.call, command_line.succeed, command_line.fail))


def results_in(folder):
    return {path.name: path.read_bytes() for path in sorted((folder / RESULTS).iterdir())}


def all_but_times(folder):
    """The content of all files but those that have times in them."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != TIMES]
    return {path.relative_to(folder): path.read_bytes() for path in files if not path.name.startswith("table5")}


def check_figure(folder, name):
    image = imread(folder / f"{name}.png")
    assert image.shape[0] > 400 and image.shape[1] > 600 and image.std() > 5
    drawing = (folder / f"{name}.svg").read_text()
    assert drawing.startswith("<?xml") and drawing.rstrip().endswith("</svg>") and len(drawing) > 10_000


def check_tables(folder, name, number):
    text = (folder / f"{name}.md").read_text()
    assert text.count("**") == 2 * number
    files = [folder / f"{name}.csv"] if number == 1 else [folder / f"{name}_{k}.csv" for k in range(1, number + 1)]
    for file in files:
        header, first = file.read_text().splitlines()[:2]
        assert header.count(",") >= 1 and first
    assert not list(folder.glob(f"{name}_{number + 1}.csv"))
    assert "nan" not in text and "inf" not in text


@pytest.mark.slow
def test_everything_from_nothing(tmp_path, full_episodes):
    """The smoke test of the whole chain, with episodes of their full length; it learns the sources as well."""
    folder = tmp_path / "output"
    args = ("all", "--runs", "2", "--episodes", "10", "--setting", "paper", "--output", folder)
    output = succeed(*args)
    for name in FIGURES:
        check_figure(folder, name)
    for name, number in TABLES.items():
        check_tables(folder, name, number)
    for name, n_methods in (("mountain_car", 10), ("icub", 8)):
        lines = (folder / f"{name}.csv").read_text().splitlines()
        assert len(lines) == 1 + 2 * n_methods
        assert all(len(line.split(",")[-1].split()) == 10 for line in lines[1:])
    assert len(re.findall("^  .*, seed 500[01]: ", output, re.MULTILINE)) == 36
    before, mtimes = all_but_times(folder), {path: path.stat().st_mtime_ns for path in folder.glob(f"{RESULTS}/*")}
    again = succeed(*args)
    assert not re.search(", seed 50", again)
    assert {path: path.stat().st_mtime_ns for path in folder.glob(f"{RESULTS}/*")} == mtimes
    assert all_but_times(folder) == before


@pytest.mark.integration
def test_a_figure_with_episodes_of_full_length(output, full_episodes):
    args = ("fig4", "--runs", "1", "--episodes", "3", "--jobs", "1", "--output", output)
    written = succeed(*args)
    check_figure(output, "fig4")
    assert "fig4.png" in written and "fig4.svg" in written
    before = all_but_times(output)
    again = succeed(*args)
    assert "1 of 1 runs were complete already" in again and ", seed" not in again
    assert all_but_times(output) == before


@pytest.mark.integration
@pytest.mark.parametrize("setting", ["explore", "best"])
class TestOtherSettings:
    def test_both_domains(self, setting, output, short_episodes):
        succeed("table5", "--setting", setting, "--runs", 1, "--episodes", 2, "--jobs", 2, "--output", output)
        check_tables(output, "table5", 1)
        succeed("fig5", "--setting", setting, "--runs", 1, "--episodes", 2, "--jobs", 2, "--output", output)
        check_figure(output, "fig5")
        assert json.loads((output / "settings.json").read_text())["setting"] == setting
        # The runs of the first call are not lost in the second.
        n_methods = {"explore": 8, "best": 4}[setting]
        assert len((output / "icub.csv").read_text().splitlines()) == 1 + n_methods
        assert len((output / "mountain_car.csv").read_text().splitlines()) == 1 + 3


@pytest.fixture
def short_baselines(monkeypatch):
    """Baselines of as few steps as they need to learn from their buffers and be evaluated."""
    monkeypatch.setattr(baseline_runs, "_FEWEST_STEPS", 1500)


@pytest.mark.slow
def test_all_of_the_best_setting(output, short_episodes, short_baselines):
    succeed("all", "--setting", "best", *TINY, "--output", output)
    for name in ("fig2", "fig5", "fig6", "baselines"):
        check_figure(output, name)
    for name, number in {"table5": 1, "table6": 4, "measures": 2, "baselines": 1}.items():
        check_tables(output, name, number)
    assert {line.split(",")[1] for line in (output / "evaluations.csv").read_text().splitlines()[1:]} == set(ALGORITHMS)
    for name in ("fig3", "fig4", "table2", "table4", "diagnosis"):
        assert not list(output.glob(f"{name}*"))


@pytest.mark.slow
def test_the_diagnosis(output, short_episodes, monkeypatch):
    # Thirty runs: with a breadth of 0.05 or 0.1 a step of TIMBREL takes several times as long as with the others.
    car = DOMAINS["mountain_car"]
    shorter = replace(car.settings["explore"], max_episode_steps=40)
    monkeypatch.setitem(DOMAINS, "mountain_car", replace(car, settings={**car.settings, "explore": shorter}))
    succeed("diagnosis", "--setting", "explore", *TINY, "--output", output)
    check_figure(output, "diagnosis")
    check_tables(output, "diagnosis", 1)


@pytest.fixture(scope="module")
def complete(prepare, short_episodes, tmp_path_factory):
    """A folder with complete results of three figures and tables, six methods and two seeds."""
    folder = prepare(tmp_path_factory.mktemp("complete") / "output")
    for name in ("table5", "fig3", "fig4"):
        succeed(name, *TINY, "--output", folder)
    return folder


@pytest.fixture
def copied(complete, tmp_path):
    return shutil.copytree(complete, tmp_path / "copied")


def again(folder):
    """Make the same figures and tables; the names of runs that were carried out."""
    written = "".join(succeed(name, *TINY, "--output", folder) for name in ("table5", "fig3", "fig4"))
    return sorted(re.findall(r"^  mountain_car, (.*), seed (\d+):", written, re.MULTILINE)), written


@pytest.mark.integration
class TestResume:
    def test_the_second_call_carries_out_nothing(self, copied, complete):
        done, written = again(copied)
        assert done == []
        assert "6 of 6 runs were complete already" in written
        assert all_but_times(copied) == all_but_times(complete)

    def test_what_is_missing_or_damaged_is_done_again_and_nothing_else(self, copied, complete):
        runs, times = copied / RESULTS, copied / TIMES
        (runs / "mountain_car_timbrel_seed5000.json").unlink()
        half = runs / "mountain_car_combrel_seed5001.json"
        half.write_bytes(half.read_bytes()[: half.stat().st_size // 2])
        (runs / "mountain_car_no_transfer_seed5000.json").write_bytes(b"\x00\xff garbage" * 30)
        fewer = runs / "mountain_car_combrel_with_relevance_seed5000.json"
        content = json.loads(fewer.read_text())
        fewer.write_text(json.dumps({**content, "steps": content["steps"][:1], "returns": content["returns"][:1]}) + "\n")
        (times / "mountain_car_combrel_with_relevance_seed5001.json").write_text("")
        untouched = {path: path.stat().st_mtime_ns for path in runs.iterdir()}
        done, _ = again(copied)
        assert done == [
            ("COMBREL", "5001"),
            ("COMBREL with relevance", "5000"),
            ("COMBREL with relevance", "5001"),
            ("TIMBREL", "5000"),
            ("no transfer", "5000"),
        ]
        assert all_but_times(copied) == all_but_times(complete)
        kept = [path for path in untouched if path.stat().st_mtime_ns == untouched[path]]
        assert len(kept) == 10 - 5

    def test_leftovers_of_a_call_that_was_killed_count_for_nothing(self, copied, complete):
        whole = copied / RESULTS / "mountain_car_timbrel_seed5000.json"
        whole.rename(whole.with_name(f"{whole.name}.4711.part"))
        assert again(copied)[0] == [("TIMBREL", "5000")]

    def test_an_interrupted_call_leaves_complete_results_and_is_continued(self, prepare, complete, monkeypatch, tmp_path):
        folder = prepare(tmp_path / "output")
        real, n_done = carrying_out.carry_out_on, 2

        def interrupted(engine, function, jobs, **options):
            results = real(engine, function, jobs, **options)

            def until_then():
                yield from itertools.islice(results, n_done)
                results.close()
                raise KeyboardInterrupt

            return until_then()

        monkeypatch.setattr(carrying_out, "carry_out_on", interrupted)
        status, _, errors = call("table5", *TINY, "--output", folder)
        assert (status, errors) == (130, "\nStopped. The same command goes on from here.\n")
        left = results_in(folder)
        assert len(left) == n_done
        assert left.items() <= results_in(complete).items()
        assert not list(folder.rglob("*.part")) and not (folder / "table5.md").exists()
        monkeypatch.undo()
        done, _ = again(folder)
        assert len(done) == 10 - n_done
        assert all_but_times(folder) == all_but_times(complete)

    def test_more_runs_are_added(self, copied, complete):
        written = succeed("table5", "--runs", 3, "--episodes", 2, "--jobs", 1, "--output", copied)
        assert "6 of 9 runs were complete already" in written
        assert results_in(complete).items() <= results_in(copied).items()
        assert {name for name in results_in(copied) if name not in results_in(complete)} == {
            f"mountain_car_{name}_seed5002.json" for name in ("combrel", "timbrel", "no_transfer")
        }


@pytest.mark.integration
def test_control_c_in_a_terminal(prepare, tmp_path):
    """The signal reaches the workers as well, as from a terminal."""
    folder = prepare(tmp_path / "output")
    arguments = ("reproduce", "table5", "--runs", "9", "--episodes", "2", "--jobs", "1", "--output", str(folder))
    program = subprocess.Popen(
        [sys.executable, "-m", "sb3_combrel.cli", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        end = time.monotonic() + 240
        while not list(folder.glob(f"{RESULTS}/*.json")):
            assert time.monotonic() < end and program.poll() is None
            time.sleep(0.1)
        os.killpg(program.pid, signal.SIGINT)
        _, errors = program.communicate(timeout=60)
    finally:
        program.kill()
    assert program.returncode == 130
    assert errors.endswith("\nStopped. The same command goes on from here.\n") and "Traceback" not in errors
    done = list(folder.glob(f"{RESULTS}/*"))
    assert 0 < len(done) < 27
    for path in done:
        assert len(json.loads(path.read_text())["steps"]) == 2


@pytest.mark.integration
def test_results_of_dask_are_those_of_local_processes_to_the_byte(prepare, complete, tmp_path):
    folder = prepare(tmp_path / "output")
    with dask_cluster() as address:
        args = ("--runs", 2, "--episodes", 2, "--backend", "dask", "--address", address, "--output", folder)
        for name in ("table5", "fig3", "fig4"):
            succeed(name, *args)
    assert len(results_in(folder)) == 10
    assert all_but_times(folder) == all_but_times(complete)


@pytest.fixture
def made_before(tmp_path):
    """A folder with a result of the paper's setting, of two episodes."""
    folder = tmp_path / "made_before"
    reproduce.prepare_folder(folder, reproduce._settings("paper", {"mountain_car": 2}))
    ResultFiles(folder).write(made_up("mountain_car", m.COMBREL_PLAIN, 5000, [3, 4]))
    return folder


class TestBadInput:
    def test_unknown_target(self, tmp_path):
        message = fail("fig9", "--output", tmp_path / "output")
        assert "target must be one of fig2, fig3, fig4, fig5, fig6, table2" in message and "or all, got 'fig9'" in message
        assert not (tmp_path / "output").exists()

    def test_unknown_setting(self, tmp_path):
        message = fail("fig2", "--setting", "worst", "--output", tmp_path / "output")
        assert "setting must be one of paper, explore, best, got 'worst'" in message

    @pytest.mark.parametrize("target", ["fig3", "fig4", "table2", "table4"])
    def test_target_that_does_not_exist_in_the_setting(self, target, tmp_path):
        message = fail(target, "--setting", "best", "--output", tmp_path / "output")
        assert f"{target} does not exist in setting 'best': with priors" in message and "use another --setting" in message

    @pytest.mark.parametrize("name", ["runs", "episodes", "jobs"])
    @pytest.mark.parametrize("number", [0, -3])
    def test_numbers_below_one(self, name, number, tmp_path):
        message = fail("fig2", f"--{name}", number, "--output", tmp_path / "output")
        assert f"{name} must be a whole number of at least 1 or None, got {number}" in message
        assert not (tmp_path / "output").exists()

    def test_what_is_no_number(self, tmp_path):
        status, output, errors = call("fig2", "--runs", "many", "--output", tmp_path / "output")
        assert status == 2 and "many" in output + errors and "Traceback" not in output + errors

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (("--address", "10.0.0.1:6379"), "address is for the backends ray and dask.*got '10.0.0.1:6379'"),
            (("--backend", "spark"), "backend must be one of joblib, ray, dask, got 'spark'"),
            (("--backend", "dask"), "backend dask needs the address of a running cluster.*tcp://"),
            (("--backend", "ray"), "backend ray needs the address of a running cluster"),
            (("--backend", "dask", "--address", "a:1", "--jobs", "2"), "jobs is for the backend joblib.*got 2"),
        ],
    )
    def test_engines_are_checked_before_anything_is_learned(self, options, words, tmp_path):
        assert re.search(words, fail("fig2", *options, "--output", tmp_path / "output"))
        assert not (tmp_path / "output").exists()

    def test_cluster_that_does_not_answer(self, tmp_path):
        output = tmp_path / "output"
        address = f"tcp://{HOST}:{free_port()}"
        message = fail("fig4", "--backend", "dask", "--address", address, "--runs", 1, "--episodes", 2, "--output", output)
        assert f"no dask cluster answers at {address}" in message and "Start one with: dask scheduler" in message
        # Not even the sources are learned before.
        assert not output.exists()

    def test_results_of_another_setting(self, made_before):
        before = all_but_times(made_before)
        message = fail("fig4", *TINY, "--setting", "explore", "--output", made_before)
        assert f"{made_before} has results of other settings (setting was 'paper' and is 'explore'" in message
        assert "use another --output" in message
        assert all_but_times(made_before) == before

    def test_results_of_other_numbers_of_episodes(self, made_before):
        before = all_but_times(made_before)
        message = fail("fig4", "--runs", 2, "--episodes", 3, "--output", made_before)
        assert "(episodes of mountain_car was 2 and is 3)" in message
        assert all_but_times(made_before) == before
        # None were of the other domain.
        reproduce.prepare_folder(made_before, reproduce._settings("paper", {"icub": 3}))

    def test_results_of_other_arguments_of_the_methods(self, made_before, monkeypatch):
        car = DOMAINS["mountain_car"]
        changed = replace(car.settings["paper"], combrel={"breadth": 0.7})
        monkeypatch.setitem(DOMAINS, "mountain_car", replace(car, settings={**car.settings, "paper": changed}))
        message = fail("fig4", *TINY, "--output", made_before)
        assert "arguments in mountain_car was" in message and "'breadth': 0.4" in message and "'breadth': 0.7" in message

    def test_results_of_another_version(self, made_before, monkeypatch):
        monkeypatch.setattr(reproduce, "__version__", "99.0")
        assert re.search("version was '.*' and is '99.0'", fail("fig4", *TINY, "--output", made_before))

    def test_files_that_are_no_results(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("mine")
        message = fail("fig4", *TINY, "--output", tmp_path)
        assert f"{tmp_path} has files that are not results of this command; choose another --output" in message
        assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]

    def test_an_output_that_is_a_file(self, tmp_path):
        (tmp_path / "file").write_text("mine")
        assert str(tmp_path / "file") in fail("fig4", *TINY, "--output", tmp_path / "file")

    @pytest.mark.parametrize("content", ["", '{"setting": "pa', "[1]", "null"])
    def test_damaged_settings(self, content, made_before):
        (made_before / "settings.json").write_text(content)
        message = fail("fig4", *TINY, "--output", made_before)
        assert f"{made_before / 'settings.json'} is damaged" in message and "use another --output" in message

    @pytest.mark.integration
    def test_a_run_that_raises(self, output, short_episodes, monkeypatch):
        car = DOMAINS["mountain_car"]
        wrong = replace(car.settings["paper"], learner={"degree": 0, "model_breadth": -1.0})
        monkeypatch.setitem(DOMAINS, "mountain_car", replace(car, settings={**car.settings, "paper": wrong}))
        message = fail("fig4", "--runs", 1, "--episodes", 1, "--jobs", 1, "--output", output)
        assert re.search("mountain_car_combrel_seed5000: ValueError: model_breadth must .*-1.0", message)
        assert f"(traceback: {output / 'error.txt'})" in message
        assert "in carry_out\n" in (output / "error.txt").read_text()
        assert not list(output.glob(f"{RESULTS}/*"))

    @pytest.mark.integration
    def test_too_few_episodes_for_a_most_frequent_mapping(self, output, short_episodes):
        message = fail("fig5", "--runs", 1, "--episodes", 1, "--jobs", 2, "--output", output)
        assert "COMBREL has used no mapping within episodes=1" in message and "use more --episodes" in message


def test_methods_of_the_smoke_test_are_all():
    """Each method is needed by some figure or table: with all of them no method goes untested."""
    needed = {name for target in reproduce.targets_of("all", "paper") for names in target.methods.values() for name in names}
    assert set(m.METHODS) <= needed
