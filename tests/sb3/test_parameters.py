"""get_parameters and set_parameters, as SB3's own tests use them with every algorithm."""

import numpy as np
import pytest
import torch as th
from helpers.walk import OBSERVATIONS, same_parameters

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
    other.set_parameters(parameters, exact_match=True)
    other.learn(20)
    with pytest.raises(ValueError):
        model.set_parameters({"policy": parameters["policy"], "stranger": {}}, exact_match=True)


def test_get_parameters_returns_copies(make):
    model = make().learn(30)
    for array in model.get_parameters()["policy"].values():
        array.fill_(-77.0)
    for array in model.get_parameters()["policy"].values():
        assert not (array == -77.0).any()


def test_parameters_contain_what_was_learned(make):
    model, fresh = make().learn(300), make(seed=7)
    before, _ = fresh.predict(OBSERVATIONS, deterministic=True)
    fresh.set_parameters(model.get_parameters())
    learned, _ = model.predict(OBSERVATIONS, deterministic=True)
    np.testing.assert_array_equal(fresh.predict(OBSERVATIONS, deterministic=True)[0], learned)
    assert (learned != before).any()


def test_a_policy_can_be_saved_and_loaded_by_itself(make, tmp_path):
    model = make().learn(100)
    model.policy.save(tmp_path / "policy.pth")
    policy = FittedRMaxPolicy.load(tmp_path / "policy.pth")
    np.testing.assert_array_equal(
        policy.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )
