"""``reproduce``: figures, tables, continuing, bad input. Runs are cut off early, to take a second."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest
from helpers.paper_results import check_figure, made_up, quiet
from helpers.walk import Walk

from sb3_combrel.experiments.paper import baselines
from sb3_combrel.experiments.paper import reproduce as command
from sb3_combrel.experiments.paper.domains import DOMAINS
from sb3_combrel.experiments.paper.targets import TARGETS
from sb3_combrel.runs.job import Job
from sb3_combrel.runs.runner import FOLDER, Backend, JobError, read_results, run_missing

TINY = {"runs": 2, "episodes": 2, "backend": Backend(n_jobs=1)}
TABLES = {"table2": 3, "table4": 2, "table5": 1, "table6": 4, "fig6": 1, "measures": 2, "diagnosis": 1}


def reproduce(target, **given):
    """The files made, and what was written meanwhile."""
    console = quiet()
    return command.reproduce(target, console=console, **{**TINY, **given}), console.file.getvalue()


def files_in(folder):
    """The content of all files that have no times in them, but for runs."""
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith("table5")]
    return {path.name: path.read_bytes() for path in files}


def check_tables(folder, name, number):
    text = (folder / f"{name}.md").read_text()
    assert text.count("**") == 2 * number
    files = [folder / f"{name}.csv"] if number == 1 else [folder / f"{name}_{k}.csv" for k in range(1, number + 1)]
    for file in files:
        header, first = file.read_text().splitlines()[:2]
        assert header.count(",") >= 1 and first
    assert not list(folder.glob(f"{name}_{number + 1}.csv")) and "nan" not in text and "inf" not in text


@pytest.fixture(scope="module")
def complete(short, tmp_path_factory):
    """A folder with complete results of a table and two figures: four methods and two seeds."""
    folder = tmp_path_factory.mktemp("complete") / "output"
    for target in ("table5", "fig4"):
        reproduce(target, output=folder)
    return folder


class TestChain:
    def test_files(self, complete):
        check_tables(complete, "table5", 1)
        check_figure(complete, "fig4")
        header, *rows = (complete / "mountain_car.csv").read_text().splitlines()
        assert header == "method,seed,steps,episodes_terminated,steps_of_episodes"
        assert rows == [
            f"{method},{seed},120,0,60 60" for method in ("COMBREL", "TIMBREL", "no transfer") for seed in (26000, 26001)
        ]

    def test_what_is_missing_is_done_again_and_nothing_else(self, complete, tmp_path):
        folder = shutil.copytree(complete, tmp_path / "copied")
        (folder / FOLDER / "mountain_car_timbrel_seed26000.json").unlink()
        damaged = folder / FOLDER / "mountain_car_combrel_seed26001.json"
        damaged.write_bytes(damaged.read_bytes()[:100])
        _, written = reproduce("table5", output=folder)
        assert "4 of 6 runs were complete already" in written
        assert re.findall("^  mountain_car, (.*), seed", written, re.MULTILINE) == ["TIMBREL", "COMBREL"]
        reproduce("fig4", output=folder)
        assert files_in(folder) == files_in(complete)

    @pytest.mark.long
    def test_a_method_that_has_a_mapping_of_the_runs_of_another(self, short, tmp_path, monkeypatch):
        of_robot = {"icub": ("COMBREL", "TIMBREL frequent", "oracle mapping")}
        monkeypatch.setitem(TARGETS, "fig5", replace(TARGETS["fig5"], methods=of_robot))
        made, written = reproduce("fig5", runs=1, output=tmp_path / "output")
        assert "TIMBREL frequent: InterTaskMapping" in written
        rows = (tmp_path / "output" / "icub.csv").read_text().splitlines()[1:]
        assert tuple(row.split(",")[0] for row in rows) == ("COMBREL", "TIMBREL frequent", "oracle mapping")
        check_figure(tmp_path / "output", "fig5")
        assert len(made) == len(set(made)) == 1 + 2 + 5


@pytest.mark.long
def test_everything_from_nothing(tmp_path):
    """The whole chain, in a process of its own: with episodes of their full length, and sources that are learned."""
    command = [sys.executable, "-m", "sb3_combrel.cli", "reproduce", "all", "--setting", "paper", "--runs", "2"]
    command += ["--episodes", "3", "--output", str(tmp_path / "output")]
    run = partial(subprocess.run, command, capture_output=True, text=True, check=True)
    written = run().stdout
    for name in ("fig2", "fig3", "fig4", "fig5", "fig6", "diagnosis"):
        check_figure(tmp_path / "output", name)
    for name, number in TABLES.items():
        check_tables(tmp_path / "output", name, number)
    # On Mountain Car three methods at four breadths belong to the diagnosis.
    for name, n_methods in (("mountain_car", 10 + 3 * 4), ("icub", 8)):
        lines = (tmp_path / "output" / f"{name}.csv").read_text().splitlines()
        assert len(lines) == 1 + 2 * n_methods and all(len(line.split(",")[-1].split()) == 3 for line in lines[1:])
    before = files_in(tmp_path / "output")
    assert ", seed 260" in written and ", seed 260" not in run().stdout and files_in(tmp_path / "output") == before


@pytest.mark.long
def test_all_of_the_other_setting(short, monkeypatch, tmp_path):
    # As few steps as they need to learn from their buffers and be evaluated.
    monkeypatch.setattr(baselines, "FEWEST_TIMESTEPS", 1500)
    reproduce("all", setting="best", output=tmp_path / "output")
    for name in ("fig2", "fig5", "fig6", "baselines"):
        check_figure(tmp_path / "output", name)
    for name, number in {"table5": 1, "table6": 4, "fig6": 1, "measures": 2, "baselines": 1}.items():
        check_tables(tmp_path / "output", name, number)
    assert not list((tmp_path / "output").glob("diagnosis*"))


class TestBadInput:
    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"target": "fig9"}, "target must be one of fig2, .*table6.* or all, got 'fig9'"),
            ({"setting": "worst"}, "setting must be one of paper, best, got 'worst'"),
            ({"setting": "best"}, "fig4 does not exist in setting 'best': with priors .*; use another --setting"),
            (
                {"target": "diagnosis", "setting": "best"},
                "diagnosis does not exist in setting 'best': it explains the results of setting 'paper'",
            ),
            ({"runs": 0}, "runs must be a whole number of at least 1 or None, got 0"),
            ({"episodes": -3}, "episodes must be a whole number of at least 1 or None, got -3"),
            ({"backend": Backend(n_jobs=0)}, "jobs must be a whole number of at least 1 or None, got 0"),
            ({"backend": Backend("spark")}, "backend must be one of loky, ray, dask, got 'spark'"),
        ],
    )
    def test_arguments_are_checked_before_anything_is_learned(self, given, message, tmp_path):
        with pytest.raises(ValueError, match=message):
            reproduce(**{"target": "fig4", "output": tmp_path / "output", **given})
        assert not (tmp_path / "output").exists()

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"target": "table5", "setting": "best"}, "setting was 'paper' and is 'best'"),
            ({"episodes": 3}, r"mountain_car_combrel_seed26000: n_episodes was 2 and is 3\); use another --output"),
        ],
    )
    def test_results_of_other_settings(self, given, message, complete):
        before = files_in(complete)
        with pytest.raises(ValueError, match=message):
            # None of its runs is there.
            reproduce(**{"target": "table2", "output": complete, **given})
        assert files_in(complete) == before

    def test_results_of_other_arguments_of_the_methods(self, complete, monkeypatch):
        car = DOMAINS["mountain_car"]
        changed = replace(car.settings["paper"], combrel={"breadth": 0.7})
        monkeypatch.setitem(DOMAINS, "mountain_car", replace(car, settings={**car.settings, "paper": changed}))
        with pytest.raises(ValueError, match=r"other settings .*COMBREL\.breadth was 0\.4 and is 0\.7"):
            reproduce("fig4", output=complete)

    def test_files_that_are_no_results(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("mine")
        with pytest.raises(ValueError, match="has files that are not results of such runs; use another folder by --output"):
            reproduce("fig4", output=tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]

    def test_a_run_that_raises(self, short, tmp_path, monkeypatch):
        car = DOMAINS["mountain_car"]
        wrong = replace(car.settings["paper"], learner={"degree": 0, "model_breadth": -1.0})
        monkeypatch.setitem(DOMAINS, "mountain_car", replace(car, settings={**car.settings, "paper": wrong}))
        with pytest.raises(JobError, match=r"COMBREL, seed 26000: ValueError: model_breadth must .*-1.0"):
            reproduce("fig4", runs=1, output=tmp_path / "output")
        assert not list((tmp_path / "output").glob("*.csv"))

    def test_runs_of_a_mapping_that_was_the_most_frequent_before_are_made_again(self, tmp_path):
        jobs = [Job(group="icub", method="m", seed=seed, env=Walk, n_steps=9) for seed in (0, 1)]
        run_missing(jobs, tmp_path, Backend(n_jobs=1))
        command.forget_other_mappings([jobs[0], replace(jobs[1], transfer="another")], tmp_path)
        assert [result.seed for _, result in read_results(tmp_path)] == [0]

    def test_too_few_episodes_for_a_most_frequent_mapping(self):
        results = [made_up("icub", "COMBREL", 0, [9])]
        with pytest.raises(ValueError, match=r"COMBREL has used no mapping within episodes=1.*use more --episodes"):
            command.frequent_mapping(results, DOMAINS["icub"], None)
