"""The files of saved models: safe, whole or not at all, and small (``tests/benchmarks`` measures how fast)."""

import base64
import json
import os
import zipfile

import numpy as np
import pytest
import torch as th
from gymnasium import Env, spaces
from helpers.walk import METHODS, Walk, same_parameters, small
from stable_baselines3 import DQN

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import COMBREL, FittedRMax
from sb3_combrel.common.files import write_whole
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

PICKLED_BY_SB3 = {
    "policy_class",
    "observation_space",
    "action_space",
    "_last_obs",
    "_last_episode_starts",
    "_last_original_obs",
    "ep_info_buffer",
    "ep_success_buffer",
}


def data_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("data"))


def rewrite(path, **changed):
    """Replace parts of a model's file."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**parts, **changed}.items():
            archive.writestr(name, content)


def test_only_what_sb3_pickles_is_pickled(make, tmp_path):
    """Also with arguments that JSON does not know."""
    bounds = np.array([-1.0, 0.0]), np.array([1.0, 2.0])
    odd = dict(bounds=bounds, model_breadth=np.float32(0.15), resolution=np.array([3, 3]), gamma=np.float32(1))
    make(**odd).learn(40).save(tmp_path / "model")
    data = data_of(tmp_path / "model.zip")
    pickled = {name: base64.b64decode(v[":serialized:"]) for name, v in data.items() if ":serialized:" in str(v)}
    assert pickled.keys() <= PICKLED_BY_SB3
    assert b"sb3_combrel" in pickled.pop("policy_class"), "which SB3 pickles by its name"
    assert not any(b"sb3_combrel" in content for content in pickled.values())
    loaded = FittedRMax.load(tmp_path / "model")
    assert loaded.model_breadth == np.float32(0.15)
    np.testing.assert_array_equal(loaded.bounds, bounds)
    np.testing.assert_array_equal(loaded.resolution, [3, 3])


def test_parameters_are_tensors_only(make, tmp_path):
    make().learn(40).save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive, archive.open("policy.pth") as file:
        assert all(isinstance(value, th.Tensor) for value in th.load(file, weights_only=True).values())


def test_the_name_of_a_transfer_method_imports_nothing(tmp_path):
    small(transfer=METHODS["COMBREL"]()).learn(10).save(tmp_path / "model")
    for name in ("antigravity.COMBREL", "os.system", "sb3_combrel.transfer.base.Transfer", 7, None):
        data = data_of(tmp_path / "model.zip")
        data["transfer"]["method"] = name
        rewrite(tmp_path / "model.zip", data=json.dumps(data))
        with pytest.raises(ValueError, match=r"transfer method .* is not defined here: import it first"):
            FittedRMax.load(tmp_path / "model")


@pytest.mark.parametrize("name", ["sb3_combrel.transfer.combrel.COMBREL", "sb3_combrel.transfer.methods.combrel.COMBREL"])
def test_a_file_with_the_name_of_a_method_s_module_is_read(name, tmp_path):
    """As they were written before: modules move."""
    small(transfer=METHODS["COMBREL"]()).learn(10).save(tmp_path / "model")
    data = data_of(tmp_path / "model.zip")
    assert data["transfer"]["method"] == "sb3_combrel.COMBREL"
    data["transfer"]["method"] = name
    rewrite(tmp_path / "model.zip", data=json.dumps(data))
    assert isinstance(FittedRMax.load(tmp_path / "model").transfer, COMBREL)


@pytest.mark.parametrize(
    "arguments",
    [
        {"source": 7},
        {"nonsense": 1},
        [],
        "text",
        {"source": {"~kind": "os.system"}},
        {"source": {"~kind": "SourceInstances", "npz": "AAAA"}},
        {"source": {"~kind": "SourceInstances", "npz": "no base64"}},
        {"source": {"~kind": "SourceInstances"}},
        {"source": {"~kind": ["SourceInstances"]}},
        {"source": {"~kind": "MappingSet", "state_mappings": 1, "signs": 2, "actions": 3}},
        {"source": {"~kind": "InterTaskMapping", "state": 3, "action": None}},
    ],
    ids=str,
)
def test_a_description_of_transfer_that_makes_no_sense_is_an_error(arguments, tmp_path):
    small(transfer=METHODS["COMBREL"]()).learn(10).save(tmp_path / "model")
    data = data_of(tmp_path / "model.zip")
    data["transfer"]["arguments"] = arguments
    rewrite(tmp_path / "model.zip", data=json.dumps(data))
    with pytest.raises(ValueError):
        FittedRMax.load(tmp_path / "model")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        FittedRMax.load(tmp_path / "nowhere")


@pytest.fixture(scope="module")
def file_of_a_model(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.zip"
    model = small(transfer=METHODS["COMBREL"]()).learn(40)
    model.save(path)
    return model, path.read_bytes()


def refused(path):
    with pytest.raises(ValueError, match="damaged or not the file of a model") as error:
        FittedRMax.load(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_an_error(file_of_a_model, part, tmp_path):
    _, content = file_of_a_model
    (tmp_path / "model.zip").write_bytes(content[: int(part * len(content))])
    refused(tmp_path / "model.zip")


def test_a_file_in_which_bits_have_changed_is_an_error_or_is_what_it_was(file_of_a_model, tmp_path):
    model, content = file_of_a_model
    rng, n_refused = np.random.default_rng(0), 0
    # The directory at the end is the part with the most ways to be wrong.
    places = np.concatenate([rng.integers(len(content), size=60), len(content) - rng.integers(1, 400, size=60)])
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= int(rng.integers(1, 256))
        (tmp_path / "model.zip").write_bytes(damaged)
        try:
            loaded = FittedRMax.load(tmp_path / "model.zip")
        except ValueError as error:
            assert "\n" not in str(error)
            n_refused += 1
        else:
            assert same_parameters(loaded, model)
    assert n_refused > 60


def test_files_of_other_kinds_are_errors(file_of_a_model, tmp_path):
    (tmp_path / "text.zip").write_text("not a model")
    np.savez(tmp_path / "arrays.npz", values=np.zeros(3))
    METHODS["COMBREL"]().source.save(tmp_path / "source.npz")
    for name in ("text.zip", "arrays.npz", "source.npz"):
        refused(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="folder"):
        FittedRMax.load(tmp_path / "folder")


def test_a_file_of_another_algorithm_is_an_error(tmp_path):
    DQN("MlpPolicy", "CartPole-v1", buffer_size=10).save(tmp_path / "dqn.zip")
    with pytest.raises(ValueError, match="another algorithm's model, not of FittedRMax"):
        FittedRMax.load(tmp_path / "dqn.zip")


def test_parameters_that_do_not_fit_are_an_error_in_a_sentence(file_of_a_model, tmp_path):
    _, content = file_of_a_model
    path = tmp_path / "model.zip"
    path.write_bytes(content)
    with zipfile.ZipFile(path) as archive, archive.open("policy.pth") as file:
        parameters = th.load(file, weights_only=True)
    for name in parameters:
        without = {k: v for k, v in parameters.items() if k != name}
        with (tmp_path / "policy.pth").open("wb") as file:
            th.save(without, file)
        rewrite(path, **{"policy.pth": (tmp_path / "policy.pth").read_bytes()})
        with pytest.raises(ValueError, match=name) as error:
            FittedRMax.load(path)
        assert "\n" not in str(error.value)


def test_a_file_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    model = small().learn(20)
    model.save(path)
    before = path.read_bytes()

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("sb3_combrel.common.files.os.replace", full)
    with pytest.raises(OSError, match="no space left"):
        model.learn(20).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "nothing else is left behind"


def test_the_old_file_is_there_until_the_new_one_is(tmp_path, monkeypatch):
    path, seen = tmp_path / "file", []
    path.write_bytes(b"old")
    replace = os.replace

    def spy(source, target):
        seen.append((path.read_bytes(), open(source, "rb").read()))
        replace(source, target)

    monkeypatch.setattr("sb3_combrel.common.files.os.replace", spy)
    write_whole(path, b"new")
    assert seen == [(b"old", b"new")]
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask():
    umask = os.umask(0)
    os.umask(umask)
    return umask


class Untouched(Env):
    """Spaces of Mountain Car's size."""

    def __init__(self, d, n_actions):
        self.observation_space = spaces.Box(-1.0, 1.0, (d,), dtype=np.float64)
        self.action_space = spaces.Discrete(n_actions)


