"""The command line, end to end, with budgets too small to learn anything."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time

import gymnasium
import pytest
from helpers.command_line import call_for_all_output
from imageio.v3 import imread

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.experiments import demo
from sb3_combrel.experiments.demo import OUTPUTS, SETTINGS, SOURCE

TINY = ("--seeds", "2", "--episodes", "2", "--max-episode-steps", "60")
METHODS = ("no_transfer", "random_mapping", "timbrel", "combrel")


def run_tiny_demo(folder, *more):
    return call_for_all_output("demo", "--output", folder, *TINY, "--workers", "1", *more)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def without_times(path):
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows_of(path)]


@pytest.fixture(scope="module")
def first_call(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "output"
    return folder, *run_tiny_demo(folder)


@pytest.fixture()
def folder(first_call, tmp_path):
    """What the first call has left, to do something with."""
    return shutil.copytree(first_call[0], tmp_path / "output")


@pytest.fixture()
def folder_with_source(first_call, tmp_path):
    """A folder in which the source task has been learned, and nothing else done."""
    folder = tmp_path / "output"
    folder.mkdir()
    for name in (SETTINGS, SOURCE):
        shutil.copyfile(first_call[0] / name, folder / name)
    return folder


@pytest.fixture()
def no_film(monkeypatch):
    """Software rendering takes seconds, and one test looks at a video."""
    monkeypatch.setattr(demo, "_film", lambda *args: None)


@pytest.mark.integration
class TestDemo:
    def test_the_demo_writes_all_listed_outputs(self, first_call):
        folder, status, written = first_call
        assert status == 0, written
        assert sorted(path.name for path in folder.iterdir()) == sorted(OUTPUTS)
        assert (folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
        assert len(SourceInstances.load(folder / "source.npz")) == 1000
        for method in METHODS:
            for seed in range(2):
                assert list(folder.glob(f"tensorboard/{method}_seed{seed}_*/events.out.tfevents.*"))

    def test_every_episode_of_every_run_is_in_the_results(self, first_call):
        rows = rows_of(first_call[0] / "results.csv")
        assert [(row["method"], row["seed"], row["episode"]) for row in rows] == [
            (method, str(seed), str(episode))
            for seed in range(2)
            for method in ("no transfer", "random mapping", "TIMBREL", "COMBREL")
            for episode in (1, 2)
        ]
        assert {(row["steps"], row["reached_goal"]) for row in rows} == {("60", "0")}

    def test_the_tables_are_shown_and_kept(self, first_call):
        folder, _, written = first_call
        tables = (folder / "tables.md").read_text()
        for text in ("Steps to goal", "steps saved", "no transfer", "East<-Right + Neutral", "(x, vx) + (y, vy)"):
            assert text in tables
            assert text in written

    def test_the_model_drives(self, first_call):
        model = FittedRMax.load(first_call[0] / "car.zip")
        env = gymnasium.make("combrel/MountainCar4D-v0")
        action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
        assert env.action_space.contains(int(action))

    def test_the_video_shows_the_episode(self, first_call):
        frames = imread(first_call[0] / "car.mp4")
        assert frames.shape[1:] == (360, 480, 3)
        # 60 steps: each fourth from the first on, and the last.
        assert len(frames) == 16

    def test_the_demo_ends_with_the_paths_of_its_outputs_and_further_commands(self, first_call):
        folder, _, written = first_call
        ending = written[written.index("Everything is in") :]
        assert str(folder) in ending
        assert all(name in ending for name in OUTPUTS if name != "settings.json")
        assert "What to try next" in ending

    def test_a_second_call_learns_nothing_again(self, folder, no_film):
        before = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*")}
        status, written = run_tiny_demo(folder)
        assert status == 0
        assert "8 of 8 runs were complete already" in written
        assert {path: path.stat().st_mtime_ns for path in folder.glob("runs/*")} == before

    def test_an_unfinished_run_is_done_again_with_the_same_result(self, folder, no_film):
        episodes, model = folder / "runs" / "combrel_seed1.csv", folder / "runs" / "combrel_seed1.zip"
        mappings = folder / "runs" / "combrel_seed1_mappings.csv"
        before = without_times(episodes), mappings.read_text()
        model.unlink()
        episodes.write_text("\n".join(episodes.read_text().splitlines()[:2]) + "\n2,3")
        status, written = run_tiny_demo(folder)
        assert status == 0
        assert "7 of 8 runs were complete already" in written
        assert (without_times(episodes), mappings.read_text()) == before
        assert len(list(folder.glob("tensorboard/combrel_seed1_*"))) == 1

    def test_more_runs_are_added_to_those_that_are_there(self, folder, no_film):
        status, written = run_tiny_demo(folder, "--seeds", "3")
        assert status == 0
        assert "8 of 12 runs were complete already" in written
        assert len(rows_of(folder / "results.csv")) == 24

    def test_results_of_other_settings_are_not_mixed_with_new_ones(self, folder):
        status, written = run_tiny_demo(folder, "--max-episode-steps", "50")
        assert status == 1
        assert "max_episode_steps was 60 and is 50" in written
        assert "--fresh" in written

    def test_fresh_deletes_earlier_results_and_nothing_of_the_users(self, folder, no_film):
        (folder / "notes.txt").write_text("mine")
        status, written = run_tiny_demo(folder, "--fresh", "--max-episode-steps", "50")
        assert status == 0
        assert "complete already" not in written
        assert {row["steps"] for row in rows_of(folder / "results.csv")} == {"50"}
        assert (folder / "notes.txt").read_text() == "mine"

    @pytest.mark.parametrize("fresh", [(), ("--fresh",)])
    def test_a_folder_of_other_things_is_left_alone(self, tmp_path, fresh):
        (tmp_path / "source.npz").write_text("mine")
        status, written = run_tiny_demo(tmp_path, *fresh)
        assert status == 1
        assert "--output" in written
        assert [path.name for path in tmp_path.iterdir()] == ["source.npz"]

    @pytest.mark.parametrize("option", ["--seeds", "--episodes", "--max-episode-steps", "--workers"])
    def test_numbers_below_one_are_refused(self, tmp_path, option):
        status, written = call_for_all_output("demo", "--output", tmp_path / "new", option, "0")
        assert status == 1
        assert "must be at least 1, got 0" in written
        assert not (tmp_path / "new").exists()

    def test_without_opengl_the_demo_names_what_to_install_and_does_all_the_rest(self, folder_with_source):
        folder = folder_with_source
        command = [sys.executable, "-m", "sb3_combrel.cli", "demo", "--output", folder, *TINY, "--seeds", "1"]
        environment = {**os.environ, "MUJOCO_GL": "disable"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert "libegl1" in done.stdout
        assert sorted(path.name for path in folder.iterdir()) == sorted(set(OUTPUTS) - {"car.mp4"})

    @pytest.mark.skipif(sys.platform == "win32", reason="no process groups")
    def test_an_interrupted_demo_continues_where_it_stopped(self, folder_with_source, no_film):
        folder = folder_with_source
        command = [sys.executable, "-m", "sb3_combrel.cli", "demo", "--output", folder, *TINY, "--episodes", "10"]
        process = subprocess.Popen(
            [*command, "--workers", "2"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            # Whoever runs the tests in a shell's background has them, and all they start, ignore the signal.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        deadline = time.monotonic() + 300
        while not list(folder.glob("runs/*.zip")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        # As the terminal does at Ctrl-C: all of the command's processes get the signal.
        os.killpg(process.pid, signal.SIGINT)
        written, _ = process.communicate(timeout=60)
        assert process.returncode == 130, written
        assert "goes on from here" in written
        finished = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*.zip")}
        assert 0 < len(finished) < 6
        status, written = run_tiny_demo(folder, "--episodes", "10")
        assert status == 0
        assert "of 8 runs were complete already" in written
        assert finished.items() <= {path: path.stat().st_mtime_ns for path in folder.glob("runs/*.zip")}.items()


class TestRecord:
    SHORT = ("combrel/MountainCar2D-v0", "--n-instances", "20", "--total-timesteps", "50")

    def test_record_writes_source_instances(self, tmp_path):
        status, written = call_for_all_output("record", *self.SHORT, "--output", tmp_path / "car", "--seed", "3")
        assert status == 0
        source = SourceInstances.load(tmp_path / "car.npz")
        assert len(source) == 20
        assert source.state_names == ("x", "v")
        assert str(tmp_path / "car.npz") in written

    def test_a_file_is_overwritten_only_when_asked(self, tmp_path):
        file = tmp_path / "car.npz"
        file.write_text("mine")
        status, written = call_for_all_output("record", *self.SHORT, "--output", file)
        assert status == 1
        assert "--overwrite" in written
        assert file.read_text() == "mine"
        assert call_for_all_output("record", *self.SHORT, "--output", file, "--overwrite")[0] == 0
        assert len(SourceInstances.load(file)) == 20

    @pytest.mark.parametrize(
        ("env_id", "message"),
        [("Nowhere-v0", "Nowhere"), ("no_such_package:Task-v0", "no_such_package"), ("Pendulum-v1", "Discrete")],
    )
    def test_a_task_that_cannot_be_learned_is_named_without_a_traceback(self, tmp_path, env_id, message):
        status, written = call_for_all_output("record", env_id, "--output", tmp_path / "none.npz")
        assert status == 1
        assert message in written
        assert "Traceback" not in written
        assert not list(tmp_path.iterdir())


class TestCommandLine:
    def test_help_names_the_commands(self):
        status, written = call_for_all_output("--help")
        assert status == 0
        assert all(name in written for name in ("demo", "record", "reproduce", "benchmark"))

    def test_an_unknown_command_is_refused(self):
        assert call_for_all_output("dance")[0] == 2

    def test_without_tyro_the_command_names_what_to_install(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "tyro", None)
        status, written = call_for_all_output("demo")
        assert status == 1
        assert "sb3-combrel[experiments]" in written
