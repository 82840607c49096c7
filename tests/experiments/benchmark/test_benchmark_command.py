"""``sb3-combrel benchmark`` with the method and the pair of a third party, from the files of the page that says how."""

import csv
import json
import re
import shutil

import cloudpickle
import pytest
from helpers.benchmark_files import call, command, fail, succeed, write_files
from helpers.clusters import dask_cluster
from helpers.walk import walk_source
from imageio.v3 import imread
from rich.console import Console

from sb3_combrel.experiments.benchmark.command import prepare_sources
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.third_party import load_attribute
from sb3_combrel.experiments.suite.tasks import Source
from sb3_combrel.runs.runner import FOLDER, Backend

FAILING = '''
from sb3_combrel import COMBREL
from sb3_combrel.experiments.benchmark.methods import Method
from sb3_combrel.transfer.base import Transfer


class Sulking(COMBREL):
    """Raises an exception in its second episode."""

    episodes = 0

    def end_episode(self, truncated):
        self.episodes += 1
        if self.episodes == 2:
            raise RuntimeError("no | more")
        super().end_episode(truncated)


def picky(source, pair):
    """Fits no pair."""
    raise ValueError("it takes two to walk")


class NoMethod(Transfer):
    """Has not what a method needs."""


def none(source, pair):
    """Named like no transfer."""
    return COMBREL(source)


NUMBER = 3
OWN = Method("oracle", "", none)
'''
DYING = '''
import os
from pathlib import Path

from sb3_combrel import COMBREL


class Dying(COMBREL):
    """Ends the process that it is in."""

    def end_episode(self, truncated):
        os._exit(1)
'''
TINY = ("--seeds", 1, "--jobs", 1)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with the files of the page, and some that fail."""
    folder = tmp_path_factory.mktemp("files")
    assert write_files(folder) == ["my_method.py", "two_walks.py"]
    (folder / "failing.py").write_text(FAILING)
    (folder / "dying.py").write_text(DYING)
    (folder / "overview.py").write_text((folder / "two_walks.py").read_text().replace("two-walks", "Overview_2"))
    (folder / "raising.py").write_text("open('table.csv')\n")
    return folder


@pytest.fixture(scope="module")
def made(files, tmp_path_factory):
    """What the command of the page makes: its output folder, and what it prints."""
    patch = pytest.MonkeyPatch()
    patch.chdir(files)
    printed = succeed(*command(), "--jobs", "1")
    patch.undo()
    return files / "walks", printed


@pytest.fixture
def copied(made, tmp_path):
    return shutil.copytree(made[0], tmp_path / "walks")


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def again(copied, files, *args):
    """Call the page's command once more, for a copy of its output; the titles of the runs that are made."""
    patch = pytest.MonkeyPatch()
    patch.chdir(files)
    own = command()
    own[own.index("walks")] = str(copied)
    printed = succeed(*own, "--jobs", "1", *args)
    patch.undo()
    return re.findall(r"^  (two-walks, \S+, seed \d+)", printed, re.MULTILINE)


def all_but_times(folder):
    """The content of the results."""
    found = {path.name: json.loads(path.read_text())["result"] for path in (folder / FOLDER).glob("*.json")}
    return {name: result | {"seconds": 0.0} for name, result in found.items()}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != "benchmark.md"}


