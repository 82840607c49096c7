"""The command line: recording, help, errors in one line."""

import sys

import pytest
from helpers.command_line import call_for_all_output

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import SourceInstances
from sb3_combrel.common.version import __version__
from sb3_combrel.experiments.paper.domains import ICUB, MOUNTAIN_CAR


class TestRecord:
    SHORT = ("combrel/MountainCar2D-v0", "--n-instances", "20", "--total-timesteps", "50")

    def test_record_writes_source_instances(self, tmp_path):
        status, written = call_for_all_output("record", *self.SHORT, "--output", tmp_path / "car", "--seed", "3")
        assert status == 0
        source = SourceInstances.load(tmp_path / "car.npz")
        assert len(source) == 20 and source.state_names == ("x", "v") and str(tmp_path / "car.npz") in written

    def test_a_file_is_overwritten_only_when_asked(self, tmp_path):
        file = tmp_path / "car.npz"
        file.write_text("mine")
        status, written = call_for_all_output("record", *self.SHORT, "--output", file)
        assert status == 1 and "--overwrite" in written
        assert file.read_text() == "mine"
        assert call_for_all_output("record", *self.SHORT, "--output", file, "--overwrite")[0] == 0
        assert len(SourceInstances.load(file)) == 20

    @pytest.mark.long
    def test_a_task_without_bounds_is_learned_by_fitted_rmax(self, tmp_path):
        status, written = call_for_all_output("record", "CartPole-v1", "--n-instances", "20", "--output", tmp_path / "pole")
        source = SourceInstances.load(tmp_path / "pole.npz")
        assert status == 0 and len(source) == 20 and source.origin["recorder"] == "FittedRMax", written

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("--output", "/dev/null/source.npz"), "output must be in a folder that can be written to, got /dev/null"),
            (("--output", "."), "output must be a file, such as source.npz, got the folder ."),
            (("--seed", "-1"), "seed must be a whole number of at least 0, got -1"),
        ],
    )
    def test_what_is_wrong_is_said_before_anything_is_learned(self, tmp_path, monkeypatch, arguments, message):
        monkeypatch.setattr(SourceInstances, "from_q_learning", None)
        status, written = call_for_all_output("record", *self.SHORT, "--output", tmp_path / "car", *arguments)
        assert status == 1 and message in written and not list(tmp_path.iterdir())

    def test_steps_of_q_learning_are_refused_where_it_cannot_learn(self, tmp_path):
        status, written = call_for_all_output("record", "CartPole-v1", "--total-timesteps", "5", "--output", tmp_path / "pole")
        assert status == 1 and "total_timesteps must be left out, got 5: CartPole-v1 has state variables" in written

    @pytest.mark.parametrize(
        ("env_id", "message"),
        [("Nowhere-v0", "Nowhere"), ("no_such_package:Task-v0", "no_such_package"), ("Pendulum-v1", "Discrete")],
    )
    def test_a_task_that_cannot_be_learned_is_named_without_a_traceback(self, tmp_path, env_id, message):
        status, written = call_for_all_output("record", env_id, "--output", tmp_path / "none.npz")
        assert status == 1 and message in written and "Traceback" not in written
        assert not list(tmp_path.iterdir())


class TestCommandLine:
    @pytest.mark.parametrize(("command", "goes_on"), [(["benchmark"], True), (["record", "CartPole-v1"], False), ([], False)])
    def test_a_command_that_is_stopped_promises_what_it_does(self, monkeypatch, command, goes_on):
        def stopped(*_, **__):
            raise KeyboardInterrupt

        monkeypatch.setattr("tyro.extras.subcommand_cli_from_dict", stopped)
        status, written = call_for_all_output(*command)
        assert status == 130 and "Stopped." in written and ("goes on from here" in written) == goes_on

    def test_help_names_the_commands(self):
        status, written = call_for_all_output("--help")
        assert status == 0 and all(name in written for name in ("demo", "record", "reproduce", "benchmark"))
        assert call_for_all_output("dance")[0] == 2

    def test_help_says_how_many_runs_a_setting_has(self):
        written = " ".join(call_for_all_output("reproduce", "--help")[1].replace("│", " ").split())
        car, robot = MOUNTAIN_CAR.settings, ICUB.settings
        assert robot["paper"].n_runs == robot["best"].n_runs
        n_runs = (
            f"{robot['best'].n_runs} on the iCub, on Mountain Car {car['paper'].n_runs} in setting paper, {car['best'].n_runs}"
        )
        assert n_runs in written

    def test_it_says_its_version(self):
        assert call_for_all_output("--version") == (0, f"sb3-combrel {__version__}\n")

    def test_without_tyro_the_command_names_what_to_install(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "tyro", None)
        status, written = call_for_all_output("demo")
        assert status == 1 and "sb3-combrel[experiments]" in written
