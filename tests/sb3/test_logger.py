"""Logs: groups and names as SB3 has them, to files, the screen and TensorBoard."""

import csv

import pytest
from helpers.walk import METHODS, small
from stable_baselines3.common.logger import configure


def test_logs_have_the_groups_that_sb3_has_those_of_transfer_only_with_it_and_the_figures_of_the_run(make, method, tmp_path):
    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=1)
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    wanted = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/episodes", "time/total_timesteps"}
    assert wanted <= rows[0].keys() and ("transfer/instances_used" in rows[0]) == (method != "none")
    assert [int(float(row["time/episodes"])) for row in rows] == list(range(1, model._episode_num + 1))
    for row in rows:
        # Every step costs 1.
        assert float(row["rollout/ep_rew_mean"]) == -float(row["rollout/ep_len_mean"])
        assert int(float(row["model/instances"])) == int(float(row["time/total_timesteps"]))
        assert abs(sum([float(row[f"model/{name}"]) for name in ("known", "transferred", "optimistic")]) - 1.0) < 1e-5


def test_without_a_log_interval_nothing_is_logged(tmp_path):
    model = small()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, log_interval=None)
    assert (tmp_path / "progress.csv").read_text() == ""
    model.dump_logs()
    assert len((tmp_path / "progress.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("method", "seed", "name"), [("none", None, "FittedRMax"), ("COMBREL", 3, "FittedRMax_COMBREL_seed3")]
)
def test_tensorboard_logs_are_named_after_algorithm_transfer_method_and_seed(method, seed, name, tmp_path):
    model = small(transfer=METHODS[method](), seed=seed, tensorboard_log=str(tmp_path)).learn(2)
    model.learn(2, reset_num_timesteps=False)
    assert [folder.name for folder in tmp_path.iterdir()] == [f"{name}_1"]
    assert len(list((tmp_path / f"{name}_1").glob("events.*"))) == 2
    model.learn(2)
    assert {folder.name for folder in tmp_path.iterdir()} == {f"{name}_1", f"{name}_2"}
    model.learn(2, tb_log_name="again")
    assert (tmp_path / "again_1").is_dir()


def test_verbose_learning_logs_to_the_screen(capsys):
    small(verbose=1).learn(60, log_interval=1)
    assert "ep_rew_mean" in capsys.readouterr().out
