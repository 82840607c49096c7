"""The demonstration, end to end, with budgets too small to learn anything."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import product

import gymnasium
import pytest
from helpers.command_line import call_for_all_output
from imageio.v3 import imread

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.experiments import demo
from sb3_combrel.experiments.demo import OUTPUTS

TINY = ("--seeds", "2", "--episodes", "2", "--max-episode-steps", "60")
METHODS = ("no_transfer", "random_mapping", "timbrel", "combrel")


def run_tiny_demo(folder, *more):
    return call_for_all_output("demo", "--output", folder, *TINY, "--workers", "1", *more)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def first_call(tmp_path_factory):
    """Folder, status and output of a call; without a film, which one long test makes: software rendering takes seconds."""
    folder = tmp_path_factory.mktemp("demo") / "output"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "_film", lambda *args: None)
        return folder, *run_tiny_demo(folder)


@pytest.fixture()
def folder(first_call, tmp_path):
    """What the first call has left, to do something with."""
    return shutil.copytree(first_call[0], tmp_path / "output")


@pytest.fixture()
def no_film(monkeypatch):
    """Software rendering takes seconds, and one test looks at a video."""
    monkeypatch.setattr(demo, "_film", lambda *args: None)


class TestDemo:
    def test_the_demo_writes_all_listed_outputs(self, first_call):
        folder, status, written = first_call
        assert status == 0, written
        assert sorted(path.name for path in folder.iterdir()) == sorted(set(OUTPUTS) - {"car.mp4"})
        assert (folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
        assert len(SourceInstances.load(folder / "sources" / "mountain_car_2d_seed1.npz")) == 1000
        for method in METHODS:
            for seed in range(2):
                assert list(folder.glob(f"tensorboard/{method}_seed{seed}_*/events.out.tfevents.*"))
        tables = (folder / "tables.md").read_text()
        for text in ("Steps to goal", "steps saved", "no transfer", "East<-Right + Neutral", "(x, vx) + (y, vy)"):
            assert text in tables and text in written
        ending = written[written.index("Everything is in") :]
        assert all(name in ending for name in {str(folder), "What to try next", *OUTPUTS} - {"car.mp4"})
        model = FittedRMax.load(folder / "car.zip")
        with gymnasium.make("combrel/MountainCar4D-v0") as env:
            assert env.action_space.contains(int(model.predict(env.reset(seed=0)[0], deterministic=True)[0]))

    @pytest.mark.long
    def test_a_second_call_learns_nothing_again_and_mixes_no_settings(self, folder, no_film):
        before = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*")}
        status, written = run_tiny_demo(folder)
        assert status == 0 and "8 of 8 runs were complete already" in written
        assert {path: path.stat().st_mtime_ns for path in folder.glob("runs/*")} == before
        (folder / "runs" / "combrel_seed0.zip").unlink()
        status, written = run_tiny_demo(folder)
        assert status == 0 and "7 of 8 runs were complete already" in written, "the run whose model is lost is made again"
        status, written = run_tiny_demo(folder, "--max-episode-steps", "50")
        assert status == 1 and "max_episode_steps was 60 and is 50" in written

    def test_every_episode_of_every_run_is_in_the_results(self, first_call):
        rows = rows_of(first_call[0] / "results.csv")
        assert [(row["method"], row["seed"], row["episode"]) for row in rows] == [
            (method, str(seed), str(episode))
            for seed in range(2)
            for method in ("no transfer", "random mapping", "TIMBREL", "COMBREL")
            for episode in (1, 2)
        ]
        assert {(row["steps"], row["reached_goal"]) for row in rows} == {("60", "0")}

    @pytest.mark.long
    def test_fresh_deletes_earlier_results_and_nothing_of_the_users(self, folder, no_film):
        mine = [folder / name for name in ("notes.txt", "sources/mine.npz", "runs/PPO_1/log", "tensorboard/PPO_1/log")]
        for file in mine:
            file.parent.mkdir(exist_ok=True)
            file.write_text("mine")
        status, written = run_tiny_demo(folder, "--fresh", "--max-episode-steps", "50", "--seeds", "1")
        assert status == 0 and "complete already" not in written, written
        assert {row["steps"] for row in rows_of(folder / "results.csv")} == {"50"}
        assert all(file.read_text() == "mine" for file in mine)
        assert len(list(folder.glob("tensorboard/*_seed*"))) == len(list(folder.glob("runs/*.json"))) == len(METHODS)
        assert len(list(folder.glob("sources/mountain*"))) == 1

    def test_a_folder_of_other_things_is_left_alone_and_bad_numbers_are_refused(self, tmp_path):
        (tmp_path / "source.npz").write_text("mine")
        project = tmp_path / "project"
        (project / "runs" / "PPO_1").mkdir(parents=True)  # TensorBoard's default name
        (project / "results.csv").write_text("mine")
        for folder, more in product((tmp_path, project), ((), ("--fresh",))):
            status, written = run_tiny_demo(folder, *more)
            assert status == 1 and "has files that are not results of such runs; use another folder by --output" in written
        for option in ("--seeds", "--episodes", "--max-episode-steps", "--workers"):
            status, written = call_for_all_output("demo", "--output", tmp_path / "new", option, "0")
            assert status == 1 and "of at least 1" in written and "got 0" in written
        left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
        assert left == {"source.npz", "project", "project/runs", "project/runs/PPO_1", "project/results.csv"}

    @pytest.mark.long
    @pytest.mark.parametrize("renderer", ["egl", "disable"])
    def test_the_film_shows_the_episode_or_names_what_to_install(self, folder, renderer):
        command = [sys.executable, "-m", "sb3_combrel.cli", "demo", "--output", folder, *TINY]
        environment = {**os.environ, "MUJOCO_GL": renderer}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        if renderer == "disable":
            assert "libegl1" in done.stdout and not (folder / "car.mp4").exists()
            return
        frames = imread(folder / "car.mp4")
        # 60 steps: each fourth from the first on, and the last.
        assert frames.shape[1:] == (360, 480, 3) and len(frames) == 16

    @pytest.mark.long
    @pytest.mark.skipif(sys.platform == "win32", reason="no process groups")
    def test_an_interrupted_demo_continues_where_it_stopped(self, tmp_path, no_film):
        folder = tmp_path / "output"
        command = [sys.executable, "-m", "sb3_combrel.cli", "demo", "--output", folder, *TINY, "--episodes", "10"]
        process = subprocess.Popen(
            [*command, "--workers", "2"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            # Whoever runs the tests in a shell's background has them, and all they start, ignore the signal.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        deadline = time.monotonic() + 300
        while not list(folder.glob("runs/*.json")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        # As the terminal does at Ctrl-C: all of the command's processes get the signal.
        os.killpg(process.pid, signal.SIGINT)
        written, _ = process.communicate(timeout=60)
        assert process.returncode == 130, written
        assert "goes on from here" in written
        finished = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*.json")}
        assert 0 < len(finished) < 8
        status, written = run_tiny_demo(folder, "--episodes", "10")
        assert status == 0 and f"{len(finished)} of 8 runs were complete already" in written
        assert finished.items() <= {path: path.stat().st_mtime_ns for path in folder.glob("runs/*.json")}.items()
