"""Making a model and running it, as people who know SB3 type it."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
from helpers.walk import OBSERVATIONS, Walk
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_checker import check_env

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy


@pytest.mark.parametrize("name", ["learn", "save", "load", "set_env"])
def test_the_methods_take_what_those_of_sb3_take(name):
    assert list(inspect.signature(getattr(FittedRMax, name)).parameters) == list(
        inspect.signature(getattr(BaseAlgorithm, name)).parameters
    )


@pytest.mark.parametrize(
    "make_it",
    [
        lambda env: FittedRMax(env),
        lambda env: FittedRMax("FittedRMaxPolicy", env),
        lambda env: FittedRMax(FittedRMaxPolicy, env),
        lambda env: FittedRMax(env, "MlpPolicy"),
        lambda env: FittedRMax(env=env, policy="MlpPolicy"),
    ],
)
def test_environment_and_policy_come_in_either_order(make_it):
    model = make_it(Walk())
    assert isinstance(model.policy, FittedRMaxPolicy)
    assert model.n_envs == 1
    model.learn(10)


def test_an_environment_can_be_named():
    for model in (FittedRMax("MountainCar-v0"), FittedRMax("MlpPolicy", "MountainCar-v0")):
        assert model.env.get_attr("spec")[0].id == "MountainCar-v0"


@pytest.mark.filterwarnings("error::DeprecationWarning", "error::UserWarning", "error::RuntimeWarning")
def test_the_walk_of_these_tests_is_a_proper_environment():
    check_env(Walk(), warn=False)


def test_learning_counts_steps_and_episodes(make):
    model = make().learn(70)
    assert model.num_timesteps == model.agent.model.n_instances == 70
    assert model._episode_num >= 2
    model.learn(30, reset_num_timesteps=False)
    assert model.num_timesteps == model.agent.model.n_instances == 100
    model.learn(30)
    assert model.num_timesteps == 30, "steps are counted from 0 again"
    assert model.agent.model.n_instances == 130, "what was learned is kept"
    assert model.learn(1e1).num_timesteps == 10, "as it is often written"


def test_the_learned_policy_walks_to_the_goal(make):
    np.testing.assert_array_equal(make().learn(400).predict(OBSERVATIONS[3:18], deterministic=True)[0], 1)


@pytest.mark.long
def test_importing_is_light_and_compiles_nothing():
    code = (
        "import sys, sb3_combrel\n"
        "heavy = {'mujoco', 'dm_control', 'rl_zoo3', 'matplotlib', 'pandas', 'minari', 'optuna'} & set(sys.modules)\n"
        "from numba.core.dispatcher import Dispatcher\n"
        "import gc\n"
        "ours = [d for d in gc.get_objects() if isinstance(d, Dispatcher) and 'sb3_combrel' in d.py_func.__module__]\n"
        "assert ours\n"
        "compiled = [d for d in ours if d.signatures]\n"
        "sys.exit(f'{heavy} {compiled}' if heavy or compiled else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