class TestThePage:
    def test_every_method_of_the_command_has_a_row_with_numbers(self, made):
        rows = rows_of(made[0] / "two-walks.csv")
        assert [row["method"] for row in rows] == ["none", "oracle", "COMBREL-factored", "DrawnMappings", "wide_prior"]
        for row in rows:
            assert row["runs"] == "3" and row["note"] == ""
            assert re.fullmatch(r"-\d+\.\d \[-\d+\.\d, -\d+\.\d\]", row["performance"]) and float(row["seconds"]) >= 0.0
        assert [row["known mapping"] for row in rows][:2] == ["-", "100%"]
        assert [row["steps to a mapping"] for row in rows][:2] == ["-", "-"]
        assert all(float(row["steps to a mapping"]) >= 1 for row in rows[2:])

    def test_there_are_a_picture_a_page_and_all_runs(self, made):
        folder, printed = made
        assert imread(folder / "two-walks.png").shape[0] > 400
        assert (folder / "two-walks.svg").read_text().rstrip().endswith("</svg>")
        page = (folder / "benchmark.md").read_text()
        assert "sb3-combrel benchmark --pairs two_walks.py --methods none" in page and "seeds 7000 to 7002" in page
        assert "![two-walks](two-walks.png)" in page and "A walk on a line to the same walk, mirrored." in page
        assert "COMBREL with instances, whose mapping is drawn in proportion to compliance." in page
        assert "COMBREL with a smoother model of the source." in page
        assert len(rows_of(folder / "runs.csv")) == 5 * 3
        for line in ("two-walks.md", "two-walks.csv", "two-walks.png", "two-walks.svg", "benchmark.md"):
            assert line in printed

    def test_the_known_mapping_helps(self, made):
        """Not a test of the methods: of which column is which, and of its sign."""
        rows = {row["method"]: row for row in rows_of(made[0] / "two-walks.csv")}
        performance = {name: float(row["performance"].split()[0]) for name, row in rows.items()}
        assert performance["oracle"] > performance["none"]
        assert rows["oracle"]["jumpstart"].startswith("+") and rows["oracle"]["transfer ratio"].startswith("+")
        assert float(rows["oracle"]["rank"]) < float(rows["none"]["rank"])


class TestResuming:
    def test_only_what_is_missing_is_made_and_it_is_the_same(self, copied, files):
        before, files_before = all_but_times(copied), contents(copied)
        (copied / FOLDER / "two-walks_oracle_seed7001.json").unlink()
        damaged = copied / FOLDER / "two-walks_none_seed7000.json"
        damaged.write_text(damaged.read_text()[:50])
        assert sorted(again(copied, files)) == ["two-walks, none, seed 7000", "two-walks, oracle, seed 7001"]
        assert all_but_times(copied) == before
        # Only the table with the seconds may differ, which those of two runs are means of.
        assert {n: b for n, b in contents(copied).items() if n[:10] != "two-walks."} == {
            n: b for n, b in files_before.items() if n[:10] != "two-walks."
        }

    def test_more_seeds_and_methods_add_to_what_is_there(self, copied, files):
        done = again(copied, files, "--seeds", 4, "--methods", "none", "random-by-run")
        assert sorted(done) == [
            "two-walks, none, seed 7003",
            *(f"two-walks, random-by-run, seed {s}" for s in range(7000, 7004)),
        ]
        assert [row["method"] for row in rows_of(copied / "two-walks.csv")] == ["none", "random-by-run"]


@pytest.fixture(scope="module")
def failed(files, tmp_path_factory):
    """The output of methods that fail beside one that does not."""
    folder = tmp_path_factory.mktemp("failed")
    own = [f"{files / 'failing.py'}:{name}" for name in ("Sulking", "picky")]
    args = ("--pairs", files / "two_walks.py", "--methods", "none", *own, "TIMBREL", *TINY, "--output", folder)
    status, printed, errors = call(*args)
    assert status == 1
    where = f"the notes in {folder / 'benchmark.md'} say why, and the same command tries them again"
    assert errors == f"sb3-combrel: 1 of 4 runs failed: {where}\n", "what does not fit has not failed"
    return folder, printed, args


