"""Names that have moved: the old ones still work, give the same objects, and warn."""

import importlib
import subprocess
import sys
from operator import attrgetter

import pytest

from sb3_combrel import FittedRMax
from sb3_combrel._moved import MOVED
from sb3_combrel.fitted_rmax.policies import MOVED_TO_AGENT


@pytest.mark.parametrize(
    ("old", "name", "new"),
    [
        ("transfer.recording", "SourceRecorder", "sources.source_recorder"),
        ("transfer.q_learning", "QLearning", "sources.q_learning"),
        ("transfer.q_learning", "TileCoding", "sources.q_learning"),
        ("transfer.source", "SourceInstances", "sources.source_instances"),
        ("transfer.inter_task_mapping", "InterTaskMapping", "mappings.inter_task_mapping"),
        ("transfer.mapping_set", "MappingSet", "mappings.mapping_set"),
        ("transfer.combrel", "COMBREL", "transfer.methods.combrel"),
        ("transfer.timbrel", "TIMBREL", "transfer.methods.timbrel"),
        *[
            ("transfer.mappings", name, "mappings")
            for name in (
                "UNMAPPED",
                "ActionMappings",
                "AllActionMappings",
                "BalancedActionMappings",
                "Candidates",
                "InterTaskMapping",
                "MappingNames",
                "MappingSet",
                "resolve",
            )
        ],
    ],
)
def test_an_old_name_gives_the_object_of_the_new_one_and_warns(old, name, new):
    moved = importlib.import_module(f"sb3_combrel.{old}")
    with pytest.warns(DeprecationWarning, match=rf"sb3_combrel\.{old} has moved to sb3_combrel\.{new}"):
        found = getattr(moved, name)
    assert found is getattr(importlib.import_module(f"sb3_combrel.{new}"), name)


@pytest.mark.parametrize("old", MOVED)
def test_an_old_module_is_found_as_an_attribute_of_its_package(old):
    module = importlib.import_module(f"sb3_combrel.{old}")
    package, _, name = old.rpartition(".")
    assert getattr(importlib.import_module(f"sb3_combrel.{package}"), name) is module
    with pytest.warns(DeprecationWarning, match="has moved to"), pytest.raises(AttributeError):
        _ = module.nothing_of_that_name


def test_importing_the_package_does_not_warn():
    subprocess.run([sys.executable, "-W", "error::DeprecationWarning:sb3_combrel", "-c", "import sb3_combrel"], check=True)


@pytest.mark.parametrize("name", sorted(MOVED_TO_AGENT))
def test_what_was_the_policys_is_found_in_its_agent(name):
    policy = FittedRMax("MountainCar-v0", seed=0).policy
    with pytest.warns(DeprecationWarning, match=rf"policy\.{name} has moved to policy\.agent\."):
        found = getattr(policy, name)
    expected = attrgetter(MOVED_TO_AGENT[name])(policy.agent)
    assert found is expected or found == expected


def test_what_a_policy_never_had_is_not_there():
    with pytest.raises(AttributeError, match="nothing"):
        _ = FittedRMax("MountainCar-v0", seed=0).policy.nothing
