"""The examples in the docstrings of what users import run as they are written, but for shorter."""

import inspect
import re
import shutil
import textwrap

import gymnasium
import numpy as np
import pytest
from helpers.walk import small, walk_source

import combrel_envs  # noqa: F401 - registers the environments
import sb3_combrel

SHORT_CAR = "ShortMountainCar4D-v0"
# Worker processes, and what is fitted by gradient descent.
TAKE_LONG = {"compare", "SoftHomomorphism", "SparseCodingMapping", "ThreeWayRBM"}


def examples_of(docstring):
    """The indented blocks after a line that ends in two colons."""
    blocks = re.findall(r"::\n\n((?:(?:    .*)?\n)+)", inspect.cleandoc(docstring) + "\n")
    return [textwrap.dedent(block) for block in blocks]


@pytest.fixture(autouse=True)
def short_task():
    gymnasium.register(SHORT_CAR, gymnasium.spec("combrel/MountainCar4D-v0").entry_point, max_episode_steps=20)
    yield
    del gymnasium.registry[SHORT_CAR]


def test_examples_are_found():
    assert examples_of("Text::\n\n    a = 1\n\n    b = 2\n\nMore.") == ["a = 1\n\nb = 2\n\n"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Source instances, and the file of a model."""
    path = tmp_path_factory.mktemp("models") / "car.zip"
    small(transfer=sb3_combrel.COMBREL(walk_source())).learn(10).save(path)
    return sb3_combrel.SourceInstances.record(None, "combrel/MountainCar2D-v0", n_instances=100, seed=0), path


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.long] * (n in TAKE_LONG)) for n in sb3_combrel.__all__ if not n.startswith("__")],
)
def test_whatever_is_exported_has_an_example_that_runs(name, made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = examples_of(getattr(sb3_combrel, name).__doc__)
    assert found, f"{name} has no example"
    source, model = made
    shutil.copy(model, "car.zip")
    names = {each: getattr(sb3_combrel, each) for each in sb3_combrel.__all__}
    for example in found:
        short = re.sub(r"steps=[\d_]+", "steps=20", example).replace("seeds=10", "seeds=2")
        short = short.replace("combrel/MountainCar4D-v0", SHORT_CAR)
        exec(compile(short, name, "exec"), names | {"sb3_combrel": sb3_combrel, "source": source, "np": np})
    written = {path.name for path in tmp_path.iterdir()}
    expected = {"compare": "curves.png", "explain": "explained", "SourceInstances": "source.npz"}
    assert expected.get(name, "car.zip") in written
