"""RL-Zoo's commands, end to end, with budgets too small to learn much."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces

pytest.importorskip("rl_zoo3")

from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.zoo import commands

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "zoo_configs"
CAR = "combrel/MountainCar2D-v0"
BIG_CAR = "combrel/MountainCar4D-v0"
SHORT_CAR = "MountainCar-v0"
RECIPE = {"env": CAR, "n_instances": 50, "total_timesteps": 200}


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


def run(module, *args, **variables):
    """The same in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **{name: str(value) for name, value in variables.items()}}
    return subprocess.run(
        [sys.executable, "-m", *module.split(), *map(str, args)], env=environment, capture_output=True, text=True, timeout=300
    )


def write_config(path, **entry):
    path.write_text(yaml.dump({"default": {"n_timesteps": 300, **entry}}))
    return path


class Box(gym.Env):
    """Variables and nothing else."""

    def __init__(self, n_variables):
        self.observation_space = spaces.Box(0.0, 1.0, (n_variables,))
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return np.zeros(self.observation_space.shape, dtype=np.float32), {}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """What a training run has left: last and best model, checkpoints and evaluations."""
    folder = tmp_path_factory.mktemp("logs")
    assert call("train", *train_args(folder, "--save-freq", 200)) == 0
    return folder


class TestTrainAndEnjoy:
    def test_training_evaluates_at_the_given_frequency_and_keeps_models(self, logs):
        (folder,) = (logs / "fitted_rmax").iterdir()
        assert np.load(folder / "evaluations.npz")["timesteps"].tolist() == [300, 600]
        names = {path.name for path in folder.glob("*.zip")}
        checkpoints = {f"rl_model_{steps}_steps.zip" for steps in (200, 400, 600)}
        assert names == {"best_model.zip", "combrel-MountainCar2D-v0.zip", *checkpoints}

    @pytest.mark.parametrize("which", [(), ("--load-best",), ("--load-checkpoint", "200"), ("--load-last-checkpoint",)])
    def test_enjoy_loads_last_and_best_model_and_checkpoints(self, logs, capsys, which):
        options = ("--gym-packages", "combrel_envs", "-f", logs, "--no-render", "-n", 30)
        assert call("enjoy", "--algo", "fitted_rmax", "--env", CAR, *options, *which) == 0
        name = {"--load-best": "best_model", "--load-checkpoint": "rl_model_200", "--load-last-checkpoint": "rl_model_600"}
        assert name.get("".join(which[:1]), "combrel-MountainCar2D-v0.zip") in capsys.readouterr().out

    def test_training_can_be_resumed(self, logs, tmp_path):
        agent = logs / "fitted_rmax" / "combrel-MountainCar2D-v0_1" / "combrel-MountainCar2D-v0.zip"
        assert call("train", *train_args(tmp_path, "-i", agent)) == 0

    @pytest.mark.slow
    def test_environments_in_subprocesses_work(self, tmp_path):
        conf = write_config(tmp_path / "two.yml", policy="FittedRMaxPolicy", n_envs=2)
        done = run("sb3_combrel.zoo train", *train_args(tmp_path, "--vec-env", "subproc", conf=conf))
        assert done.returncode == 0, done.stderr
        assert len(list(tmp_path.glob("fitted_rmax/*/*.monitor.csv"))) == 2

    @pytest.mark.slow
    def test_an_unmodified_zoo_knows_the_algorithm_by_the_hook(self, tmp_path):
        path = os.pathsep.join([str(CONFIGS), os.environ.get("PYTHONPATH", "")])
        done = run("rl_zoo3.train", *train_args(tmp_path, n=100), PYTHONPATH=path)
        assert done.returncode == 0, done.stderr

    def test_an_unknown_command_is_refused(self, capsys):
        assert call("dance") == 2
        assert "train" in capsys.readouterr().out


class TestShippedConfigurations:
    @pytest.mark.parametrize("algo", ["dqn", "qrdqn", "ppo"])
    def test_other_algorithms_have_settings_for_every_task(self, algo):
        tasks = {CAR, BIG_CAR, "combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0"}
        assert tasks <= set(yaml.safe_load((CONFIGS / f"{algo}.yml").read_text()))

    @pytest.mark.parametrize(("env", "n_actions"), [("Pendulum-v1", 5), ("Acrobot-v1", 3)])
    def test_tasks_with_angles_have_their_wrappers(self, tmp_path, env, n_actions):
        assert call("train", *train_args(tmp_path, "--eval-freq", 30, env=env, n=60)) == 0
        (model_file,) = tmp_path.glob(f"fitted_rmax/*/{env}.zip")
        model = FittedRMax.load(model_file)
        assert any(model.agent.periodic) and model.action_space.n == n_actions
        assert call("enjoy", "--algo", "fitted_rmax", "--env", env, "-f", tmp_path, "--no-render", "-n", 5) == 0

    @pytest.mark.slow
    @pytest.mark.parametrize("algo", ["dqn", "qrdqn", "ppo"])
    def test_a_table_compares_them_with_fitted_rmax(self, logs, tmp_path, capsys, algo):
        pytest.importorskip("pandas")
        # Too few steps to learn anything: what counts is that logs of both are understood.
        assert call("train", *train_args(tmp_path, algo=algo)) == 0
        options = ("-e", "combrel-MountainCar2D-v0", "-f", logs, tmp_path, "-l", "mine", "theirs", "--no-display")
        assert call("all_plots", "-a", "fitted_rmax", algo, *options, "--no-million") == 0
        printed = capsys.readouterr().out
        assert "FITTED_RMAX" in printed and algo.upper() in printed


