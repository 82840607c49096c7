"""Models saved by version 0.1.0, whose transfer methods had other names for some arguments, load and learn on."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
from helpers.walk import METHODS, OBSERVATIONS, Walk, small
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_combrel import COMBREL, TIMBREL, FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.transfer.instances.instances_check import InstancesCheck

DATA = Path(__file__).parents[1] / "data"
# Of these predictions no trace is left any more, so that the counts are lower.
COUNTS = ("transfer_uses", "transfer_instances_used")
# What version 0.1.0 did not have.
ADDED = ("visits", "transfer_check", "transfer_errors")
NEW = {*COUNTS, *ADDED}


@pytest.fixture(params=["timbrel", "combrel"])
def former(request):
    """A file, and what version 0.1.0 made of it."""
    with np.load(DATA / f"model_of_version_0_1_0_{request.param}.npz") as arrays:
        return DATA / f"model_of_version_0_1_0_{request.param}.zip", dict(arrays)


@pytest.mark.filterwarnings("error::DeprecationWarning", "error::UserWarning")
def test_a_file_of_version_0_1_0_loads_with_all_that_was_learned(former):
    path, expected = former
    model = FittedRMax.load(path)
    assert model.degree == model.agent.settings.degree == 0
    assert type(model.agent.model) is KernelAverage
    parameters = model.get_parameters()["policy"]
    assert not parameters["visits"].any()
    saved = {name.removeprefix("parameter_"): array for name, array in expected.items() if name.startswith("parameter_")}
    assert parameters.keys() == saved.keys() | NEW
    for name, array in saved.items():
        # Weights and the like are computed again, by whatever compiler there is.
        np.testing.assert_allclose(parameters[name].numpy(), array, rtol=1e-12, atol=1e-12, err_msg=name)


def test_arguments_of_version_0_1_0_have_their_new_names():
    timbrel = FittedRMax.load(DATA / "model_of_version_0_1_0_timbrel.zip").policy.transfer
    assert (type(timbrel), timbrel.mapping) == (TIMBREL, "pool")
    assert (timbrel.breadth_decay, timbrel.transfer_terminals) == (0.9, False)
    combrel = FittedRMax.load(DATA / "model_of_version_0_1_0_combrel.zip").policy.transfer
    assert (type(combrel), combrel.choice, combrel.neighbor_radius) == (COMBREL, "drawn", 0.5)
    assert (combrel.breadth_decay, combrel.transfer_terminals) == (0.7, False)


def test_a_model_of_version_0_1_0_predicts_as_it_did(former):
    path, expected = former
    model = FittedRMax.load(path)
    observations = np.column_stack([np.linspace(-1, 1, 41), np.ones(41)]).astype(np.float32)
    q_values = np.array([model.agent.q_values(model.policy.to_unit(observation)) for observation in observations])
    np.testing.assert_allclose(q_values, expected["q_values"], rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], expected["actions"])


def test_a_model_of_version_0_1_0_learns_on_as_it_did(former, monkeypatch):
    path, expected = former
    # Then every time limit narrowed the kernel of transferred instances.
    monkeypatch.setattr(InstancesCheck, "end_episode", lambda self, truncated: truncated)
    model = FittedRMax.load(path, env=Walk())
    model.get_env().seed(5)
    model.learn(120, reset_num_timesteps=False)
    instances = model.get_parameters()["policy"]["instances"].numpy()
    np.testing.assert_allclose(instances, expected["instances_after"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(model.agent.planner.values, expected["values_after"], rtol=1e-9, atol=1e-9)


@pytest.mark.filterwarnings("error::DeprecationWarning", "error::UserWarning")
@pytest.mark.parametrize("exact_match", [True, False])
def test_parameters_of_a_file_of_version_0_1_0_can_be_set(former, exact_match):
    path, _ = former
    loaded, model = FittedRMax.load(path), FittedRMax.load(path, env=Walk()).learn(90)
    before = {name: model.get_parameters()["policy"][name].clone() for name in ADDED}
    model.set_parameters(path, exact_match=exact_match)
    found, expected = (each.get_parameters()["policy"] for each in (model, loaded))
    # Without exact_match what is not given stays as it is.
    if not exact_match:
        expected |= before
        expected |= {name: found[name] for name in COUNTS if name not in parameters_of(path)}
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        np.testing.assert_array_equal(found[name], tensor, err_msg=name)


def parameters_of(path):
    """The parameters that a file has."""
    return load_from_zip_file(path, load_data=False)[1]["policy"]


@pytest.mark.parametrize("exact_match", [True, False])
def test_a_local_linear_model_refuses_the_parameters_of_a_kernel_average(former, exact_match):
    """With and without exact_match: the grids differ; and with exact_match it is said which parameters are missing."""
    path, _ = former
    model = FittedRMax(Walk(), transfer=FittedRMax.load(path).policy.transfer, seed=0).learn(60)
    before = model.get_parameters()["policy"]
    with pytest.raises(ValueError, match="reach" if exact_match else "must have shape"):
        model.set_parameters(path, exact_match=exact_match)
    after = model.get_parameters()["policy"]
    assert all(np.array_equal(after[name], before[name]) for name in before)


def test_visits_are_missed_in_what_version_0_1_0_cannot_have_written():
    model = small().learn(30)
    parameters = model.get_parameters()["policy"]
    del parameters["visits"]
    with pytest.raises(ValueError, match="visits"):
        model.set_parameters({"policy": parameters})


@pytest.mark.parametrize("name", METHODS)
def test_a_policy_saved_by_itself_by_version_0_1_0_loads_as_a_kernel_average(name, tmp_path):
    """A policy of today, its file rewritten as version 0.1.0 would have written it."""
    model = small(transfer=METHODS[name](), degree=0).learn(10**6, callback=StopTrainingOnMaxEpisodes(3))
    model.policy.save(tmp_path / "policy.pth")
    saved = th.load(tmp_path / "policy.pth", weights_only=False)
    for new in ("degree", "n_neighbors", "outcome_breadth", "periodic"):
        del saved["data"][new]
    # The default of that version.
    saved["data"]["min_weight"] = 0.01
    del saved["state_dict"]["visits"]
    th.save(saved, tmp_path / "former.pth")
    policy = FittedRMaxPolicy.load(tmp_path / "former.pth")
    assert type(policy.agent.model) is KernelAverage
    for each in OBSERVATIONS:
        unit = policy.to_unit(each)
        np.testing.assert_array_equal(policy.agent.q_values(unit), model.agent.q_values(unit))


@pytest.mark.parametrize("name", METHODS)
def test_the_generators_state_under_its_former_name_is_used(name, tmp_path):
    """A model of today, its file rewritten as version 0.1.0 would have named the entry, learns on as it does."""
    model = small(transfer=METHODS[name]()).learn(10**6, callback=StopTrainingOnMaxEpisodes(3))
    model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        parts = {each: archive.read(each) for each in archive.namelist()}
    data = json.loads(parts["data"])
    data["_chance"] = data.pop("_generator_state")
    with zipfile.ZipFile(tmp_path / "former.zip", "w") as archive:
        for each, content in {**parts, "data": json.dumps(data)}.items():
            archive.writestr(each, content)
    former = FittedRMax.load(tmp_path / "former.zip")
    assert former.agent.rng.bit_generator.state == model.agent.rng.bit_generator.state
    np.testing.assert_array_equal(
        former.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )
    former.save(tmp_path / "again")
    with zipfile.ZipFile(tmp_path / "again.zip") as archive:
        assert "_chance" not in json.loads(archive.read("data"))
