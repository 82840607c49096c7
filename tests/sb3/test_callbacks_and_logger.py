"""Callbacks: what they are shown, how they stop the learning, and SB3's own."""

import csv

import pytest
from helpers.walk import METHODS, Recorder, Walk, same_parameters, small
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax


def test_callbacks_are_called_at_every_step_and_at_start_and_end(make):
    recorder = Recorder()
    model = make().learn(25, callback=recorder)
    assert (recorder.started, recorder.ended, recorder.n_calls) == (1, 1, 25) and model.num_timesteps == 25
    for shown in recorder.shown:
        assert shown["new_obs"].shape == (1, 2)
        assert shown["actions"].shape == shown["rewards"].shape == shown["dones"].shape == (1,)
        assert len(shown["infos"]) == 1


def test_a_callback_can_stop_the_learning(make):
    recorder = Recorder(stop_at=7)
    model = make().learn(1000, callback=recorder)
    assert (model.num_timesteps, recorder.ended) == (7, 1)
    model = make().learn(100_000, callback=StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps < 100
    assert model._episode_num == 3, "the episode that ended with the stop counts"


def test_an_interrupt_ends_the_training_and_leaves_a_model_that_saves_and_goes_on(make, tmp_path):
    recorder, model = Recorder(interrupt_at=12), make()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=recorder)
    assert recorder.ended == 1 and model.agent.model.n_instances == 12
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert same_parameters(model, loaded)
    for resumed in (model, loaded):
        resumed.learn(20, reset_num_timesteps=False)
        assert resumed.num_timesteps == 32 and resumed.agent.model.n_instances == 32


def test_learn_takes_a_progress_bar_and_a_function_as_callback():
    calls = []
    small().learn(10, callback=lambda local, _: calls.append(local["self"]) or True, progress_bar=True)
    assert len(calls) == 10


def test_evaluation_and_checkpoints_in_mid_episode_hold_all_that_was_learned_so_far(make, tmp_path):
    model = make()
    evaluation = EvalCallback(Monitor(Walk()), eval_freq=20, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(45, callback=[CheckpointCallback(7, str(tmp_path), "at"), evaluation])
    for steps in (7, 14, 42):
        assert FittedRMax.load(tmp_path / f"at_{steps}_steps").agent.model.n_instances == steps
    assert FittedRMax.load(tmp_path / "best_model").agent.model.n_instances in (20, 40)


# Logs: groups and names as SB3 has them, to files, the screen and TensorBoard.
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


@pytest.mark.parametrize("log_interval", [1, 4, None])
def test_rollouts_are_episodes_however_often_a_log_is_written(log_interval):
    class Rollouts(BaseCallback):
        ended = 0

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            self.ended += 1

    callback = Rollouts()
    model = small().learn(200, callback=callback, log_interval=log_interval)
    assert callback.ended == model._episode_num > 5


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


def test_callbacks_are_told_the_name_of_the_run():
    class Name(BaseCallback):
        def _on_step(self):
            self.name = self.locals["tb_log_name"]
            return False

    callback = Name()
    small().learn(5, callback=callback)
    assert callback.name == "FittedRMax_seed0"
    small().learn(5, callback=callback, tb_log_name="mine")
    assert callback.name == "mine"
