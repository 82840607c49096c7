"""Transfer methods for the dashboard to show."""

import pytest
from helpers.dashboard import NamedWalk

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
