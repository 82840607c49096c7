"""The dashboard's callback: when it is there, beside what else, and that it changes nothing of what is learned."""

import subprocess
import sys

import pytest
from helpers.dashboard import METHODS, NamedWalk, Witness, events, run_folder, walker
from helpers.walk import same_parameters
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
def test_every_method_has_its_scalars_and_pictures_which_change_nothing_of_what_is_learned(method, transfers, tmp_path):
    plain = walker(transfer=transfers[method]).learn(150)
    logged = walker(tmp_path, transfers[method]).learn(150, DashboardCallback(picture_freq=90), log_interval=1)
    assert same_parameters(plain, logged)
    found = events(run_folder(tmp_path))
    tags = set(found.Tags()["scalars"])
    always = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "model/instances", "model/known", "model/optimistic"}
    always |= {"model/transferred", "planner/backups", "planner/residual", "planner/time_share"}
    assert always <= tags
    of_transfer = {"transfer/instances_used", "transfer/pairs_modelled"}
    of_choice = {"transfer/compliance", "transfer/choice_entropy", "transfer/switches", "transfer/distinct_mappings"}
    assert of_transfer <= tags if method != "none" else not any(tag.startswith("transfer/") for tag in tags)
    assert of_choice <= tags if method == "COMBREL" else not of_choice & tags
    of_choice = ["source_action/place_height", "state_mappings/chosen"] if method in ("TIMBREL", "COMBREL") else []
    assert sorted(found.Tags()["images"]) == sorted([PICTURE, *of_choice])
    assert ("transfer/most_chosen_mappings/text_summary" in found.Tags()["tensors"]) == (method != "none")


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
    model.learn(100, DashboardCallback(), log_interval=None)
    tags = events(tmp_path).Tags()
    assert not tags["scalars"] and tags["images"], "without logs of the algorithm there are pictures all the same"


@pytest.mark.parametrize("given", ["function", "nested"])
def test_the_dashboard_stands_beside_other_callbacks(given, tmp_path):
    calls = []
    nested = CallbackList([EveryNTimesteps(10, Witness(len)), Witness(lambda model: calls.append(1))])
    walker(tmp_path).learn(100, nested if given == "nested" else lambda locals_, globals_: calls.append(1) is None)
    assert calls and "planner/residual" in events(run_folder(tmp_path)).Tags()["scalars"]


def test_a_dashboard_that_is_given_is_the_only_one(tmp_path):
    walker(tmp_path).learn(100, CallbackList([DashboardCallback(picture_freq=50, variables=[("height", "place")])]))
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


def test_a_share_is_between_0_and_1_and_a_frequency_a_number_of_steps():
    for name, value in (("scalar_share", 0), ("scalar_share", 1.5), ("picture_share", -0.1), ("picture_freq", 1.5)):
        with pytest.raises(ValueError, match=name):
            DashboardCallback(**{name: value})
