"""get_parameters and set_parameters, as SB3's own tests use them with every algorithm; wrong ones change nothing."""

import inspect
import io

import numpy as np
import pytest
import torch as th
from helpers.walk import METHODS, OBSERVATIONS, Walk, same_parameters, small
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy


def test_get_and_set_parameters_round_trip(make):
    """Random values of any kind must load without an error."""
    model, other = make().learn(60), make(seed=1).learn(30)
    parameters = model.get_parameters()
    assert list(parameters) == ["policy"]
    other.set_parameters(parameters, exact_match=True)
    assert same_parameters(model, other)
    th.manual_seed(0)
    randomized = {"policy": {k: th.rand_like(v) for k, v in parameters["policy"].items()}}
    assert all(v.dtype == th.float64 for v in parameters["policy"].values())
    model.set_parameters(randomized, exact_match=True)
    model.predict(OBSERVATIONS)
    model.learn(20)
    other.learn(20)


@pytest.fixture(scope="module")
def learned():
    return small(transfer=METHODS["COMBREL"]()).learn(60)


KINDS = [None, 7, True, [], {1: {}}, {"policy": 3}, {"policy": None}, {"stranger": {}}, {"policy": {"values": 3}}]


@pytest.mark.parametrize("exact_match", [True, False])
@pytest.mark.parametrize("wrong", KINDS)
def test_parameters_of_another_kind_are_refused_by_the_name_of_the_argument(learned, wrong, exact_match):
    with pytest.raises(ValueError, match="load_path_or_dict") as error:
        learned.set_parameters(wrong, exact_match=exact_match)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        *[("instances", lambda t: t[:, :-1]), ("instances", lambda t: t[0]), ("instances", lambda t: t * th.nan)],
        *[("values", lambda t: t[:-1]), ("values", lambda t: t.to(th.int64)), ("values", lambda t: t / 0.0)],
        *[("fitted_at", lambda t: t[1:]), ("lowest_value", lambda t: t[:0]), ("rewards", lambda t: th.zeros(4))],
        *[
            ("scales", lambda t: t[1:]),
            ("n_added", lambda t: t[:0]),
            ("transfer_instances_used", lambda t: None),
            ("stranger", lambda t: th.zeros(3)),
        ],
    ],
)
def test_parameters_that_do_not_fit_are_refused_by_name_and_change_nothing(learned, name, spoil):
    """``None``: left out."""
    before = learned.get_parameters()["policy"]
    spoilt = spoil(before.get(name))
    damaged = {**before, name: spoilt} if spoilt is not None else {k: v for k, v in before.items() if k != name}
    # As PyTorch raises, and as this package does.
    for kind in (RuntimeError, ValueError):
        with pytest.raises(kind, match=name) as error:
            learned.set_parameters({"policy": damaged})
        assert "\n" not in str(error.value)
    after = learned.get_parameters()["policy"]
    assert all(th.equal(after[key], before[key]) for key in before)


def test_exact_match_is_true_or_false(learned):
    with pytest.raises(ValueError, match="exact_match must be True or False, got"):
        learned.set_parameters(learned.get_parameters(), exact_match="yes")


def test_parameters_come_from_a_file_too_and_a_file_that_is_none_is_named(learned, tmp_path):
    learned.save(tmp_path / "model")
    for given in (tmp_path / "model", str(tmp_path / "model.zip"), io.BytesIO((tmp_path / "model.zip").read_bytes())):
        model = small(transfer=METHODS["COMBREL"]())
        model.set_parameters(given)
        assert same_parameters(model, learned)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        learned.set_parameters(tmp_path / "nowhere")
    (tmp_path / "text.zip").write_text("no archive")
    with pytest.raises(ValueError, match=r"text\.zip is not the file of a model"):
        learned.set_parameters(tmp_path / "text.zip")