def long_walks(d, n_actions, n):
    """What 50,000 steps bring: trajectories, all digits in use; of Mountain Car's instances a third stand in lists."""
    rng = np.random.default_rng(0)
    effect = 0.02 * rng.normal(size=(n, d))
    state = np.abs((np.cumsum(effect, axis=0) + 0.5) % 2.0 - 1.0)
    action = np.sort(rng.integers(n_actions, size=n))
    return np.column_stack([action, state, effect, np.full(n, -1.0), np.zeros(n), rng.random(n) < 0.4])


@pytest.mark.parametrize(("d", "n_actions", "settings"), [(2, 3, {}), (4, 5, dict(model_breadth=0.4, resolution=3))])
def test_a_file_of_fifty_thousand_instances_is_no_larger_than_their_states_and_effects(d, n_actions, settings, tmp_path):
    model = FittedRMax(Untouched(d, n_actions), min_fraction=0.1, max_instances=None, seed=0, **settings)
    parameters = model.get_parameters()["policy"]
    model.set_parameters({"policy": {**parameters, "instances": th.as_tensor(long_walks(d, n_actions, 50_000))}})
    model.save(tmp_path / "model")
    assert FittedRMax.load(tmp_path / "model").agent.model.n_instances == 50_000
    # State and effect have all their digits; reward, action and the rest cost nothing to speak of.
    model_size = 8 * (2 * d * 50_000 + 2 * model.agent.grid.n_points * (1 + n_actions))
    assert (tmp_path / "model.zip").stat().st_size < model_size


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("combrel/MountainCar2D-v0", {}),
        ("combrel/MountainCar4D-v0", dict(model_breadth=0.4, resolution=3, min_fraction=0.1)),
    ],
)
def test_fifty_thousand_steps_of_mountain_car_make_a_small_file_with_all_of_them(env, settings, tmp_path):
    model = FittedRMax(env, seed=0, **settings).learn(50_000)
    model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").stat().st_size < 70 * model.agent.model.n_instances
    assert same_parameters(FittedRMax.load(tmp_path / "model"), model)


def test_the_policys_own_file_contains_no_class_of_the_package(tmp_path):
    model = small(Walk(), transfer=METHODS["COMBREL"]()).learn(20)
    model.policy.save(tmp_path / "policy.pth")
    with zipfile.ZipFile(tmp_path / "policy.pth") as archive:
        pickled = b"".join(archive.read(name) for name in archive.namelist() if name.endswith("data.pkl"))
    assert b"sb3_combrel.COMBREL" in pickled, "its name, as text"
    assert b"csb3_combrel" not in pickled, "no class to be imported"
    assert len(FittedRMaxPolicy.load(tmp_path / "policy.pth").transfer.sources[0]) == 60
