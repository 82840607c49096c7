"""What users write: methods and mappings by name, and whether instances or a prior are transferred where nothing says so."""

import importlib

import numpy as np
import pytest
from helpers import factored as f
from helpers.dashboard import NamedWalk
from helpers.own_method import Mine
from helpers.walk import Walk, same_parameters, small, walk_source

import sb3_combrel
from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import make_transfer

SOURCE = f.oscillator_source(60)


@pytest.fixture
def path(tmp_path):
    return str(walk_source().save(tmp_path / "source.npz"))


def test_a_dict_names_the_class_with_its_package_its_module_or_alone(path):
    arguments = {"mappings": "surjective", "n_random_steps": 7}
    for written in ("MASTER", "sb3_combrel.MASTER", f"{sb3_combrel.MASTER.__module__}.MASTER"):
        made = make_transfer({written: {"source": path, **arguments}})
        assert type(made) is sb3_combrel.MASTER
        assert {name: getattr(made, name) for name in arguments} == arguments


def test_a_method_of_ones_own_is_imported_from_where_the_name_says():
    for written in ("helpers.own_method.Mine", "helpers.own_method:Mine"):
        made = make_transfer({written: {"reward": -3.0}})
        assert type(made) is Mine and made.reward == -3.0
    assert type(make_transfer(Mine)) is Mine


def test_methods_of_the_package_are_known_without_importing_it(monkeypatch, path):
    """The package imports this module: the other way round would be an arrow up."""
    monkeypatch.setattr(importlib, "import_module", None)
    assert type(make_transfer({"sb3_combrel.COMBREL": {"source": path}})) is COMBREL
    assert type(make_transfer({"TIMBREL": {"source": path}})) is TIMBREL


def test_a_name_that_is_wrong_is_refused_with_those_that_are_known():
    public = [each for each in sb3_combrel.__all__ if isinstance(getattr(sb3_combrel, each), type)]
    methods = [each for each in public if issubclass(getattr(sb3_combrel, each), Transfer)]
    for wrong in ("MASTERR", "nowhere.COMBREL", "sb3_combrel.COMBRELL", ""):
        with pytest.raises(ValueError, match=f"{wrong!r}, which does not exist; known are") as error:
            make_transfer({wrong: {}})
        assert str(error.value).endswith(", ".join(f"sb3_combrel.{each}" for each in sorted(methods)))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"COMBREL": {}, "TIMBREL": {}}, "one entry, .* got .'COMBREL', 'TIMBREL'"),
        ({}, "one entry"),
        ({"sb3_combrel.FittedRMax": {}}, "must be a transfer method"),
        ({"COMBREL": {"source": SOURCE, "n_neighbors": 0}}, "n_neighbors must be .*0"),
        (7, "transfer must be .*7"),
    ],
    ids=str,
)
def test_whatever_names_no_method_is_refused(given, says):
    with pytest.raises(ValueError, match=says):
        make_transfer(given)


BY_NUMBER = InterTaskMapping((0, 1), (0, 1))
BY_NAME = InterTaskMapping({"place": "place", "height": "height"}, {"back": "back", "forth": "forth"})
AS_DICT = {"state": {"place": "place", "height": "height"}, "action": {"back": "back", "forth": "forth"}}


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)


@pytest.mark.parametrize("method", [TIMBREL, COMBREL])
def test_by_name_and_by_number_are_the_same(method, source, tmp_path):
    transfers = [method(source, FactoredMapping([mapping]), use="prior") for mapping in (BY_NAME, BY_NUMBER)]
    ours, theirs = (small(NamedWalk(), transfer=each).learn(40) for each in transfers)
    assert same_parameters(ours, theirs)
    ours.save(tmp_path / "model")
    # Names of the target are not needed any more.
    assert same_parameters(ours, FittedRMax.load(tmp_path / "model", custom_objects={"_names": {}}))


@pytest.mark.parametrize("mapping", [AS_DICT, {"copies": [AS_DICT]}], ids=["mapping", "factored mapping"])
def test_a_dict_as_in_a_yaml_file_may_have_names(mapping, source):
    use = "prior" if "copies" in mapping else "instances"
    model = small(NamedWalk(), transfer={"sb3_combrel.TIMBREL": {"source": source, "mapping": mapping, "use": use}})
    assert model.transfer.mapping in (BY_NUMBER, FactoredMapping([BY_NUMBER]))


def test_a_target_without_names_is_named_in_the_error(source):
    with pytest.raises(
        ValueError, match="names of the target's variables, s0, s1, got 'place'; a task that names none has s0"
    ):
        small(transfer=TIMBREL(source, BY_NAME))
    given = small(
        transfer=TIMBREL(source, BY_NAME), policy_kwargs=dict(state_names=["place", "height"], action_names=["back", "forth"])
    )
    assert given.transfer.mapping == BY_NUMBER


DECIDED = {0: ("instances", "injective"), 1: ("prior", "factored")}


def decision(transfer):
    return transfer.use, transfer.mappings


@pytest.mark.parametrize("degree", DECIDED)
def test_the_targets_model_decides_and_the_decision_is_saved(degree, tmp_path):
    given = COMBREL(walk_source())
    model = small(degree=degree, transfer=given).learn(20)
    assert decision(model.policy.transfer) == DECIDED[degree]
    # What was given is a description, which serves models of the other degree as well.
    assert (given.arguments()["use"], given.arguments()["mappings"]) == (None, None)
    assert decision(small(degree=1 - degree, transfer=given).policy.transfer) == DECIDED[1 - degree]
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert decision(loaded.policy.transfer) == DECIDED[degree]
    arguments = loaded.policy.transfer.arguments()
    assert (arguments["use"], arguments["mappings"]) == DECIDED[degree]
    assert same_parameters(loaded, model)


OF_INSTANCES = {
    "n_neighbors": 4,
    "neighbors": "state_action",
    "choice": "drawn",
    "neighbor_radius": 0.3,
    "measured": "first_episode",
    "min_compliance": 0.5,
    "min_evidence": 0.0,
    "breadth": 0.2,
    "breadth_decay": 1.0,
    "relevance": True,
    "relevance_fraction": 0.3,
    "bandwidths": np.array([0.1, 0.1, 1.0]),
}


@pytest.mark.parametrize("name", OF_INSTANCES)
def test_arguments_of_instances_mean_instances(name):
    transfer = COMBREL(walk_source(), **{name: OF_INSTANCES[name]})
    assert decision(transfer) == DECIDED[0] == (transfer.arguments()["use"], transfer.arguments()["mappings"])


def test_arguments_of_both_and_defaults_leave_it_open():
    given = dict(max_transitions=50, transfer_terminals=False, source_breadth=0.2, n_neighbors=3)
    for degree, decided in DECIDED.items():
        assert decision(small(degree=degree, transfer=COMBREL(walk_source(), **given)).policy.transfer) == decided


@pytest.mark.parametrize(
    ("mappings", "use"),
    [
        *[("injective", "instances"), ("signed_all", "instances"), ({"state": [0, 1], "action": [0, 1]}, "instances")],
        *[("factored", "prior"), ("signed_factored", "prior")],
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
