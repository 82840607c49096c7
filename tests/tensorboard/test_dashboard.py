"""The dashboard's callback: when it is there, beside what else, and that it changes nothing of what is learned."""

import subprocess
import sys

import pytest
import torch as th
from helpers.dashboard import METHODS, NamedWalk, Witness, events, run_folder, walker
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_combrel import FittedRMax
from sb3_combrel.callbacks import DashboardCallback

PICTURE = "value_and_policy/place_height"


def image_steps(log, tag=PICTURE):
    return [image.step for image in events(run_folder(log)).Images(tag)]


@pytest.mark.parametrize("method", METHODS)
def test_a_log_changes_nothing_of_what_is_learned(method, transfers, tmp_path):
    plain = walker(transfer=transfers[method]).learn(200)
    logged = walker(tmp_path, transfers[method]).learn(200, DashboardCallback(picture_freq=90), log_interval=1)
    one, other = plain.get_parameters()["policy"], logged.get_parameters()["policy"]
    assert one.keys() == other.keys() and all(th.equal(one[k], other[k]) for k in one)


def test_without_a_log_nothing_is_computed_for_one(transfers, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("this was for a log that nobody writes")

    monkeypatch.setattr("sb3_combrel.fitted_rmax.agent.FittedRMaxAgent.statistics", refuse)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DashboardCallback._on_training_start", refuse)
    monkeypatch.setattr("sb3_combrel.transfer.methods.combrel.COMBREL.choices", refuse)
    model = walker(transfer=transfers["COMBREL"]).learn(200)
    assert model._episode_num > 4 and model.agent.planning_seconds == 0.0
    monkeypatch.undo()
    dashboard = DashboardCallback(picture_freq=10)
    assert walker(transfer=transfers["COMBREL"]).learn(50, dashboard).agent.planning_seconds == 0.0


@pytest.mark.long
def test_matplotlib_is_imported_for_pictures_only(tmp_path):
    command = (
        "import sys; from sb3_combrel import FittedRMax; from sb3_combrel.callbacks import DashboardCallback;"
        "FittedRMax('MountainCar-v0', seed=0).learn(300);"
        "print('sb3_combrel.tensorboard.pictures' in sys.modules, 'matplotlib' in sys.modules);"
        "model = FittedRMax('MountainCar-v0', seed=0, tensorboard_log=sys.argv[1]);"
        "model.learn(300, DashboardCallback(picture_freq=None)); print('matplotlib' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", command, str(tmp_path)], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False"] * 3
    assert not events(run_folder(tmp_path)).Tags()["images"]


def test_a_logger_of_the_users_own_counts_as_a_log(tmp_path):
    model = walker()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(150)
    assert "planner/residual" in events(tmp_path).Tags()["scalars"]


@pytest.mark.parametrize("given", ["function", "list", "callback", "nested"])
def test_the_dashboard_stands_beside_other_callbacks(given, tmp_path):
    calls = []
    witness = Witness(lambda model: calls.append(1))
    callback = {
        "function": lambda locals_, globals_: calls.append(1) is None,
        "list": [witness],
        "callback": witness,
        "nested": CallbackList([EveryNTimesteps(10, Witness(len)), witness]),
    }[given]
    walker(tmp_path).learn(150, callback)
    assert calls and "planner/residual" in events(run_folder(tmp_path)).Tags()["scalars"]


@pytest.mark.parametrize("wrap", [list, CallbackList])
def test_a_dashboard_that_is_given_is_the_only_one(wrap, tmp_path):
    walker(tmp_path).learn(100, wrap([DashboardCallback(picture_freq=50, variables=[("height", "place")])]))
    assert events(run_folder(tmp_path)).Tags()["images"] == ["value_and_policy/height_place"]
    assert image_steps(tmp_path, "value_and_policy/height_place") == [50, 100]


def test_a_model_is_saved_without_the_dashboard(transfers, tmp_path):
    model = walker(tmp_path / "log", transfers["COMBREL"]).learn(150)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=NamedWalk())
    assert "ashboard" not in str(model.__dict__)
    loaded.learn(50, DashboardCallback(), reset_num_timesteps=False)
    assert image_steps(tmp_path / "log")[-1] == 200


def test_learning_goes_on_in_the_same_log_after_an_interrupt(transfers, tmp_path):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 130:
                raise KeyboardInterrupt
            return True

    model = walker(tmp_path, transfers["COMBREL"])
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000, [Interrupt(), DashboardCallback(picture_freq=100)])
    assert not model.agent.timed
    model.save(tmp_path / "model")
    model.learn(100, DashboardCallback(picture_freq=100), reset_num_timesteps=False)
    assert image_steps(tmp_path) == [100, 130, 200, 230]


def test_the_dashboard_shows_environments_in_other_processes(transfers, tmp_path):
    env = make_vec_env(NamedWalk, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    walker(tmp_path, transfers["COMBREL"], env).learn(200, DashboardCallback(picture_freq=150))
    env.close()
    assert image_steps(tmp_path) == [150, 200]
    assert "transfer/compliance" in events(run_folder(tmp_path)).Tags()["scalars"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(variables=["place"]), "pairs of two different state variables"),
        (dict(variables=[("place", "place")]), "two different"),
        (dict(variables=[("place", "speed")]), "place, height"),
        (dict(variables=[(0, 2)]), "below 2"),
        (dict(at=[0.0]), "at must be 2 numbers"),
    ],
)
def test_variables_and_states_that_do_not_fit_the_task_are_refused(wrong, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        walker(tmp_path).learn(10, DashboardCallback(**wrong))


@pytest.mark.parametrize(
    "wrong",
    [dict(scalar_share=0), dict(scalar_share=1.5), dict(picture_share=-0.1), dict(picture_freq=0), dict(picture_freq=1.5)],
)
def test_a_share_is_between_0_and_1_and_a_frequency_a_number_of_steps(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DashboardCallback(**wrong)