class TestTransfer:
    def trained(self, folder, algo, env):
        """The transfer method of a short run with a shipped configuration; and its name there."""
        entry = yaml.safe_load((CONFIGS / f"{algo}.yml").read_text())[env]
        ((method, arguments),) = entry["transfer"].items()
        entry["transfer"] = {method: {**arguments, "source": RECIPE}}
        conf = folder / "short.yml"
        conf.write_text(yaml.dump({env: entry}))
        assert call("train", *train_args(folder, "--eval-freq", -1, algo=algo, env=env, conf=conf, n=60)) == 0
        (model_file,) = folder.glob(f"{algo}/*/*.zip")
        return FittedRMax.load(model_file).policy.transfer, method

    @pytest.mark.parametrize("algo", ["timbrel", "combrel"])
    @pytest.mark.parametrize("env", [CAR, BIG_CAR])
    def test_the_shipped_configurations_run(self, tmp_path, algo, env):
        transfer, _ = self.trained(tmp_path, algo, env)
        assert len(transfer.source) == 50

    @pytest.mark.parametrize("algo", ["master", "mapping_experts", "soft_homomorphism"])
    def test_the_configurations_of_the_other_methods_run(self, tmp_path, algo):
        transfer, method = self.trained(tmp_path, algo, BIG_CAR)
        assert type(transfer).__name__ == method.rpartition(".")[2]

    def test_a_source_task_is_learnt_once_and_then_read(self, capsys):
        from sb3_combrel.zoo.sources import find_source

        first, printed = find_source({**RECIPE, "seed": 7}), capsys.readouterr().out
        second = find_source({**RECIPE, "seed": 7})
        assert "Learning the source task" in printed
        assert not capsys.readouterr().out
        assert np.array_equal(first.states, second.states)

    def test_a_saved_model_needs_no_source_file(self, tmp_path):
        source = SourceInstances.from_q_learning(CAR, n_instances=50, seed=0, total_timesteps=200).save(tmp_path / "car")
        transfer = {"sb3_combrel.COMBREL": {"source": str(source)}}
        conf = write_config(tmp_path / "combrel.yml", policy="FittedRMaxPolicy", transfer=transfer)
        assert call("train", *train_args(tmp_path, "--eval-freq", -1, algo="combrel", conf=conf, n=60)) == 0
        source.unlink()
        options = ("--gym-packages", "combrel_envs", "-f", tmp_path, "--no-render", "-n", 5)
        assert call("enjoy", "--algo", "combrel", "--env", CAR, *options) == 0


