"""Every test that takes ``make`` runs without transfer, with TIMBREL and with COMBREL, and twice with the kernel average."""

import pytest
from helpers.walk import METHODS, small

CASES = {**{name: (name, 1) for name in METHODS}, "none, degree 0": ("none", 0), "COMBREL, degree 0": ("COMBREL", 0)}


@pytest.fixture(params=CASES)
def case(request):
    """The name of a method, and the degree of the local model."""
    return CASES[request.param]


@pytest.fixture
def method(case):
    """The name of a method."""
    return case[0]


@pytest.fixture
def degree(case):
    """The degree of the local model."""
    return case[1]


@pytest.fixture
def make(method, degree):
    """Makes a model for the walk, or for the environment given."""

    def make(env=None, **kwargs):
        return small(env, **{"transfer": METHODS[method](), "degree": degree} | kwargs)

    return make
