"""Fitted R-Max as RL-Zoo builds it: shipped configurations, what a study draws, wrong entries."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from helpers.dashboard import Still

pytest.importorskip("rl_zoo3")

import optuna

import combrel_envs  # noqa: F401 - registers the environments
from sb3_combrel import SourceInstances
from sb3_combrel.zoo import ALGORITHMS
from sb3_combrel.zoo.algorithm import ZooFittedRMax
from sb3_combrel.zoo.registration import convert_fitted_rmax_params

CONFIGS = Path(__file__).resolve().parents[2] / "zoo_configs"
CAR, BIG_CAR = "combrel/MountainCar2D-v0", "combrel/MountainCar4D-v0"


def entries(algo):
    return yaml.safe_load((CONFIGS / f"{algo}.yml").read_text())


def box(n_variables):
    return Still(np.zeros(n_variables, dtype=np.float32), np.ones(n_variables, dtype=np.float32), ("left", "right"))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return str(SourceInstances.record(None, CAR, n_instances=50, seed=0).save(tmp_path_factory.mktemp("source") / "car.npz"))


OF_CARS = [(algo, env) for algo in ALGORITHMS for env in (CAR, BIG_CAR) if env in entries(algo)]


@pytest.mark.parametrize(("algo", "env"), OF_CARS)
def test_the_shipped_configurations_fit_their_tasks(algo, env, source):
    entry = {name: value for name, value in entries(algo)[env].items() if name != "n_timesteps"}
    for method, arguments in entry.get("transfer", {}).items():
        entry["transfer"] = {method: {**arguments, "source": source}}
    model = ZooFittedRMax(env=gym.make(env), seed=0, **entry).learn(5)
    assert [type(model.transfer).__name__] == [name.rpartition(".")[2] for name in entry.get("transfer", {"NoneType": {}})]


@pytest.mark.parametrize("algo", ["dqn", "qrdqn", "ppo"])
def test_other_algorithms_have_settings_for_every_task(algo):
    assert {CAR, BIG_CAR, "combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0"} <= set(entries(algo))


@pytest.mark.parametrize("algo", ["fitted_rmax", "timbrel", "combrel"])
def test_what_a_study_draws_replaces_what_the_configuration_says(algo, source):
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask()
    drawn = ALGORITHMS[algo](trial, 2, 1, {})
    assert drawn == convert_fitted_rmax_params(trial.params)
    of_combrel = {"source": source, "n_neighbors": 99, "use": "instances"}
    given = {f"sb3_combrel.{algo.upper()}": of_combrel if algo == "combrel" else {"source": source}}
    entry = {"policy": "FittedRMaxPolicy", **drawn, "transfer": None if algo == "fitted_rmax" else given, "resolution": 1}
    if algo == "timbrel":
        given["sb3_combrel.TIMBREL"]["mapping"] = "random"
    model, changed = ZooFittedRMax(env=gym.make(CAR), **entry), drawn.get("transfer_kwargs", {})
    assert len(changed) == {"fitted_rmax": 0, "timbrel": 1, "combrel": 6}[algo]
    assert {name: getattr(model.transfer, name) for name in changed} == changed
    assert model.agent.model_settings.model_breadth == trial.params["model_breadth"]


@pytest.mark.parametrize("given", [{}, {"use": "prior"}, {"mappings": "factored"}])
def test_a_study_leaves_a_prior_as_the_configuration_has_it(given, source):
    drawn = ALGORITHMS["combrel"](optuna.create_study().ask(), 2, 1, {})
    entry = {"policy": "FittedRMaxPolicy", **drawn, "transfer": {"sb3_combrel.COMBREL": {"source": source, **given}}}
    with pytest.warns(UserWarning, match='what is drawn for COMBREL, .*, is not used.*"use: instances"'):
        transfer = ZooFittedRMax(env=gym.make(CAR), **{**entry, "resolution": 1}).transfer
    assert transfer.use == "prior" and transfer.n_neighbors == 3


def test_a_drawn_grid_is_relative_to_the_one_that_suits_the_task_and_stays_within_memory():
    def resolution(n_variables, drawn, **arguments):
        return ZooFittedRMax("FittedRMaxPolicy", box(n_variables), resolution=drawn, **arguments).agent.grid.resolution

    drawn = [resolution(3, each, model_breadth=0.2) for each in (None, "coarser", "finer")]
    assert drawn == [(4,) * 3, (3,) * 3, (5,) * 3] and resolution(5, "finer") == resolution(5, None)


def with_combrel(**arguments):
    return {"transfer": {"sb3_combrel.COMBREL": arguments}}


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"policy": None}, '"policy"'),
        ({"breadth": 0.1}, "'breadth'"),
        ({"resolution": "fine"}, "resolution"),
        ({"bounds": [[-1.0], [1.0]]}, "bounds"),
        ({"transfer": {"sb3_combrel.NOBODY": {}}}, "sb3_combrel.NOBODY"),
        ({"transfer": {"sb3_combrel.COMBREL": None}}, "'source'"),
        (with_combrel(source=CAR, neighbours=3), "'neighbours'"),
        (with_combrel(source={"env": "Nowhere-v0"}), "Nowhere"),
        (with_combrel(source={"env": CAR, "steps": 3}), "steps"),
        ({"transfer_kwargs": {"n_neighbors": 5}}, "needs a transfer method"),
        ({**with_combrel(source=CAR), "transfer_kwargs": {"k": 5}}, "'k'"),
    ],
)
def test_an_entry_that_is_wrong_is_named(entry, message):
    with pytest.raises(ValueError, match=message):
        ZooFittedRMax(**{"policy": "FittedRMaxPolicy", "env": box(2), **entry})