class TestTuning:
    def tune(self, folder, storage, *more, n_trials=2, **changes):
        tuning = ("-optimize", "--n-trials", n_trials, "--n-evaluations", 2, "--n-startup-trials", 1, "--no-optim-plots")
        return train_args(folder, *tuning, "--storage", storage, "--study-name", "car", *more, n=300, env=SHORT_CAR, **changes)

    def test_tuning_runs_with_pruning_and_journal_storage(self, tmp_path):
        pytest.importorskip("pandas")
        optuna = pytest.importorskip("optuna")
        file = tmp_path / "journal.log"
        assert call("train", *self.tune(tmp_path, file, "--pruner", "median")) == 0
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(file)))
        study = optuna.load_study(storage=storage, study_name="car")
        assert {trial.state.name for trial in study.trials} <= {"COMPLETE", "PRUNED"}
        assert set(study.trials[0].params) >= {"model_breadth", "min_fraction", "max_backups_power"}
        # A trial's settings can be trained with: they pass the converter.
        options = ("--storage", file, "--study-name", "car", "--trial-id", 1)
        assert call("train", *train_args(tmp_path, *options, env=SHORT_CAR, n=100)) == 0

    def test_the_arguments_of_transfer_are_tuned_with_the_rest(self, tmp_path):
        pytest.importorskip("pandas")
        optuna = pytest.importorskip("optuna")
        url = f"sqlite:///{tmp_path / 'study.db'}"
        transfer = {"sb3_combrel.COMBREL": {"source": RECIPE, "n_neighbors": 99}}
        conf = write_config(tmp_path / "combrel.yml", policy="FittedRMaxPolicy", transfer=transfer)
        options = ("--pruner", "median")
        assert call("train", *self.tune(tmp_path, url, *options, n_trials=3, algo="combrel", conf=conf)) == 0
        study = optuna.load_study(storage=url, study_name="car")
        assert {trial.state.name for trial in study.trials} <= {"COMPLETE", "PRUNED"}
        drawn = study.trials[1].params
        assert {name for name in drawn if name.startswith("transfer_")} == {
            "transfer_breadth",
            "transfer_n_neighbors",
            "transfer_min_compliance",
            "transfer_relevance",
            "transfer_neighbor_radius",
            "transfer_choice",
        }
        # They take the place of those in the configuration; what was not drawn stays.
        options = ("--storage", url, "--study-name", "car", "--trial-id", 1, "--eval-freq", -1)
        assert call("train", *train_args(tmp_path, *options, algo="combrel", env=SHORT_CAR, conf=conf, n=60)) == 0
        (model_file,) = tmp_path.glob("combrel/*/MountainCar-v0.zip")
        transfer = FittedRMax.load(model_file).policy.transfer
        assert transfer.n_neighbors == drawn["transfer_n_neighbors"] and transfer.breadth == drawn["transfer_breadth"]
        assert len(transfer.source) == 50

    @pytest.mark.parametrize(("drawn", "expected"), [(None, 4), ("coarser", 3), ("finer", 5)])
    def test_a_drawn_grid_is_relative_to_the_one_that_suits_the_task(self, drawn, expected):
        from sb3_combrel.zoo.algorithm import ZooFittedRMax

        model = ZooFittedRMax("FittedRMaxPolicy", Box(3), model_breadth=0.2, resolution=drawn)
        assert model.agent.grid.resolution == (expected,) * 3

    def test_a_finer_grid_of_many_variables_stays_within_memory(self):
        from sb3_combrel.zoo.algorithm import ZooFittedRMax

        suited, finer = (ZooFittedRMax("FittedRMaxPolicy", Box(5), resolution=drawn) for drawn in (None, "finer"))
        assert finer.agent.grid.resolution == suited.agent.grid.resolution

    @pytest.mark.slow
    def test_processes_share_a_study_in_a_database(self, tmp_path):
        pytest.importorskip("pandas")
        optuna = pytest.importorskip("optuna")
        url = f"sqlite:///{tmp_path / 'study.db'}"
        optuna.create_study(storage=url, study_name="car", direction="maximize")
        command = [sys.executable, "-m", "sb3_combrel.zoo", "train"]
        both = [
            subprocess.Popen([*command, *self.tune(tmp_path / name, url)], stdout=subprocess.DEVNULL) for name in ("a", "b")
        ]
        assert [process.wait(timeout=300) for process in both] == [0, 0]
        assert len(optuna.load_study(storage=url, study_name="car").trials) == 4


