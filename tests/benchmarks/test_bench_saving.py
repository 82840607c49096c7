"""Saving and loading a model that has learned for 50,000 steps."""

import pytest

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import FittedRMax

SETTINGS = {
    "combrel/MountainCar2D-v0": {},
    "combrel/MountainCar4D-v0": dict(model_breadth=0.4, resolution=3, min_fraction=0.1),
}


@pytest.fixture(scope="module", params=SETTINGS)
def model(request):
    return FittedRMax(request.param, seed=0, **SETTINGS[request.param]).learn(50_000)


def test_saving(benchmark, model, tmp_path):
    benchmark(model.save, tmp_path / "model")


def test_loading(benchmark, model, tmp_path):
    model.save(tmp_path / "model")
    benchmark(FittedRMax.load, tmp_path / "model")
