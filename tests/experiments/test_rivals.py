"""Fitted R-Max beside DQN, PPO and CrossQ: what is fixed beforehand, and the command, without SBX."""

import importlib.util
from dataclasses import replace

import pandas as pd
import pytest
from stable_baselines3.common.vec_env import VecNormalize

from sb3_combrel.experiments import rivals
from sb3_combrel.experiments.rivals import THRESHOLDS, arguments_of, published, rival_jobs

WITHOUT_SBX = ["FittedRMax", "DQN", "PPO"]


def test_the_thresholds_are_those_of_gymnasium_and_one_of_ours():
    assert THRESHOLDS == {
        **{"CartPole-v1": 475.0, "MountainCar-v0": -110.0, "Acrobot-v1": -100.0},
        **{"Pendulum-v1": -200.0, "MountainCarContinuous-v0": 90.0},
    }


def test_the_command_writes_a_row_a_run_and_does_not_repeat_what_is_there(tmp_path):
    arguments = {"seeds": [1], "max_steps": 96, "output": tmp_path / "rivals", "table": tmp_path / "rivals.csv"}
    rivals.rivals(["MountainCar-v0", "MountainCarContinuous-v0"], WITHOUT_SBX, **arguments)
    table = pd.read_csv(arguments["table"])
    assert list(table["algorithm"]) == 2 * WITHOUT_SBX and set(table["seed"]) == {1} and not table["reached"].any()
    assert (table["steps"] == 96).all()
    for column in ("seconds", "wall_seconds"):  # 96 steps of a rival may round to 0.00 s; six runs do not
        assert (table[column] >= 0.0).all() and table[column].sum() > 0.0
    first_use = table.groupby(table["algorithm"] == "FittedRMax")["first_use_seconds"].sum()
    assert first_use[True] > 0.0 and first_use[False] == 0.0
    rivals.rivals(["MountainCar-v0", "MountainCarContinuous-v0"], WITHOUT_SBX, **arguments)
    assert pd.read_csv(arguments["table"]).equals(table)


def small_job(algorithm, task, **changed):
    [job] = rival_jobs([task], [algorithm], [1], 400)
    return replace(job, **changed)


def test_learning_ends_at_the_first_evaluation_that_reaches_the_threshold_or_with_the_last_step():
    result = small_job("FittedRMax", "MountainCar-v0", threshold=-200.0, every=50).carry_out()
    assert result.more["reached"] and result.n_steps == 50 and result.more["best_return"] >= -200.0
    result = small_job("PPO", "MountainCar-v0", threshold=1.0, every=160, n_steps=320).carry_out()
    assert not result.more["reached"] and result.n_steps == 320 and result.more["best_return"] == -200.0


def test_evaluations_do_not_change_what_normalises_observations_and_see_rewards_as_they_are():
    job = small_job("PPO", "MountainCar-v0")
    learning, evaluation = job.make_envs(0), job.make_envs(0, evaluation=True)
    assert isinstance(learning, VecNormalize) and learning.training and learning.norm_reward and learning.num_envs == 16
    assert isinstance(evaluation, VecNormalize) and not evaluation.training and not evaluation.norm_reward


def test_hyperparameters_are_those_of_rl_zoo():
    arguments = arguments_of(published("PPO", "CartPole-v1"))
    assert arguments["n_steps"] == 32 and {"n_envs", "n_timesteps"}.isdisjoint(arguments)
    assert arguments["learning_rate"](1.0) == 0.001 and arguments["clip_range"](0.5) == pytest.approx(0.1)
    assert arguments_of(published("DQN", "MountainCar-v0"))["policy_kwargs"] == {"net_arch": [256, 256]}
    assert arguments_of({"normalize": True}) == {}


def test_crossq_learns_tasks_with_continuous_actions_only(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: find_spec("rl_zoo3" if name == "sbx" else name))
    jobs = rival_jobs(list(THRESHOLDS), ["CrossQ"], [1], 100)
    assert [job.group for job in jobs] == ["Pendulum-v1", "MountainCarContinuous-v0"]


@pytest.mark.parametrize(("package", "algorithm"), [("sbx", "CrossQ"), ("rl_zoo3", "DQN")])
def test_what_is_not_installed_is_named_with_the_extra_before_anything_runs(monkeypatch, tmp_path, package, algorithm):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find_spec(name))
    with pytest.raises(ModuleNotFoundError, match=rf"needs {package}, .*pip install 'sb3-combrel\[benchmarks\]'"):
        rivals.rivals(algorithms=["FittedRMax", algorithm], output=tmp_path, table=tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"algorithms must be some of .*, got 'fitted_rmax'; did you mean 'FittedRMax'"):
        rival_jobs(["CartPole-v1"], ["fitted_rmax"], [1], 100)
    with pytest.raises(ValueError, match=r"tasks must be some of .*, got 'CartPole'"):
        rival_jobs(["CartPole"], ["DQN"], [1], 100)