def test_without_exact_match_what_is_not_given_stays_and_what_is_unknown_is_ignored(learned):
    model = small(transfer=METHODS["COMBREL"]()).learn(30)
    before, values = model.get_parameters()["policy"], learned.get_parameters()["policy"]["values"]
    model.set_parameters({"policy": {"values": values, "stranger": th.zeros(3)}}, exact_match=False)
    after = model.get_parameters()["policy"]
    assert th.equal(after["values"], values)
    assert all(th.equal(after[name], before[name]) for name in before if name != "values")
    model.set_parameters({}, exact_match=False)
    assert all(th.equal(model.get_parameters()["policy"][name], after[name]) for name in after)


# Making a model and running it, as people who know SB3 type it.
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
    assert isinstance(model.policy, FittedRMaxPolicy) and model.n_envs == 1
    model.learn(10)


def test_learning_counts_steps_and_episodes(make):
    model = make().learn(70)
    assert model.num_timesteps == model.agent.model.n_instances == 70 and model._episode_num >= 2
    model.learn(30, reset_num_timesteps=False)
    assert model.num_timesteps == model.agent.model.n_instances == 100
    model.learn(30)
    assert model.num_timesteps == 30, "steps are counted from 0 again"
    assert model.agent.model.n_instances == 130, "what was learned is kept"
    assert model.learn(1e1).num_timesteps == 10, "as it is often written"


def test_no_steps_are_learned_at_once_as_the_rest_of_a_run_that_is_complete():
    model = small().learn(60)
    learned = {name: tensor.clone() for name, tensor in model.get_parameters()["policy"].items()}
    assert model.learn(60 - model.num_timesteps, reset_num_timesteps=False) is model and model.num_timesteps == 60
    assert all(th.equal(learned[name], tensor) for name, tensor in model.get_parameters()["policy"].items())
    assert small().learn(0).num_timesteps == 0


@pytest.mark.parametrize(("name", "value"), [("gamma", 0.5), ("max_value", 3.0), ("bounds", ([0.0, 0.0], [9.0, 9.0]))])
def test_an_argument_that_is_changed_afterwards_is_refused_and_a_saved_model_follows(name, value, tmp_path):
    model = small().learn(30)
    before = getattr(model, name)
    setattr(model, name, value)
    with pytest.raises(ValueError, match=f"{name} must be what the model was made with, .* got .*load\\(path, {name}="):
        model.learn(10)
    setattr(model, name, before)
    model.learn(10).save(tmp_path / "model")
    assert repr(getattr(FittedRMax.load(tmp_path / "model", **{name: value}).agent.settings, name)) == repr(value)
    FittedRMax.load(tmp_path / "model", env=Walk(), **{name: value}).learn(10)


@pytest.mark.parametrize(
    ("name", "given", "alike"),
    [
        ("gamma", 1.0, 1),
        ("max_value", 3.0, np.float64(3.0)),
        ("resolution", [4, 4], (4, 4)),
        ("bounds", ([-9.0, -9.0], [9.0, 9.0]), (np.full(2, -9.0), np.full(2, 9.0))),
    ],
)
def test_an_argument_that_is_written_in_another_way_is_not_changed(name, given, alike):
    model = small(**{name: given}).learn(10)
    setattr(model, name, alike)
    assert model.learn(10).num_timesteps == 10
    setattr(model, name, object())
    with pytest.raises(ValueError, match=f"{name} must be what the model was made with"):
        model.learn(10)


@pytest.mark.parametrize("made_with", [None, METHODS["COMBREL"]()], ids=["none", "COMBREL"])
def test_a_transfer_method_that_is_changed_afterwards_is_refused_and_a_new_model_follows(made_with):
    model = small(transfer=made_with).learn(30)
    before, model.transfer = model.transfer, METHODS["TIMBREL"]()
    with pytest.raises(ValueError, match=r"transfer must be what the model was made with, .*, got TIMBREL\(.*instances=model"):
        model.learn(10)
    assert len(small(transfer=model.transfer, instances=model).learn(10).source_instances()) == 40
    model.transfer = before
    assert model.learn(10).num_timesteps == 10
