"""Whether COMBREL transfers instances or a prior where the arguments do not say: the target's model decides."""

import numpy as np
import pytest
from helpers.walk import Walk, same_parameters, small, walk_source

from sb3_combrel import COMBREL, FactoredMapping, FittedRMax

DECIDED = {0: ("instances", "injective"), 1: ("prior", "factored")}


def decision(transfer):
    return transfer.use, transfer.mappings


@pytest.mark.parametrize("degree", DECIDED)
def test_the_targets_model_decides(degree):
    given = COMBREL(walk_source())
    model = small(degree=degree, transfer=given)
    assert decision(model.policy.transfer) == DECIDED[degree]
    # What was given is a description, which serves models of the other degree as well.
    assert (given.arguments()["use"], given.arguments()["mappings"]) == (None, None)
    assert decision(small(degree=1 - degree, transfer=given).policy.transfer) == DECIDED[1 - degree]


@pytest.mark.parametrize("degree", DECIDED)
def test_the_decision_is_saved(degree, tmp_path):
    model = small(degree=degree, transfer=COMBREL(walk_source())).learn(20)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert decision(loaded.policy.transfer) == DECIDED[degree]
    arguments = loaded.policy.transfer.arguments()
    assert (arguments["use"], arguments["mappings"]) == DECIDED[degree]
    assert same_parameters(loaded, model)


OF_INSTANCES = [
    {"n_neighbors": 4},
    {"neighbors": "state_action"},
    {"choice": "drawn"},
    {"neighbor_radius": 0.3},
    {"measured": "first_episode"},
    {"min_compliance": 0.5},
    {"min_evidence": 0.0},
    {"breadth": 0.2},
    {"breadth_decay": 1.0},
    {"relevance": True},
    {"relevance_fraction": 0.3},
    {"bandwidths": (0.1, 0.1, 1.0)},
    {"bandwidths": np.array([0.1, 0.1, 1.0])},
]


@pytest.mark.parametrize("arguments", OF_INSTANCES, ids=str)
def test_arguments_of_instances_mean_instances(arguments):
    transfer = COMBREL(walk_source(), **arguments)
    assert decision(transfer) == DECIDED[0] == (transfer.arguments()["use"], transfer.arguments()["mappings"])


@pytest.mark.parametrize(
    "arguments", [{"max_transitions": 50}, {"transfer_terminals": False}, {"source_breadth": 0.2}, {"n_neighbors": 3}], ids=str
)
def test_arguments_of_both_and_defaults_leave_it_open(arguments):
    for degree, decided in DECIDED.items():
        assert decision(small(degree=degree, transfer=COMBREL(walk_source(), **arguments)).policy.transfer) == decided


@pytest.mark.parametrize(
    ("mappings", "use"),
    [
        ("injective", "instances"),
        ("signed_all", "instances"),
        ({"state": [0, 1], "action": [0, 1]}, "instances"),
        ("factored", "prior"),
        ("signed_factored", "prior"),
        (FactoredMapping([{"state": [0, 1], "action": [0, 1]}]), "prior"),
    ],
    ids=str,
)
def test_mappings_say_what_is_transferred(mappings, use):
    assert decision(COMBREL(walk_source(), mappings)) == (use, mappings)


def test_the_papers_settings():
    transfer = COMBREL.paper(walk_source())
    assert decision(transfer) == DECIDED[0]
    assert (transfer.measured, transfer.n_neighbors, transfer.breadth_decay) == ("first_episode", 3, 1.0)
    assert (transfer.min_compliance, transfer.min_evidence) == (0.0, 0.0)
    other = COMBREL.paper(walk_source(), "all", n_neighbors=5)
    assert (other.use, other.mappings, other.n_neighbors, other.measured) == ("instances", "all", 5, "first_episode")
