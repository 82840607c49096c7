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
from helpers.walk import METHODS, STRIDE, Walk, learnt_on, same_parameters, small, stored, walk_source
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.dqn.policies import DQNPolicy

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, MappingSet, SampleTransfer
from sb3_combrel.common.files import write_whole
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.transfer.base import Transfer

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
    with pytest.raises(ValueError, match=r"zip: the model was saved with the transfer method .* is not defined here: import"):
        FittedRMax.load(path)


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


def test_a_file_that_replaces_another_has_the_permissions_of_a_new_one(tmp_path):
    path, umask = tmp_path / "file", os.umask(0)
    os.umask(umask)
    for content in (b"old", b"new"):
        write_whole(path, content)
        assert path.read_bytes() == content and path.stat().st_mode & 0o777 == 0o666 & ~umask


class Untouched(Env):
    """Spaces of Mountain Car's size."""

    observation_space, action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float64), spaces.Discrete(3)


def test_a_file_is_no_larger_than_states_and_effects(tmp_path):
    """State and effect have all their digits; reward, action and the rest cost nothing to speak of."""
    n, rng = 5_000, np.random.default_rng(0)
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


# A model with transfer, saved and loaded, goes on with the same mappings, compliance, source and random numbers.
MAPPING = InterTaskMapping([0, 1], [0, 1])
VARIANTS = {
    **METHODS,
    "one mapping an action": lambda: TIMBREL(walk_source(), [MAPPING, InterTaskMapping([0, None], [1, 0])]),
    "pool": lambda: TIMBREL(walk_source(), "pool", mappings="all"),
    "two sources": lambda: COMBREL([walk_source(40), walk_source(60)], use="instances"),
    "first episode": lambda: COMBREL(walk_source(), measured="first_episode"),
    "drawn": lambda: COMBREL(walk_source(), choice="drawn"),
    "set": lambda: COMBREL(walk_source(), MappingSet.injective(2, 2, 2, 2), n_neighbors=2),
    "list": lambda: COMBREL(walk_source(), [MAPPING, {"state": [0, None], "action": [1, 0]}], min_compliance=0.0),
    "few transitions": lambda: COMBREL(walk_source(), max_transitions=25, bandwidths=(0.1, 0.1, np.float64(1.0))),
}


@pytest.fixture(params=VARIANTS)
def variant(request):
    return VARIANTS[request.param]


def after_episodes(n, transfer, env=None, **kwargs):
    return small(env, transfer=transfer, **kwargs).learn(10**6, callback=StopTrainingOnMaxEpisodes(n))


def test_learning_goes_on_to_the_last_bit(variant, tmp_path):
    """Saved at an episode's end, a loaded model learns what the model itself learns when it learns on."""
    model, loaded = learnt_on(after_episodes(2, variant()), tmp_path, 60)
    assert same_parameters(model, loaded) and model.agent.model.n_instances > 60
    if model.policy.transfer is not None:
        assert model.policy.transfer.mapping_counts() == loaded.policy.transfer.mapping_counts()


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("n_steps", [25, 60])
def test_in_mid_episode_what_is_not_known_waits_after_loading_as_it_did(degree, n_steps, tmp_path):
    """A pair with transferred instances takes new ones of its own in when its episode ends, or when they are many."""
    model = small(transfer=COMBREL(walk_source(), use="instances"), degree=degree, exploration_threshold=2.0).learn(n_steps)
    assert (model.agent.model.end_episode()).size > 0, "nothing waits: the test tests nothing"
    model.save(tmp_path / "model")
    rows, of_loaded = (one.agent.mdp.arrays for one in (model, FittedRMax.load(tmp_path / "model")))
    for name in ("modelled", "length", "reward"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(of_loaded, name), err_msg=name)
    used = np.arange(rows.weight.shape[2]) < rows.length[:, :, None]
    np.testing.assert_array_equal(np.where(used, rows.weight, 0.0), np.where(used, of_loaded.weight, 0.0))


def test_a_kernel_average_passes_on_after_loading_what_it_had_not_yet(tmp_path):
    """With a large tolerance and a narrow kernel most changes wait: what waits is saved."""
    given = dict(degree=0, model_breadth=0.03, min_fraction=0.02, resolution=6, planning_tolerance=0.1, gamma=0.9)
    model, loaded = learnt_on(small(Walk(start=-0.5), **given).learn(150), tmp_path, 150)
    state = model.agent.planner.get_state()
    waits = np.abs(state["passed_on"][:, 0] - state["values"])
    assert 0.0 < waits.max() <= 0.1 and not state["passed_on"][:, 1].all()
    assert same_parameters(model, loaded)


BY_RELEVANCE = {
    "none": lambda: None,
    "TIMBREL": lambda: TIMBREL(walk_source(), MAPPING, relevance="near"),
    "pool": lambda: TIMBREL(walk_source(), "pool", relevance=True),
    "COMBREL": lambda: COMBREL(walk_source(), relevance="near"),
    "SampleTransfer": lambda: SampleTransfer(walk_source(), min_transitions=20, relevance=True),
}


