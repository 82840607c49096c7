"""Transfer methods for the dashboard to show, pictures that cost nothing, and time that passes as a test says."""

import time

import numpy as np
import pytest
from helpers.dashboard import NamedWalk, walker

from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping, SourceInstances


@pytest.fixture(scope="session")
def transfers():
    """One of each kind by name, and None for "none"."""
    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    return {
        "none": None,
        "TIMBREL": TIMBREL(source, InterTaskMapping((0, 1), (0, 1))),
        "random": TIMBREL(source, "random"),
        "pool": TIMBREL(source, "pool"),
        "COMBREL": COMBREL(source, use="instances"),
    }


@pytest.fixture(scope="session")
def learnt(transfers):
    """A model that has learned with COMBREL, to look at."""
    return walker(transfer=transfers["COMBREL"]).learn(120)


@pytest.fixture
def drawn():
    """For a test that looks at pictures."""


@pytest.fixture(autouse=True)
def blank_pictures(request, monkeypatch):
    """Most of the time of a picture is spent on drawing what was read from the agent."""
    if "drawn" not in request.fixturenames:
        blank = np.zeros((20, 640, 3), dtype=np.uint8)
        monkeypatch.setattr("sb3_combrel.tensorboard.pictures._pixels", lambda figure, dpi: blank)
        monkeypatch.setattr("sb3_combrel.pages.page.data_address", lambda figure: "data:,")


@pytest.fixture
def clock(monkeypatch):
    """Seconds, as a list of one: a step of the walk takes a millisecond, all else what the test adds."""
    seconds, step = [0.0], NamedWalk.step

    def slow_step(self, action):
        seconds[0] += 0.001
        return step(self, action)

    monkeypatch.setattr(time, "perf_counter", lambda: seconds[0])
    monkeypatch.setattr(NamedWalk, "step", slow_step)
    return seconds
