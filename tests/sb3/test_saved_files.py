"""The files of saved models: safe, whole or not at all, small; of damaged ones it is said that they are."""

import base64
import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch as th
from gymnasium import Env, spaces
from helpers.walk import METHODS, Walk, same_parameters, small
from stable_baselines3.dqn.policies import DQNPolicy

from sb3_combrel import FittedRMax
from sb3_combrel.common.files import write_whole
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

PICKLED_BY_SB3 = {
    *("policy_class", "observation_space", "action_space", "_last_obs", "_last_episode_starts", "_last_original_obs"),
    *("ep_info_buffer", "ep_success_buffer"),
}


def parts_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def data_of(path):
    return json.loads(parts_of(path)["data"])


def rewrite(path, **changed):
    """Replace parts of a model's file; None: leave one out."""
    parts = {**parts_of(path), **changed}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            if content is not None:
                archive.writestr(name, content)


def test_only_what_sb3_pickles_is_pickled_and_parameters_are_tensors(make, tmp_path):
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
    with zipfile.ZipFile(tmp_path / "model.zip") as archive, archive.open("policy.pth") as file:
        assert all(isinstance(value, th.Tensor) for value in th.load(file, weights_only=True).values())


class Hostile:
    """Runs code when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("hostile",)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.zip"
    small(transfer=METHODS["COMBREL"]()).learn(40).save(path)
    return path.read_bytes()


@pytest.fixture
def path(content, tmp_path, monkeypatch):
    """The file of a model, in the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.zip").write_bytes(content)
    return tmp_path / "model.zip"


def refused(path, because=""):
    with pytest.raises(
        ValueError, match=f"is not the file of a model of FittedRMax, is damaged, or does not fit.*{because}"
    ) as e:
        FittedRMax.load(path)
    assert str(path) in str(e.value) and "\n" not in str(e.value)


def tensors_in_file(tensors):
    memory = io.BytesIO()
    th.save(tensors, memory)
    return memory.getvalue()


def test_a_hostile_pickle_in_place_of_parameters_is_refused_and_not_run(path):
    rewrite(path, **{"policy.pth": tensors_in_file({"values": Hostile()})})
    refused(path)
    assert not os.path.exists("hostile")


@pytest.mark.parametrize("name", ["antigravity.COMBREL", "os.system", "sb3_combrel.transfer.base.Transfer", 7, None])
def test_the_name_of_a_transfer_method_imports_nothing(path, name):
    transfer = data_of(path)["transfer"]
    rewrite(path, data=json.dumps({**data_of(path), "transfer": {**transfer, "method": name}}))
    refused(path, "transfer method .* is not defined here: import it first")


@pytest.mark.parametrize("arguments", [{"source": 7}, {"nonsense": 1}, "text", {"source": {"~kind": "os.system"}}], ids=str)
def test_a_description_of_transfer_that_makes_no_sense_is_refused(path, arguments):
    transfer = data_of(path)["transfer"]
    rewrite(path, data=json.dumps({**data_of(path), "transfer": {**transfer, "arguments": arguments}}))
    refused(path)


@pytest.mark.parametrize("part", [0.0, 0.001, 0.5, 0.999])
def test_a_file_that_is_cut_short_is_refused(path, content, part):
    path.write_bytes(content[: int(part * len(content))])
    refused(path)


@pytest.mark.parametrize(
    "changed",
    [
        *[{"policy.pth": None}, {"policy.pth": b"no tensors"}, {"policy.pth": tensors_in_file({})}],
        *[{"policy.pth": tensors_in_file({"values": th.zeros(3)})}, {"data": None}, {"data": "{"}, {"data": "[]"}],
        {"data": "{}"},
    ],
    ids=str,
)
def test_an_archive_without_what_a_model_has_is_refused(path, changed):
    rewrite(path, **changed)
    refused(path)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("_generator_state", {"state": 3}), ("gamma", "text"), ("policy_kwargs", {"a": 1}), ("policy_class", None), ("seed", -1)],
)
def test_wrong_entries_are_refused_by_name(path, name, wrong):
    rewrite(path, data=json.dumps({**data_of(path), name: wrong}))
    refused(path)


def test_the_file_of_another_algorithm_is_refused_by_its_policy(path):
    pickled = base64.b64encode(pickle.dumps(DQNPolicy)).decode()
    rewrite(path, data=json.dumps({**data_of(path), "policy_class": {":serialized:": pickled}}))
    refused(path, "must be FittedRMaxPolicy or a subclass, got DQNPolicy")


def test_a_file_in_which_bits_have_changed_is_refused_or_is_what_it_was(path, content):
    model, rng, n_refused = FittedRMax.load(path), np.random.default_rng(0), 0
    # The directory at the end is the part with the most ways to be wrong.
    places = np.concatenate([rng.integers(len(content), size=8), len(content) - rng.integers(1, 400, size=12)])
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            loaded = FittedRMax.load(path)
        except ValueError as error:
            assert "\n" not in str(error)
            n_refused += 1
        else:
            assert same_parameters(loaded, model)
    assert n_refused > 10


def test_files_of_other_kinds_are_refused_and_one_that_is_missing_is_named(path):
    path.write_text("not a model")
    refused(path)
    METHODS["COMBREL"]().source.save("source.npz")
    refused("source.npz")
    os.mkdir("folder")
    refused("folder")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        FittedRMax.load("nowhere")


def test_a_file_that_cannot_be_finished_leaves_the_old_one(path, content, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("sb3_combrel.common.files.os.replace", full)
    with pytest.raises(OSError, match="no space left"):
        small().save(path)
    assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path], "nothing else is left behind"


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
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


class Untouched(Env):
    """Spaces of Mountain Car's size."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)
    action_space = spaces.Discrete(3)


def test_a_file_is_no_larger_than_states_and_effects(tmp_path):
    """State and effect have all their digits; reward, action and the rest cost nothing to speak of."""
    n = 5_000
    rng = np.random.default_rng(0)
    effect = 0.02 * rng.normal(size=(n, 2))
    state = np.abs((np.cumsum(effect, axis=0) + 0.5) % 2.0 - 1.0)
    action = np.sort(rng.integers(3, size=n))
    walks = np.column_stack([action, state, effect, np.full(n, -1.0), np.zeros(n), rng.random(n) < 0.4])
    model = FittedRMax(Untouched(), max_instances=None, seed=0, degree=0)
    model.set_parameters({"policy": {**model.get_parameters()["policy"], "instances": th.as_tensor(walks)}})
    model.save(tmp_path / "model")
    assert FittedRMax.load(tmp_path / "model").agent.model.n_instances == n
    assert (tmp_path / "model.zip").stat().st_size < 8 * (2 * 2 * n + 2 * model.agent.grid.n_points * (1 + 3))


def test_the_policys_own_file_contains_no_class_of_the_package(tmp_path):
    small(Walk(), transfer=METHODS["COMBREL"]()).learn(20).policy.save(tmp_path / "policy.pth")
    pickled = b"".join(part for name, part in parts_of(tmp_path / "policy.pth").items() if name.endswith("data.pkl"))
    assert b"sb3_combrel.COMBREL" in pickled, "its name, as text"
    assert b"csb3_combrel" not in pickled, "no class to be imported"
    assert len(FittedRMaxPolicy.load(tmp_path / "policy.pth").transfer.sources[0]) == 60
