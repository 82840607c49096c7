"""Every test that takes ``make`` runs without transfer, with TIMBREL and with COMBREL."""

import pytest
from helpers.walk import METHODS, small


@pytest.fixture(params=METHODS)
def method(request):
    """The name of a method."""
    return request.param


@pytest.fixture
def make(method):
    """Makes a model for the walk, or for the environment given."""

    def make(env=None, **kwargs):
        return small(env, **{"transfer": METHODS[method]()} | kwargs)

    return make