class TestTablesAndPictures:
    def test_plot_train_and_all_plots_make_pictures_and_a_table(self, logs, tmp_path, capsys):
        pytest.importorskip("seaborn")
        pytest.importorskip("pandas")
        assert call("plot_train", "-a", "fitted_rmax", "-e", "combrel-MountainCar2D-v0", "-f", logs, "-w", 1) == 0
        options = ("--no-display", "--no-million", "-o", tmp_path / "all")
        assert call("all_plots", "-a", "fitted_rmax", "-e", "combrel-MountainCar2D-v0", "-f", logs, *options) == 0
        assert "FITTED_RMAX" in capsys.readouterr().out
        assert (tmp_path / "all.pkl").exists()

    def test_a_method_that_was_not_trained_is_named_and_left_out(self, logs, capsys):
        options = ("-e", "combrel-MountainCar2D-v0", "-f", logs, "--no-display")
        assert call("all_plots", "-a", "fitted_rmax", "timbrel", *options) == 0
        printed = capsys.readouterr()
        assert "timbrel has no evaluations of combrel-MountainCar2D-v0" in printed.err
        assert "FITTED_RMAX" in printed.out and "TIMBREL" not in printed.out
        assert call("all_plots", "-a", "timbrel", *options) == 1
        assert "nothing to plot" in capsys.readouterr().err

    def test_runs_shorter_than_the_window_are_named(self, logs, capsys):
        assert call("plot_train", "-a", "fitted_rmax", "-e", "combrel-MountainCar2D-v0", "-f", logs, "-w", 10**6) == 1
        written = capsys.readouterr().err
        assert "fewer than the window of 1000000" in written and "nothing to plot" in written

    @pytest.mark.parametrize("command", ["benchmark", "load_from_hub"])
    def test_a_hub_that_cannot_be_reached_is_a_sentence(self, tmp_path, capsys, monkeypatch, command):
        def refuse(*args, **kwargs):
            raise RuntimeError("no answer") from ConnectionError("refused")

        monkeypatch.setattr("rl_zoo3.utils.get_hf_trained_models", refuse)
        monkeypatch.setattr("huggingface_sb3.load_from_hub", refuse)
        options = {"benchmark": ("--log-dir", tmp_path, "--benchmark-dir", tmp_path)}
        options["load_from_hub"] = ("--algo", "combrel", "--env", CAR, "-f", tmp_path, "-orga", "nobody")
        assert call(command, *options[command]) == 1
        written = capsys.readouterr().err
        assert written.startswith("sb3_combrel.zoo: the Hugging Face hub cannot be reached") and "Traceback" not in written

    @pytest.mark.slow
    @pytest.mark.parametrize("mode", [("--test-mode",), ("--verbose", 2)])
    def test_benchmark_writes_a_table(self, logs, tmp_path, monkeypatch, mode):
        pytest.importorskip("pandas")
        # Without --test-mode RL-Zoo copies the table to where it was called.
        monkeypatch.chdir(tmp_path)
        options = ("--no-hub", "-n", 5000, "--log-dir", logs, "--benchmark-dir", tmp_path / "table")
        assert call("benchmark", *options, *mode, "--gym-packages", "combrel_envs") == 0
        assert "|fitted_rmax|combrel-MountainCar2D-v0|" in (tmp_path / "table/benchmark.md").read_text().replace(" ", "")
        assert (tmp_path / "benchmark.md").exists() == ("--test-mode" not in mode)

    def test_benchmark_says_that_there_are_no_logs(self, tmp_path, capsys):
        pytest.importorskip("pandas")
        options = ("--no-hub", "--log-dir", tmp_path / "nowhere", "--benchmark-dir", tmp_path)
        assert call("benchmark", *options) == 1
        assert "nowhere" in capsys.readouterr().err

    @pytest.mark.slow
    def test_record_video(self, logs, tmp_path):
        options = ("-n", 5, "-o", tmp_path, "-f", logs, "--gym-packages", "combrel_envs")
        assert call("record_video", "--algo", "fitted_rmax", "--env", CAR, *options) == 0
        assert list(tmp_path.glob("*.mp4"))


class TestBadInput:
    @pytest.mark.parametrize(
        ("entry", "message"),
        [
            ({"transfer": {"sb3_combrel.NOBODY": {"source": RECIPE}}}, "sb3_combrel.NOBODY"),
            ({"transfer": {"sb3_combrel.COMBREL": {"source": "nowhere.npz"}}}, "no source file nowhere.npz"),
            ({"transfer": {"sb3_combrel.COMBREL": None}}, "has no 'source'"),
            ({"transfer": {"sb3_combrel.COMBREL": {"source": RECIPE, "neighbours": 3}}}, "neighbours"),
            ({"transfer": {"sb3_combrel.COMBREL": {"source": {"env": "Nowhere-v0"}}}}, "Nowhere"),
            ({"transfer": {"sb3_combrel.COMBREL": {"source": {**RECIPE, "steps": 3}}}}, "steps"),
            ({"bounds": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]}, "bounds"),
            ({"normalize": True}, "VecNormalize"),
            ({"policy": None}, '"policy"'),
            ({"breadth": 0.1}, "breadth"),
            ({"resolution": "fine"}, "resolution"),
            ({"transfer_kwargs": {"n_neighbors": 5}}, "needs a transfer method"),
            ({"transfer": {"sb3_combrel.COMBREL": {"source": RECIPE}}, "transfer_kwargs": {"k": 5}}, "'k'"),
        ],
    )
    def test_an_error_in_a_configuration_is_reported_in_one_sentence(self, tmp_path, capsys, entry, message):
        entry = {"policy": "FittedRMaxPolicy", **entry}
        if entry["policy"] is None:
            del entry["policy"]
        assert call("train", *train_args(tmp_path, conf=write_config(tmp_path / "bad.yml", **entry))) == 1
        written = capsys.readouterr().err
        assert written.startswith("sb3_combrel.zoo: ")
        assert message in written
        assert "Traceback" not in written

    @pytest.mark.parametrize(
        ("change", "message"),
        [({"env": "combrel/MountainCar3D-v0"}, "MountainCar3D"), ({"conf": "nowhere.yml"}, "nowhere.yml")],
    )
    def test_an_unknown_environment_or_file_is_named(self, tmp_path, capsys, change, message):
        assert call("train", *train_args(tmp_path, **change)) == 1
        assert message in capsys.readouterr().err

    def test_an_unknown_algorithm_is_named(self, tmp_path, capsys):
        with pytest.raises(SystemExit):
            call("train", *train_args(tmp_path, algo="magic"))
        assert "magic" in capsys.readouterr().err
