"""A comparison and models for pages to show."""

import warnings

import numpy as np
import pytest
from helpers.dashboard import NamedWalk, walker

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.comparison.compare import compare


class MovingWalk(NamedWalk):
    """The walk with a variable and its velocity, which comes first, and names with HTML in them."""

    state_names = ("vplace", "place")
    action_names = ("<b>back</b>", "forth & on")

    def observe(self):
        return np.array([self.at, 1.0 + 0.5 * np.sin(5 * self.at)], dtype=np.float32)


@pytest.fixture(scope="session")
def source():
    return SourceInstances.record(None, MovingWalk(), n_instances=150, seed=0)


@pytest.fixture(scope="session")
def models(source, tmp_path_factory):
    """Files of models by kind: with a source as prior, with its instances, and without transfer."""
    folder = tmp_path_factory.mktemp("models")
    transfers = {"prior": COMBREL(source), "instances": COMBREL(source, use="instances"), "none": None}
    for kind, transfer in transfers.items():
        walker(transfer=transfer, env=MovingWalk()).learn(400).save(folder / f"{kind}.zip")
    return {kind: folder / f"{kind}.zip" for kind in transfers}


@pytest.fixture(scope="session")
def comparison(source):
    """Of two seeds, with a control."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        methods = {"none": None, "<i>COMBREL</i>": COMBREL(source)}
        return compare(MovingWalk, methods, seeds=2, steps=250, model_breadth=0.15, resolution=3)


@pytest.fixture
def undrawn(monkeypatch):
    """Pages without pictures, for tests that look at their text."""
    monkeypatch.setattr("sb3_combrel.pages.page.data_address", lambda figure: "data:,")


@pytest.fixture(scope="session")
def prior_model(models):
    return FittedRMax.load(models["prior"])
