"""Transfer methods of the literature by their names, as YAML files and RL-Zoo's hyperparameters give them."""

import pytest
from helpers.walk import Walk, small, walk_source

import sb3_combrel
from sb3_combrel.zoo.algorithm import ZooFittedRMax

#: By name: the module, arguments of a dict, and a hyperparameter of RL-Zoo.
METHODS = {
    "MASTER": ("master", {"mappings": "surjective", "n_random_steps": 7}, {"n_random_steps": 4}),
    "MappingExperts": ("experts", {"mappings": "surjective", "max_experts": 3}, {"max_experts": 4}),
    "SampleTransfer": ("sample_transfer", {"relevance": "near"}, {"n_instances": 44}),
}


@pytest.fixture
def path(tmp_path):
    return str(walk_source().save(tmp_path / "source.npz"))


def check(transfer, kind, arguments):
    assert type(transfer) is kind
    assert {name: getattr(transfer, name) for name in arguments} == arguments


@pytest.mark.parametrize("name", METHODS)
def test_a_dict_names_the_class_with_its_package_its_module_or_alone(name, path):
    module, arguments, _ = METHODS[name]
    for written in (name, f"sb3_combrel.{name}", f"sb3_combrel.transfer.methods.{module}.{name}"):
        model = small(transfer={written: {"source": path, **arguments}})
        check(model.policy.transfer, getattr(sb3_combrel, name), arguments)


@pytest.mark.parametrize("name", METHODS)
def test_a_hyperparameter_of_rl_zoo_reaches_the_method(name, path):
    *_, arguments = METHODS[name]
    model = ZooFittedRMax("FittedRMaxPolicy", Walk(), arguments, transfer={f"sb3_combrel.{name}": {"source": path}})
    check(model.policy.transfer, getattr(sb3_combrel, name), arguments)


def test_a_name_that_is_wrong_is_refused_with_those_that_are_known(path):
    with pytest.raises(ValueError, match=r"known are .*sb3_combrel\.MASTER, "):
        small(transfer={"MASTERR": {"source": path}})
