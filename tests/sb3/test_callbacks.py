"""Callbacks: what they are shown, how they stop the learning, and SB3's own."""

import pytest
from helpers.walk import Recorder, Walk, same_parameters, small
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import FittedRMax


def test_callbacks_are_called_at_every_step_and_at_start_and_end(make):
    recorder = Recorder()
    model = make().learn(25, callback=recorder)
    assert (recorder.started, recorder.ended, recorder.n_calls) == (1, 1, 25)
    assert model.num_timesteps == 25
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
    recorder = Recorder(interrupt_at=12)
    model = make()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=recorder)
    assert recorder.ended == 1
    assert model.agent.model.n_instances == 12
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert same_parameters(model, loaded)
    for resumed in (model, loaded):
        resumed.learn(20, reset_num_timesteps=False)
        assert resumed.num_timesteps == 32
        assert resumed.agent.model.n_instances == 32


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
