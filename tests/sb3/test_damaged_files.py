"""Damaged files of models and wrong parameters: one sentence about what is wrong, or a model that works."""

import base64
import io
import json
import warnings
import zipfile

import numpy as np
import pytest
import torch as th
from helpers.walk import METHODS, OBSERVATIONS, Walk, same_parameters, small

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

SERIALIZED = ":serialized:"
WRONG_ENTRIES = [None, True, -1, 3, 2.5, 1e300, float("nan"), "text", [], [1, "a"], {}, {"a": 1}, {SERIALIZED: 7}]
WRONG_STATES = [None, True, -1, 2**200, 0.5, "text", [], {}]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """A damaged file may name a folder for logs."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module", params=["none", "COMBREL"])
def parts(request):
    """What is in the file of a model, by name."""
    memory = io.BytesIO()
    small(transfer=METHODS[request.param]()).learn(40).save(memory)
    with zipfile.ZipFile(memory) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path, parts, **changed):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**parts, **changed}.items():
            archive.writestr(name, content)


def try_to_load(path, label):
    """Whether the file is refused, in one sentence with its name; otherwise the model must work."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = FittedRMax.load(path, env=Walk())
    except ValueError as error:
        assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 600, (label, str(error))
        return True
    model.predict(OBSERVATIONS, deterministic=True)
    model.learn(3, reset_num_timesteps=False)
    return False


def n_refused(tmp_path, parts, cases):
    """How many files of a sequence of (label, what is changed) are refused."""
    path = tmp_path / "damaged.zip"
    refused = 0
    for label, changed in cases:
        write(path, parts, **changed)
        refused += try_to_load(path, label)
    return refused


def garbled(rng, content, n_bytes=1):
    damaged = bytearray(content)
    for place in rng.integers(len(content), size=n_bytes):
        damaged[place] ^= int(rng.integers(1, 256))
    return bytes(damaged)


def of_data(data, **changed):
    return {"data": json.dumps({**data, **changed})}


def test_entries_of_another_type_or_missing_are_refused_or_make_no_difference(parts, tmp_path):
    data = json.loads(parts["data"])
    cases = [((name, wrong), of_data(data, **{name: wrong})) for name in data for wrong in WRONG_ENTRIES]
    cases += [((name, "missing"), {"data": json.dumps({k: v for k, v in data.items() if k != name})}) for name in data]
    assert n_refused(tmp_path, parts, cases) > 0.5 * len(cases) > 200