@pytest.mark.parametrize(
    ("name", "n_episodes"),
    [("TIMBREL", 3), ("none", 5), ("COMBREL", 5), *(pytest.param(name, 8, marks=pytest.mark.long) for name in BY_RELEVANCE)],
)
def test_two_halves_make_the_run_that_was_not_interrupted(name, n_episodes, tmp_path):
    """But for the planning that a call of ``learn`` begins with, which a small tolerance leaves nothing to do.

    Relevance is measured by the transitions of its last renewal, of which there may have been none, not by all so far.
    """
    given = dict(planning_tolerance=1e-10, model_breadth=0.05, exploration_threshold=2.0)
    whole = after_episodes(n_episodes + 6, BY_RELEVANCE[name](), Walk(start=-0.5), **given)
    after_episodes(n_episodes, BY_RELEVANCE[name](), Walk(start=-0.5), **given).save(tmp_path / "half")
    halves = FittedRMax.load(tmp_path / "half", env=Walk(start=-0.5))
    halves.learn(10**6, callback=StopTrainingOnMaxEpisodes(6), reset_num_timesteps=False)
    assert halves.num_timesteps == whole.num_timesteps > 60
    np.testing.assert_array_equal(stored(halves), stored(whole))
    np.testing.assert_allclose(halves.agent.planner.values, whole.agent.planner.values, atol=1e-8)
    if name == "none":
        return
    assert halves.policy.transfer.uses() == whole.policy.transfer.uses()
    for one, other in zip(*(transferred_by(model.policy.transfer) for model in (halves, whole)), strict=True):
        np.testing.assert_array_equal(one, other)


def transferred_by(method):
    """Weights, effects and rewards of the instances that a method transfers to all pairs of the sample."""
    points = method.task.sample_states
    pairs = np.tile(np.arange(len(points)), 2), np.repeat([0, 1], len(points)), np.zeros(2 * len(points))
    found = method.transferred_to_sample(*pairs)
    there = np.arange(found.weight.shape[1]) < found.length[: 2 * len(points), None]
    return [array[: 2 * len(points)][there] for array in (found.weight, found.effect, found.reward)]


def test_the_file_of_a_model_contains_the_source(tmp_path):
    path = walk_source().save(tmp_path / "source.npz")
    model = small(transfer={"sb3_combrel.COMBREL": {"source": str(path), "n_neighbors": 2}}).learn(40)
    model.save(tmp_path / "model")
    path.unlink()
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert (type(loaded.policy.transfer), loaded.policy.transfer.n_neighbors) == (COMBREL, 2)
    assert len(loaded.policy.transfer.sources[0]) == 60
    loaded.learn(20)
    loaded.save(tmp_path / "again")
    assert FittedRMax.load(tmp_path / "again").agent.model.n_instances == 60


def test_random_mappings_are_saved_and_others_are_drawn_after_loading(tmp_path):
    """What differs after loading: all pairs are modelled once more, so TIMBREL("random") draws other mappings for them."""
    model = small(transfer=TIMBREL(walk_source(), "random")).learn(60)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert loaded.policy.transfer.mapping == "random"
    np.testing.assert_array_equal(stored(loaded), stored(model))
    assert loaded.learn(30).agent.model.n_instances == 90


class Pushy(Transfer):
    """A user's own method: whatever is not known moves to the right."""

    def __init__(self, push, schedule=None):
        self.push, self.schedule = push, schedule

    def bind(self, task, rng):
        super().bind(task, rng)
        self.n_observed = 0

    def observe(self, state, action, reward, next_state, terminated):
        self.n_observed += 1

    def lowest_reward(self):
        return -1.0

    def changed(self, known):
        return self.n_observed == 0

    def transferred(self, states, actions, own_weight):
        n = len(states)
        effect = np.zeros((n, 1, self.task.n_variables))
        effect[:, :, 0] = self.push
        return TransferredInstances(
            np.ones(n, dtype=np.int64), np.ones((n, 1)), effect, np.full((n, 1), -1.0), np.zeros((n, 1), dtype=np.bool_)
        )

    def get_state(self):
        return {"n_observed": np.array([float(self.n_observed)])}

    def set_state(self, state):
        self.n_observed = int(state["n_observed"][0])


def test_a_method_of_the_users_own_is_saved_by_its_arguments(tmp_path, recwarn):
    small(transfer=Pushy(np.float64(STRIDE / 2))).learn(30).save(tmp_path / "model")
    assert not [warning for warning in recwarn if "transfer" in str(warning.message)]
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert type(loaded.policy.transfer) is Pushy
    assert (loaded.policy.transfer.push, loaded.policy.transfer.n_observed) == (STRIDE / 2, 30)
    loaded.learn(10)
    assert loaded.policy.transfer.n_observed == 40


def test_a_transfer_method_that_is_not_plain_data_must_be_passed_to_load(tmp_path):
    own = Pushy(STRIDE / 2, schedule=lambda n: n)
    model = small(transfer=own).learn(30)
    with pytest.warns(UserWarning, match=r"Pushy is not saved .*load\(\.\.\., transfer=Pushy\(\.\.\.\)\)"):
        model.save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"Pushy, which could not be saved with it: .*load\(\.\.\., transfer=\.\.\.\)"):
        FittedRMax.load(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(), transfer=own)
    assert loaded.policy.transfer.n_observed == 30 and same_parameters(loaded, model)


def test_a_subclass_without_its_arguments_is_not_loaded_as_its_parent(tmp_path):
    class Mine(COMBREL):
        def __init__(self, source, secret):
            super().__init__(source)

    with pytest.warns(UserWarning, match=r"Mine is not saved .*secret"):
        small(transfer=Mine(walk_source(), 3)).learn(10).save(tmp_path / "model")
    with pytest.raises(
        ValueError, match=r"model: the model was saved with the transfer method .*Mine, which could not be saved"
    ):
        FittedRMax.load(tmp_path / "model")
    with pytest.raises(ValueError, match="transfer"):
        FittedRMax.load(tmp_path / "model", transfer=None)
