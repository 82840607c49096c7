"""RL-Zoo's commands, end to end, with budgets too small to learn much."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rl_zoo3")

from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.zoo import commands
from sb3_combrel.zoo.configurations import with_configuration
from sb3_combrel.zoo.plot_checks import check_window, with_evaluations

CONFIGS = Path(__file__).resolve().parents[2] / "zoo_configs"
CAR, IN_LOGS = "combrel/MountainCar2D-v0", "combrel-MountainCar2D-v0"


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_COMBREL_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("MPLBACKEND", "Agg")
        yield


def train_args(folder, *more, algo="fitted_rmax", env=CAR, conf=None, n=600):
    conf = conf or CONFIGS / f"{algo}.yml"
    fixed = ("--algo", algo, "--env", env, "--conf-file", conf, "--gym-packages", "combrel_envs", "-f", folder, "--seed", 1)
    return [str(arg) for arg in (*fixed, "-n", n, "--eval-episodes", 2, "--eval-freq", 300, *more)]


def call(command, *args):
    return commands.main([command, *map(str, args)])


def enjoy(folder, *more, algo="fitted_rmax", env=CAR):
    options = ("--gym-packages", "combrel_envs", "-f", folder, "--no-render", "-n", 5)
    return call("enjoy", "--algo", algo, "--env", env, *options, *more)


def write_config(path, **entry):
    path.write_text(yaml.dump({"default": {"n_timesteps": 300, "policy": "FittedRMaxPolicy", **entry}}))
    return path


def test_a_model_is_trained_and_watched_without_the_file_of_its_source(tmp_path):
    source = SourceInstances.record(None, CAR, n_instances=50, seed=0).save(tmp_path / "car.npz")
    conf = write_config(tmp_path / "combrel.yml", transfer={"sb3_combrel.COMBREL": {"source": str(source)}}, degree=0)
    assert call("train", *train_args(tmp_path, "--eval-freq", -1, algo="combrel", conf=conf, n=60)) == 0
    source.unlink()
    assert enjoy(tmp_path, algo="combrel") == 0


@pytest.mark.parametrize(
    ("entry", "change", "message"),
    [
        ({"transfer": {"sb3_combrel.COMBREL": {"source": "nowhere.npz"}}}, {}, "nowhere.npz"),
        ({"normalize": True}, {}, "VecNormalize"),
        ({}, {"env": "combrel/MountainCar3D-v0"}, "MountainCar3D"),
        ({}, {"conf": "nowhere.yml"}, "nowhere.yml"),
        ({"model_bredth": 0.1}, {}, "got 'model_bredth'; did you mean 'model_breadth'?"),
        ({"transfer": {"sb3_combrel.COMBREL": {"sorce": "car.npz"}}}, {}, "got 'sorce'; did you mean 'source'?"),
        ({"transfer": {"sb3_combrel.COMBRELL": {}}}, {}, "did you mean 'COMBREL'?"),
        ({"transfer": {"sb3_combrel.COMBREL": {"source": {"env": CAR, "n_instance": 5}}}}, {}, "did you mean 'n_instances'?"),
        ({"transfer": {"sb3_combrel.COMBREL": {"source": CAR, "mappings": "injectiv"}}}, {}, "did you mean 'injective'?"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, capsys, entry, change, message):
    conf = write_config(tmp_path / "bad.yml", **entry)
    assert call("train", *train_args(tmp_path, **{"conf": conf, **change})) == 1
    written = capsys.readouterr().err
    assert written.startswith("sb3_combrel.zoo: ") and message in written and "Traceback" not in written


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "must have an entry for each task"),
        ("MountainCar-v0: 5", "MountainCar-v0 must have settings by name, such as n_timesteps: 5000, got 5"),
        ("MountainCar-v0:\n - a", "must have settings by name"),
        (
            "MountainCar-v0:\n  planning_tolerance: 1e-3",
            "planning_tolerance must be a number, got '1e-3', which is text: YAML",
        ),
    ],
)
def test_a_configuration_that_is_none_is_said_in_one_sentence(tmp_path, capsys, content, message):
    conf = tmp_path / "bad.yml"
    conf.write_text(content)
    assert call("train", *train_args(tmp_path, conf=conf)) == 1
    written = capsys.readouterr().err
    assert written.startswith("sb3_combrel.zoo: ") and message in written and "Traceback" not in written


def test_a_configuration_of_this_package_is_found_where_none_is_named():
    ours = [str(CONFIGS / f"{algo}.yml") for algo in ("combrel", "dqn")]
    assert with_configuration(["--algo", "combrel", "--env", "CartPole-v1"])[:2] == ["--conf-file", ours[0]]
    assert with_configuration(["--algo", "dqn", "--env", CAR])[:2] == ["--conf-file", ours[1]]
    for args in (["--algo=dqn", "--env=CartPole-v1"], ["--algo", "a2c", "--env", CAR]):
        assert with_configuration(args) == args, "RL-Zoo's own"


@pytest.mark.parametrize("option", [["-conf", "{}"], ["--conf-file", "{}"], ["--conf", "{}"], ["--conf={}"]])
def test_a_configuration_of_the_users_is_taken_and_checked_however_its_option_is_spelt(tmp_path, option):
    args = ["--algo", "combrel", *(part.format(write_config(tmp_path / "own.yml")) for part in option)]
    assert with_configuration(args) == args
    (tmp_path / "own.yml").write_text("MountainCar-v0: 5")
    with pytest.raises(ValueError, match="must have settings by name"):
        with_configuration(args)


def test_past_data_come_from_a_configuration_or_the_command_line(tmp_path):
    SourceInstances.record(None, CAR, n_instances=50, seed=0).to_table().to_csv(tmp_path / "log.csv", index=False)
    conf = write_config(tmp_path / "past.yml", instances=str(tmp_path / "log.csv"))
    assert call("train", *train_args(tmp_path / "yaml", "--eval-freq", -1, conf=conf, n=60)) == 0
    given = ("--eval-freq", -1, "-params", f"instances:'{tmp_path / 'log.csv'}'")
    assert call("train", *train_args(tmp_path / "line", *given, n=60)) == 0
    for folder in ("yaml", "line"):
        model = FittedRMax.load(tmp_path / folder / "fitted_rmax" / f"{IN_LOGS}_1" / f"{IN_LOGS}.zip")
        assert model.agent.model.n_instances == 110


def test_an_unknown_command_or_algorithm_is_refused(tmp_path, capsys):
    assert call("dance") == 2 and "train" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        call("train", *train_args(tmp_path, algo="magic"))
    assert "magic" in capsys.readouterr().err


def test_a_hub_that_cannot_be_reached_is_a_sentence(tmp_path, capsys, monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("no answer") from ConnectionError("refused")

    monkeypatch.setattr("rl_zoo3.utils.get_hf_trained_models", refuse)
    assert call("benchmark", "--log-dir", tmp_path, "--benchmark-dir", tmp_path) == 1
    assert capsys.readouterr().err.startswith("sb3_combrel.zoo: the Hugging Face hub cannot be reached")
    assert call("benchmark", "--no-hub", "--log-dir", tmp_path / "nowhere", "--benchmark-dir", tmp_path) == 1
    assert "nowhere" in capsys.readouterr().err


def test_an_algorithm_without_evaluations_is_named_and_left_out_of_plots(tmp_path, capsys):
    (tmp_path / "combrel" / f"{IN_LOGS}_1").mkdir(parents=True)
    (tmp_path / "combrel" / f"{IN_LOGS}_1" / "evaluations.npz").touch()
    options = ["-e", IN_LOGS, "-f", str(tmp_path), "--no-display"]
    assert with_evaluations(["-a", "combrel", "timbrel", *options]) == ["-a", "combrel", *options]
    assert f"timbrel has no evaluations of {IN_LOGS}" in capsys.readouterr().err
    two = ["-a", "combrel", "-e", IN_LOGS, "-f", str(tmp_path), str(tmp_path / "empty")]
    assert with_evaluations(two) == two
    assert f"{IN_LOGS} in {tmp_path / 'empty'}: train it first, with --eval-freq; it is 0.0" in capsys.readouterr().err
    with pytest.raises(ValueError, match="nothing to plot"):
        with_evaluations(["-a", "timbrel", *options])


def test_runs_shorter_than_the_window_are_named(tmp_path, capsys):
    for run, n_episodes in enumerate((3, 30)):
        folder = tmp_path / "combrel" / f"{IN_LOGS}_{run}"
        folder.mkdir(parents=True)
        (folder / "0.monitor.csv").write_text("\n".join(["#settings", "r,l,t", *["-1,1,1"] * n_episodes]))
    args = ["-a", "combrel", "-e", IN_LOGS, "-f", str(tmp_path), "-w"]
    assert check_window([*args, "10"]) == [*args, "10"]
    assert "_0 has 3 episodes, fewer than the window of 10" in capsys.readouterr().err
    with pytest.raises(ValueError, match="nothing to plot"):
        check_window([*args, "31"])


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """What a training run has left: last and best model, checkpoints and evaluations."""
    folder = tmp_path_factory.mktemp("logs")
    assert call("train", *train_args(folder, "--save-freq", 200, "--save-replay-buffer")) == 0
    return folder


@pytest.mark.long
class TestChain:
    def test_training_keeps_models_that_are_enjoyed_resumed_and_filmed(self, logs, tmp_path, capsys):
        folder = logs / "fitted_rmax" / f"{IN_LOGS}_1"
        assert np.load(folder / "evaluations.npz")["timesteps"].tolist() == [300, 600]
        checkpoints = {f"rl_model_{steps}_steps.zip" for steps in (200, 400, 600)}
        assert {path.name for path in folder.glob("*.zip")} == {"best_model.zip", f"{IN_LOGS}.zip", *checkpoints}
        for which, file in (
            *[((), IN_LOGS), (("--load-best",), "best_model"), (("--load-checkpoint", 200), "rl_model_200")],
            (("--load-last-checkpoint",), "rl_model_600"),
        ):
            assert enjoy(logs, *which) == 0 and file in capsys.readouterr().out
        assert call("train", *train_args(tmp_path, "-i", folder / f"{IN_LOGS}.zip", n=100)) == 0
        (resumed,) = tmp_path.glob(f"fitted_rmax/*/{IN_LOGS}.zip")
        assert FittedRMax.load(resumed).agent.model.n_instances == 700, "none is counted twice"
        options = ("-n", 5, "-o", tmp_path, "-f", logs, "--gym-packages", "combrel_envs")
        assert call("record_video", "--algo", "fitted_rmax", "--env", CAR, *options) == 0
        assert list(tmp_path.glob("*.mp4"))

    @pytest.mark.parametrize("algo", ["qrdqn", "ppo"])
    def test_plots_and_tables_compare_with_other_algorithms(self, logs, tmp_path, capsys, monkeypatch, algo):
        monkeypatch.chdir(tmp_path)  # where RL-Zoo copies the table of its benchmark to
        assert call("train", *train_args(tmp_path, algo=algo)) == 0
        options = ("-e", IN_LOGS, "-f", logs, tmp_path, "-l", "mine", "theirs", "--no-display")
        assert call("all_plots", "-a", "fitted_rmax", algo, *options, "--no-million") == 0
        printed = capsys.readouterr().out
        assert "FITTED_RMAX" in printed and algo.upper() in printed
        assert call("plot_train", "-a", "fitted_rmax", "-e", IN_LOGS, "-f", logs, "-w", 1) == 0
        options = ("--no-hub", "-n", 2000, "--log-dir", logs, "--benchmark-dir", tmp_path / "table")
        assert call("benchmark", *options, "--gym-packages", "combrel_envs") == 0
        assert f"|fitted_rmax|{IN_LOGS}|" in (tmp_path / "benchmark.md").read_text().replace(" ", "")

    @pytest.mark.parametrize(("env", "n_actions"), [("Pendulum-v1", 5), ("Acrobot-v1", 3)])
    def test_tasks_with_angles_have_their_wrappers(self, tmp_path, env, n_actions):
        assert call("train", *train_args(tmp_path, "--eval-freq", 30, env=env, n=60)) == 0
        (model_file,) = tmp_path.glob(f"fitted_rmax/*/{env}.zip")
        model = FittedRMax.load(model_file)
        assert any(model.agent.periodic) and model.action_space.n == n_actions and enjoy(tmp_path, env=env) == 0

    def test_processes_tune_transfer_too_in_one_database_and_a_trial_is_trained_with(self, tmp_path):
        optuna = pytest.importorskip("optuna")
        url = f"sqlite:///{tmp_path / 'study.db'}"
        optuna.create_study(storage=url, study_name="car", direction="maximize")
        source = {"env": CAR, "n_instances": 50, "total_timesteps": 200}
        transfer = {"sb3_combrel.COMBREL": {"source": source, "n_neighbors": 99, "use": "instances"}}
        conf = write_config(tmp_path / "combrel.yml", transfer=transfer)
        of_study = ("--storage", url, "--study-name", "car")
        tuning = ("-optimize", "--n-trials", 2, "--n-evaluations", 2, "--n-startup-trials", 1, "--no-optim-plots")
        here = dict(algo="combrel", env="MountainCar-v0", conf=conf)
        command = [sys.executable, "-m", "sb3_combrel.zoo", "train"]
        both = []
        for name in ("a", "b"):
            args = train_args(tmp_path / name, *tuning, *of_study, "--pruner", "median", n=300, **here)
            both.append(subprocess.Popen([*command, *args], stdout=subprocess.DEVNULL))
        assert [process.wait(timeout=600) for process in both] == [0, 0]
        study = optuna.load_study(storage=url, study_name="car")
        assert len(study.trials) == 4 and {trial.state.name for trial in study.trials} <= {"COMPLETE", "PRUNED"}
        assert call("train", *train_args(tmp_path, *of_study, "--trial-id", 1, "--eval-freq", -1, n=60, **here)) == 0
        (model_file,) = tmp_path.glob("combrel/*/MountainCar-v0.zip")
        transfer, drawn = FittedRMax.load(model_file).policy.transfer, study.trials[1].params
        assert transfer.n_neighbors == drawn["transfer_n_neighbors"] and len(transfer.source) == 50

    @pytest.mark.parametrize("program", ["sb3_combrel.zoo", "rl_zoo3.train"])
    def test_environments_in_processes_and_an_unmodified_zoo(self, tmp_path, program):
        args = train_args(tmp_path, "--vec-env", "subproc", conf=write_config(tmp_path / "two.yml", n_envs=2), n=100)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(CONFIGS), os.environ.get("PYTHONPATH", "")])}
        command = [sys.executable, "-m", program, *(["train"] if program == "sb3_combrel.zoo" else []), *args]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert len(list(tmp_path.glob("fitted_rmax/*/*.monitor.csv"))) == 2