def test_serialized_objects_that_are_damaged_are_refused_or_make_no_difference(parts, tmp_path):
    rng, data = np.random.default_rng(0), json.loads(parts["data"])
    cases = []
    for name, entry in data.items():
        if not (isinstance(entry, dict) and SERIALIZED in entry):
            continue
        pickled = base64.b64decode(entry[SERIALIZED])
        damaged = [b"", b"\x80", pickled[: len(pickled) // 2], pickled[:-1], b"no pickle at all"]
        encoded = [base64.b64encode(content).decode() for content in damaged]
        for text in [*encoded, "no base64 \u2713", entry[SERIALIZED][:-3], rng.bytes(40).hex()]:
            cases.append(((name, text[:20]), of_data(data, **{name: {**entry, SERIALIZED: text}})))
    assert len(cases) > 40
    assert n_refused(tmp_path, parts, cases) == len(cases)


def test_a_damaged_state_of_the_generator_is_refused(parts, tmp_path):
    data = json.loads(parts["data"])
    state = data["_generator_state"]
    cases = [((wrong,), wrong) for wrong in WRONG_STATES if wrong is not None]
    for name in state:
        cases += [((name, wrong), {**state, name: wrong}) for wrong in WRONG_STATES]
        cases.append(((name, "missing"), {k: v for k, v in state.items() if k != name}))
    for name in state["state"]:
        cases += [((name, wrong), {**state, "state": {**state["state"], name: wrong}}) for wrong in WRONG_STATES]
    damaged = [(label, of_data(data, _generator_state=wrong)) for label, wrong in cases]
    assert n_refused(tmp_path, parts, damaged) > 0.8 * len(damaged)


def saved_tensors(tensors):
    memory = io.BytesIO()
    th.save(tensors, memory)
    return {"policy.pth": memory.getvalue()}


def test_tensors_that_are_something_else_are_refused_by_name(parts, tmp_path):
    tensors = th.load(io.BytesIO(parts["policy.pth"]), weights_only=True)
    path = tmp_path / "damaged.zip"
    for name, tensor in tensors.items():
        wrong = ["text", None, 7, [1.0], {}, tensor.to(th.int64), tensor > 0.5, tensor.to(th.complex64)]
        wrong += [tensor[None, None, None], th.zeros(()), th.zeros(0, 0, 0), th.full((1,), th.inf)]
        for value in wrong:
            write(path, parts, **saved_tensors({**tensors, name: value}))
            with pytest.raises(ValueError, match=name) as error:
                FittedRMax.load(path)
            assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_numbers_of_any_size_in_tensors_are_refused_or_make_a_model_that_works(parts, tmp_path):
    rng = np.random.default_rng(1)
    tensors = th.load(io.BytesIO(parts["policy.pth"]), weights_only=True)
    cases = []
    for name, tensor in tensors.items():
        for value in (0.0, -1.0, 0.5, 1e6, -1e6, 1e18, -1e300, 1e300):
            cases.append(((name, value), saved_tensors({**tensors, name: th.full_like(tensor, value)})))
        noise = th.as_tensor(rng.normal(size=tuple(tensor.shape)))
        cases += [((name, scale), saved_tensors({**tensors, name: tensor + scale * noise})) for scale in (0.1, 10.0)]
    n_refused(tmp_path, parts, cases)


def test_an_inner_archive_that_is_cut_short_or_garbled_is_refused_or_is_what_it_was(parts, tmp_path):
    rng, content = np.random.default_rng(2), parts["policy.pth"]
    lengths = [0, 1, 10, 100, *rng.integers(len(content), size=20), len(content) - 1]
    cut = [((n,), {"policy.pth": content[: int(n)]}) for n in lengths]
    assert n_refused(tmp_path, parts, cut) == len(cut)
    others = [b"text", b"PK\x03\x04", b"\x80\x02.", json.dumps({}).encode()]
    assert n_refused(tmp_path, parts, [((n,), {"policy.pth": other}) for n, other in enumerate(others)]) == len(others)
    flipped = [((n,), {"policy.pth": garbled(rng, content, 1 + n % 5)}) for n in range(60)]
    assert n_refused(tmp_path, parts, flipped) > 0
    objects = [saved_tensors(value) for value in ({}, [], None, 3, "text", th.zeros(3), {1: th.zeros(1)})]
    assert n_refused(tmp_path, parts, [((n,), changed) for n, changed in enumerate(objects)]) == len(objects)


def test_a_description_of_transfer_with_wrong_arguments_is_refused_or_makes_a_model_that_works(parts, tmp_path):
    data = json.loads(parts["data"])
    if data["transfer"] is None:
        cases = [((wrong,), of_data(data, transfer=wrong)) for wrong in WRONG_ENTRIES if wrong is not None]
        assert n_refused(tmp_path, parts, cases) == len(cases)
        return
    arguments, cases = data["transfer"]["arguments"], []
    for name in arguments:
        for wrong in WRONG_ENTRIES:
            changed = {**data["transfer"], "arguments": {**arguments, name: wrong}}
            cases.append(((name, wrong), of_data(data, transfer=changed)))
    for name in ("method", "arguments", "~kind"):
        cases += [((name, wrong), of_data(data, transfer={**data["transfer"], name: wrong})) for wrong in WRONG_ENTRIES]
    assert n_refused(tmp_path, parts, cases) > 0.5 * len(cases) > 100


@pytest.fixture(scope="module")
def learned():
    return small(transfer=METHODS["COMBREL"]()).learn(60)


@pytest.mark.parametrize("exact_match", [True, False])
@pytest.mark.parametrize(
    "wrong",
    [None, 7, 2.5, True, [], [1], {1: {}}, {"policy": 3}, {"policy": None}, {"stranger": {}}, {"policy": {"values": 3}}],
)
def test_parameters_of_another_kind_are_refused_by_the_name_of_the_argument(learned, wrong, exact_match):
    before = small(transfer=METHODS["COMBREL"]())
    before.set_parameters(learned.get_parameters())
    with pytest.raises(ValueError, match=r"load_path_or_dict|parameter") as error:
        learned.set_parameters(wrong, exact_match=exact_match)
    assert "\n" not in str(error.value)
    assert same_parameters(learned, before), "nothing has changed"


@pytest.mark.parametrize("wrong", [None, 1, "yes"])
def test_exact_match_is_true_or_false(learned, wrong):
    with pytest.raises(ValueError, match="exact_match must be True or False, got"):
        learned.set_parameters(learned.get_parameters(), exact_match=wrong)


def test_parameters_come_from_a_file_too_and_a_file_that_is_none_is_named(learned, tmp_path):
    learned.save(tmp_path / "model")
    for given in (tmp_path / "model", str(tmp_path / "model.zip"), io.BytesIO((tmp_path / "model.zip").read_bytes())):
        model = small(transfer=METHODS["COMBREL"]())
        model.set_parameters(given)
        assert same_parameters(model, learned)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        learned.set_parameters(tmp_path / "nowhere")
    (tmp_path / "text.zip").write_text("no archive")
    with pytest.raises(ValueError, match=r"text\.zip is damaged"):
        learned.set_parameters(tmp_path / "text.zip")


def test_without_exact_match_what_is_not_given_stays_and_what_is_unknown_is_ignored(learned):
    model = small(transfer=METHODS["COMBREL"]()).learn(30)
    before, values = model.get_parameters()["policy"], learned.get_parameters()["policy"]["values"]
    some = {"policy": {"values": values, "stranger": th.zeros(3)}}
    with pytest.raises(ValueError, match=r"load_path_or_dict: .*Missing key"):
        model.set_parameters(some)
    model.set_parameters(some, exact_match=False)
    after = model.get_parameters()["policy"]
    assert th.equal(after["values"], values)
    assert all(th.equal(after[name], before[name]) for name in before if name != "values")
    model.set_parameters({}, exact_match=False)
    assert all(th.equal(model.get_parameters()["policy"][name], after[name]) for name in after)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (7, "policy_kwargs must be a dict"),
        ([], "policy_kwargs must be a dict"),
        ("net_arch", "policy_kwargs must be a dict"),
        ({"net_arch": [64]}, "policy_kwargs must have names out of .*model_class.*, got 'net_arch'"),
        ({3: 4}, "policy_kwargs must have names out of .*, got 3"),
        ({"gamma": 0.9}, r"policy_kwargs must not have 'gamma': pass gamma=\.\.\. to FittedRMax itself"),
        ({"model_class": "KernelAverage"}, "model_class must be a subclass of Model or None, got 'KernelAverage'"),
        ({"model_class": FittedRMaxPolicy}, "model_class must be a subclass of Model"),
        ({"state_names": 3}, "state_names must be"),
        ({"action_names": ["one"]}, "action_names must be 2 names"),
    ],
)
def test_wrong_policy_kwargs_are_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        small(policy_kwargs=wrong)


def test_names_for_display_can_be_given_as_policy_kwargs():
    task = small(policy_kwargs=dict(state_names=("place", "height"), action_names=["back", "forth"])).agent.task
    assert (task.state_names, task.action_names) == (("place", "height"), ("back", "forth"))