class TestFailures:
    def test_what_does_not_fit_has_an_empty_cell_and_a_reason(self, failed):
        folder, _printed, _ = failed
        row = {row["method"]: row for row in rows_of(folder / "two-walks.csv")}["picky"]
        assert row.pop("note") == "does not fit: it takes two to walk" and set(row.values()) == {"picky", ""}

    def test_a_run_that_fails_has_its_error_in_the_table_and_the_others_go_on(self, failed):
        folder, printed, _ = failed
        rows = {row["method"]: row for row in rows_of(folder / "two-walks.csv")}
        assert rows["Sulking"]["note"] == "failed (seed 7000): RuntimeError: no | more"
        assert rows["TIMBREL"]["runs"] == rows["none"]["runs"] == "1"
        assert "Sulking, seed 7000: failed: RuntimeError: no | more" in printed
        overview = rows_of(folder / "overview_2.csv")
        assert [row["two-walks"].split(" ")[0] for row in overview][1:3] == ["failed", ""]
        kept = json.loads((folder / FOLDER / "two-walks_sulking_seed7000.json").read_text())["result"]
        assert "in end_episode" in kept["traceback"]

    def test_it_is_tried_again(self, failed):
        _, _, args = failed
        _, printed, _ = call(*args)
        assert "3 of 4 runs were complete already" in printed
        assert re.findall(r"two-walks, (\S+), seed 7000:", printed) == ["Sulking"]

    def test_one_seed_is_too_few_for_intervals(self, failed):
        folder, printed, _ = failed
        words = "seeds=1 is too few for intervals and tests, which need at least 3 runs of each method"
        assert words in printed and words in (folder / "benchmark.md").read_text()
        row = rows_of(folder / "two-walks.csv")[-1]
        assert re.fullmatch(r"-\d+\.\d", row["performance"]) and row["p"] == "-" and "(" not in row["jumpstart"]

    @pytest.mark.long
    def test_a_worker_that_dies(self, files, tmp_path):
        args = ("--pairs", files / "two_walks.py", "--methods", f"{files / 'dying.py'}:Dying", "none", *TINY)
        assert call(*args, "--jobs", 2, "--output", tmp_path / "out")[0] == 1
        rows = {row["method"]: row for row in rows_of(tmp_path / "out" / "two-walks.csv")}
        assert rows["none"]["runs"] == "1" and re.match(r"failed \(seed 7000\): .*died", rows["Dying"]["note"])

    def test_a_source_that_cannot_be_learned(self, files, tmp_path):
        text = (files / "two_walks.py").read_text()
        broken = text.replace('recorded("walk", make_walk,', 'recorded("walk", lambda: 1 / 0,').replace("two-walks", "broken")
        (tmp_path / "broken.py").write_text(broken)
        args = ("--pairs", tmp_path / "broken.py", "--methods", "none", "oracle", *TINY, "--output", tmp_path / "out")
        status, printed, _ = call(*args)
        assert status == 1 and "broken, seed 7000: its source could not be learned: ZeroDivisionError" in printed
        for row in rows_of(tmp_path / "out" / "broken.csv"):
            assert row["note"].startswith("failed (seed 7000): its source could not be learned: ZeroDivisionError")

    def test_a_source_that_one_seed_cannot_learn_costs_the_runs_of_that_seed(self, tmp_path):
        def learn(seed):
            if seed == 1:
                raise RuntimeError("no luck")
            return walk_source()

        pair = Pair("lucky", "", (Source("walk", learn),), "CartPole-v1", n_episodes=1)
        found, failed = prepare_sources([pair], range(3), tmp_path, Backend(n_jobs=1), Console(quiet=True))
        assert failed == {("lucky", 1): "its source could not be learned: RuntimeError: no luck"}
        assert [len(found["lucky", seed]) for seed in range(3)] == [1, 0, 1]


