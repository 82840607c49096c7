"""Every test that takes ``make`` runs without transfer and with COMBREL, and with TIMBREL and the kernel average."""

import pytest
from helpers.walk import METHODS, small

CASES = {"none": ("none", 1), "COMBREL": ("COMBREL", 1), "TIMBREL, degree 0": ("TIMBREL", 0)}


@pytest.fixture(params=CASES)
def case(request):
    """The name of a method, and the degree of the local model."""
    return CASES[request.param]


@pytest.fixture
def method(case):
    """The name of a method."""
    return case[0]


@pytest.fixture
def make(case):
    """Makes a model for the walk, or for the environment given."""
    method, degree = case

    def make(env=None, **kwargs):
        return small(env, **{"transfer": METHODS[method](), "degree": degree} | kwargs)

    return make
