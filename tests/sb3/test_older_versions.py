"""Models saved by version 0.1.0, whose transfer methods had other names for some arguments, load and learn on."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.walk import METHODS, OBSERVATIONS, Walk, small
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import COMBREL, TIMBREL, FittedRMax

DATA = Path(__file__).parents[1] / "data"
# Of these predictions no trace is left any more, so that the counts are lower.
COUNTS = ("transfer_uses", "transfer_instances_used")


@pytest.fixture(params=["timbrel", "combrel"])
def former(request):
    """A file, and what version 0.1.0 made of it."""
    with np.load(DATA / f"model_of_version_0_1_0_{request.param}.npz") as arrays:
        return DATA / f"model_of_version_0_1_0_{request.param}.zip", dict(arrays)


@pytest.mark.filterwarnings("error::DeprecationWarning", "error::UserWarning")
def test_a_file_of_version_0_1_0_loads_with_all_that_was_learned(former):
    path, expected = former
    parameters = FittedRMax.load(path).get_parameters()["policy"]
    saved = {name.removeprefix("parameter_"): array for name, array in expected.items() if name.startswith("parameter_")}
    assert parameters.keys() == saved.keys() | set(COUNTS)
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


def test_a_model_of_version_0_1_0_learns_on_as_it_did(former):
    path, expected = former
    model = FittedRMax.load(path, env=Walk())
    model.get_env().seed(5)
    model.learn(120, reset_num_timesteps=False)
    instances = model.get_parameters()["policy"]["instances"].numpy()
    np.testing.assert_allclose(instances, expected["instances_after"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(model.agent.planner.values, expected["values_after"], rtol=1e-9, atol=1e-9)


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