class TestBadInput:
    @pytest.mark.parametrize(
        "options, words",
        [
            (("--pairs", "chess"), "pairs must be of mountain-car, .* or all; a pair of your own .* got 'chess'"),
            (("--pairs", "nowhere.py"), "pairs: there is no file nowhere.py"),
            (("--methods", "SARSA"), "methods must be of none, .* or all; a method of your own .* got 'SARSA'"),
            (("--methods", "nowhere.py:M"), "methods: there is no file nowhere.py"),
            (("--methods", "no_such_module:M"), "methods: no_such_module cannot be imported: ModuleNotFoundError"),
            (("--methods", "failing.py:Gone"), "methods: failing.py defines no Gone"),
            (("--methods", "failing.py:NUMBER"), "methods: failing.py:NUMBER must be a Method, .* got 3"),
            (("--methods", "failing.py:NoMethod"), "methods: failing.py:NoMethod lacks observe"),
            (("--pairs", "failing.py"), "pairs: failing.py defines no PAIR"),
            (("--pairs", "raising.py"), "pairs: raising.py cannot be imported: FileNotFoundError: .*table.csv"),
            (("--methods", "none", "none"), "methods must be .* different names, got none, none"),
            (("--methods", "failing.py:none"), "methods: failing.py:none must have a name that no .* has, got none"),
            (("--methods", "failing.py:OWN"), "methods: failing.py:OWN must have a name that no .* has, got oracle"),
            (("--pairs", "overview.py"), "pairs must not have the name of another file of the report, got Overview_2"),
            (("--first-seed", 2**32 - 3), "first_seed must be a whole number from 0 to 4,294,967,286, got 4,294,967,293"),
            (("--seeds", "0"), "seeds must be .* got 0"),
            (("--first-seed", "-1"), "first_seed must be .* got -1"),
            (("--jobs", "0"), "jobs must be .* got 0"),
            (("--backend", "slurm"), "backend must be one of .* got 'slurm'"),
            (("--backend", "dask"), "address of dask must be a host and a port of a running cluster"),
        ],
    )
    def test_nothing_is_learned_or_written(self, options, words, files, tmp_path, monkeypatch):
        monkeypatch.chdir(files)
        assert re.search(words, fail(*options, "--output", tmp_path / "out")) and not (tmp_path / "out").exists()

    def test_a_known_mapping_of_other_tasks_is_refused_before_the_runs(self, files, tmp_path):
        text = (files / "two_walks.py").read_text()
        (tmp_path / "wide.py").write_text(text.replace("known_by_action=MIRRORED", "known_by_action=(MIRRORED,) * 3"))
        message = fail("--pairs", tmp_path / "wide.py", "--methods", "none", *TINY, "--output", tmp_path / "out")
        assert "two-walks: known_by_action must have one mapping for each of the 2 target actions, got 3" in message
        assert not list((tmp_path / "out" / FOLDER).glob("*.json"))

    def test_a_pair_that_has_changed_since(self, copied, files, tmp_path):
        changed = tmp_path / "two_walks.py"
        changed.write_text((files / "two_walks.py").read_text().replace("n_episodes=6", "n_episodes=7"))
        message = fail("--pairs", changed, "--methods", "none", "--output", copied)
        assert "has results of other settings (two-walks, none, seed 7000: " in message
        assert "n_episodes was 6 and is 7" in message and "use another folder by --output" in message
        files_of_sources = {file.name.rpartition("_seed")[0] for file in (copied / "sources").iterdir()}
        assert len(files_of_sources) == 2, "a source that may be another one has files of its own"

    def test_what_the_package_has_is_sent_by_name(self):
        load_attribute("methods", "sb3_combrel:COMBREL")
        assert "sb3_combrel" not in cloudpickle.list_registry_pickle_by_value()


@pytest.mark.long
def test_a_cluster_gives_the_same_results(made, files, tmp_path):
    """What the files define goes to workers that do not have them."""
    with dask_cluster(1) as address:
        args = ("--pairs", files / "two_walks.py", "--methods", "oracle", f"{files / 'my_method.py'}:DrawnMappings")
        succeed(*args, "--seeds", 1, "--backend", "dask", "--address", address, "--output", tmp_path / "out")
    found = all_but_times(tmp_path / "out")
    assert len(found) == 2 and found.items() <= all_but_times(made[0]).items()
