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
from sb3_combrel.tensorboard.callback import DashboardCallback


@pytest.mark.integration
@pytest.mark.parametrize("method", METHODS)
def test_a_log_changes_nothing_of_what_is_learned(method, transfers, tmp_path):
    plain = walker(transfer=transfers[method]).learn(300)
    logged = walker(tmp_path, transfers[method]).learn(300, DashboardCallback(picture_freq=20), log_interval=1)
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


@pytest.mark.integration
def test_no_part_of_the_dashboard_is_imported_without_a_log():
    command = (
        "import sys; from sb3_combrel import FittedRMax; FittedRMax('MountainCar-v0', seed=0).learn(300);"
        "print([m for m in sys.modules if m.startswith(('matplotlib', 'sb3_combrel.tensorboard.pictures'))])"
    )
    result = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_a_logger_of_the_users_own_counts_as_a_log(tmp_path):
    model = walker()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(150)
    assert "planner/residual" in events(tmp_path).Tags()["scalars"]


@pytest.mark.parametrize("given", ["function", "list", "callback", "nested"])
def test_the_dashboard_stands_beside_other_callbacks(given, tmp_path):
    calls = []

    def function(locals_, globals_):
        calls.append(1)
        return True

    witness = Witness(lambda model: calls.append(1))
    callback = {
        "function": function,
        "list": [witness],
        "callback": witness,
        "nested": CallbackList([EveryNTimesteps(10, Witness(len)), witness]),
    }[given]
    walker(tmp_path).learn(150, callback)
    assert calls and "planner/residual" in events(run_folder(tmp_path)).Tags()["scalars"]


@pytest.mark.parametrize("wrap", [list, CallbackList])
def test_a_dashboard_that_is_given_is_the_only_one(wrap, tmp_path):
    given = DashboardCallback(picture_freq=50, variables=[("height", "place")])
    walker(tmp_path).learn(100, wrap([given]))
    found = events(run_folder(tmp_path))
    assert found.Tags()["images"] == ["value_and_policy/height_place"]
    assert [image.step for image in found.Images("value_and_policy/height_place")] == [50, 100]


def test_a_model_is_saved_without_the_dashboard(transfers, tmp_path):
    model = walker(tmp_path / "log", transfers["COMBREL"]).learn(150)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=NamedWalk())
    assert "ashboard" not in str(model.__dict__)
    loaded.learn(50, DashboardCallback(), reset_num_timesteps=False)
    assert events(run_folder(tmp_path / "log")).Images("value_and_policy/place_height")[-1].step == 200


@pytest.mark.integration
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
    found = events(run_folder(tmp_path))
    assert [image.step for image in found.Images("value_and_policy/place_height")] == [100, 130, 200, 230]


@pytest.mark.integration
def test_the_dashboard_shows_environments_in_other_processes(transfers, tmp_path):
    env = make_vec_env(NamedWalk, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    walker(tmp_path, transfers["COMBREL"], env).learn(200, DashboardCallback(picture_freq=75))
    env.close()
    found = events(run_folder(tmp_path))
    assert [image.step for image in found.Images("value_and_policy/place_height")] == [76, 150, 200]
    assert "transfer/compliance" in found.Tags()["scalars"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(variables=["place"]), "pairs of state variables"),
        (dict(variables=[("place", "place")]), "two different"),
        (dict(variables=[("place", "speed")]), "place, height"),
        (dict(variables=[(0, 2)]), "below 2"),
        (dict(at=[0.0]), "at must be 2 numbers"),
    ],
)
def test_variables_and_states_that_do_not_fit_the_task_are_refused(wrong, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        walker(tmp_path).learn(10, DashboardCallback(**wrong))


@pytest.mark.parametrize("name", ["scalar_share", "picture_share"])
@pytest.mark.parametrize("share", [0, -0.1, 1.5])
def test_a_share_is_between_0_and_1(name, share):
    with pytest.raises(ValueError, match=name):
        DashboardCallback(**{name: share})


@pytest.mark.parametrize("freq", [0, -5, 1.5])
def test_a_frequency_is_a_number_of_steps(freq):
    with pytest.raises(ValueError, match="picture_freq"):
        DashboardCallback(picture_freq=freq)
