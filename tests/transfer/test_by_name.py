"""Transfer methods by their names, as YAML files, RL-Zoo's hyperparameters and saved models give them."""

import importlib

import numpy as np
import pytest
from helpers import factored as f
from helpers.own_method import Mine
from helpers.walk import Walk, small, walk_source

import sb3_combrel
from sb3_combrel import COMBREL, TIMBREL, FactoredMapping
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import describe_transfer, make_transfer, restore_transfer
from sb3_combrel.zoo.algorithm import ZooFittedRMax

SOURCE = f.oscillator_source(60)
TWO = f.copies_mapping(2)


@pytest.fixture
def path(tmp_path):
    return str(walk_source().save(tmp_path / "source.npz"))


def test_a_dict_names_the_class_with_its_package_its_module_or_alone(path):
    arguments = {"mappings": "surjective", "n_random_steps": 7}
    for written in ("MASTER", "sb3_combrel.MASTER", f"{sb3_combrel.MASTER.__module__}.MASTER"):
        made = make_transfer({written: {"source": path, **arguments}})
        assert type(made) is sb3_combrel.MASTER
        assert {name: getattr(made, name) for name in arguments} == arguments


@pytest.mark.parametrize("written", ["helpers.own_method.Mine", "helpers.own_method:Mine"])
def test_a_method_of_ones_own_is_imported_from_where_the_name_says(written):
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


def test_a_hyperparameter_of_rl_zoo_reaches_the_method(path):
    given = {"sb3_combrel.SampleTransfer": {"source": path}}
    model = ZooFittedRMax("FittedRMaxPolicy", Walk(), {"n_instances": 44}, transfer=given)
    assert type(model.policy.transfer) is sb3_combrel.SampleTransfer and model.policy.transfer.n_instances == 44


def test_dicts_as_in_a_yaml_file_make_the_same(tmp_path):
    path = str(SOURCE.save(tmp_path / "source.npz"))
    copies = [{"state": list(each.state), "action": list(each.action)} for each in TWO.copies]
    given = make_transfer({"TIMBREL": {"source": path, "mapping": {"copies": copies}, "use": "prior"}})
    direct = TIMBREL(SOURCE, TWO, use="prior")
    states, actions = np.full((5, 4), 0.4), np.arange(5)
    predictions = [f.bound(each).prior(states, actions) for each in (given, direct)]
    assert all(np.array_equal(one, other) for one, other in zip(*predictions, strict=True))
    model = small(transfer={"TIMBREL": {"source": walk_source(), "mapping": {"state": [0, 1], "action": [0, 1]}}})
    assert type(model.policy.transfer) is TIMBREL


@pytest.mark.parametrize(
    "make",
    [
        lambda: TIMBREL(SOURCE, TWO, use="prior", source_breadth=0.3),
        lambda: COMBREL(SOURCE, "signed_factored", use="prior", max_transitions=50),
        lambda: COMBREL(SOURCE, FactoredMapping([TWO.copies[1]]), use="prior"),
    ],
)
def test_a_description_makes_the_same_object_again(make):
    ours = f.bound(make())
    theirs = restore_transfer(describe_transfer(ours))
    plain = describe_transfer(theirs)
    assert plain == describe_transfer(make())
    assert type(theirs) is type(ours) and f.bound(theirs).describe_prior() == ours.describe_prior()
