"""Two hundred files that a stranger may have made, to run a program where they are read: each is refused, and none does."""

import base64
import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch as th
from helpers.walk import METHODS, Walk, small, walk_source

from sb3_combrel import COMBREL, FittedRMax, SourceInstances

N_FILES = 200
WITNESS = "hostile"


class Hostile:
    """Makes a folder where it is unpickled."""

    def __reduce__(self):
        return os.mkdir, (WITNESS,)


def nested(rng):
    """The hostile object somewhere inside of what may be expected."""
    found = Hostile()
    for kind in rng.integers(4, size=rng.integers(4)).tolist():
        found = [{"values": found}, [found, 1.0], (th.zeros(2), found), {0: [found]}][kind]
    return found


def protocol(rng):
    return int(rng.integers(2, pickle.HIGHEST_PROTOCOL + 1))


def saved_tensors(rng):
    content = io.BytesIO()
    th.save(nested(rng), content, pickle_protocol=protocol(rng), _use_new_zipfile_serialization=bool(rng.integers(2)))
    return content.getvalue()


def with_part(model, name, part):
    """A model's file with one part replaced."""
    content = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(model)) as given, zipfile.ZipFile(content, "w") as written:
        for each in given.namelist():
            written.writestr(each, part if each == name else given.read(each))
    return content.getvalue()


def parameters(rng, model):
    return ".zip", with_part(model, "policy.pth", saved_tensors(rng))


def raw_pickle_as_parameters(rng, model):
    return ".zip", with_part(model, "policy.pth", pickle.dumps(nested(rng), protocol(rng)))


def named_class(rng, model):
    """A transfer method by a name that would have to be imported, or that makes something at once."""
    with zipfile.ZipFile(io.BytesIO(model)) as archive:
        data = json.loads(archive.read("data"))
    names = ["os.mkdir", "os.system", "subprocess.Popen", "builtins.eval", "antigravity.COMBREL", "helpers.walk.Walk"]
    data["transfer"]["method"] = names[rng.integers(len(names))]
    data["transfer"]["arguments"] = [{"path": WITNESS}, {"~kind": "os.mkdir", "path": WITNESS}, [WITNESS]][rng.integers(3)]
    return ".zip", with_part(model, "data", json.dumps(data).encode())


def objects_in_a_source(rng, _):
    """An npz archive, some arrays of which hold objects."""
    content, source = io.BytesIO(), walk_source()
    columns = "states", "actions", "rewards", "next_states", "terminated", "low", "high"
    arrays = {name: getattr(source, name) for name in columns}
    name = [*arrays, "header"][rng.integers(len(arrays) + 1)]
    objects = np.empty(1, dtype=object)
    objects[0] = nested(rng)
    np.savez(content, **{"header": np.array("{}"), **arrays, name: objects})
    return ".npz", content.getvalue()


def a_pickle_by_another_name(rng, _):
    suffix = (".npz", ".zip", ".csv", ".pkl", ".pickle", "")[rng.integers(6)]
    return suffix, pickle.dumps(nested(rng), protocol(rng))


def pickled_by_sb3(rng, model):
    """One of the parts of a file that Stable-Baselines3 unpickles."""
    with zipfile.ZipFile(io.BytesIO(model)) as archive:
        data = json.loads(archive.read("data"))
    names = [name for name, value in data.items() if isinstance(value, dict) and ":serialized:" in value]
    pickled = base64.b64encode(pickle.dumps(nested(rng), protocol(rng))).decode()
    data[names[rng.integers(len(names))]] = {":type:": "text", ":serialized:": pickled}
    return ".zip", with_part(model, "data", json.dumps(data).encode())


KINDS = parameters, pickled_by_sb3, raw_pickle_as_parameters, named_class, objects_in_a_source, a_pickle_by_another_name


pytestmark = pytest.mark.filterwarnings("ignore:Detected pickle protocol")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.zip"
    small(transfer=METHODS["COMBREL"]()).learn(40).save(path)
    return path.read_bytes()


def readers(path):
    """All that this package reads files with."""
    learner = small()
    yield lambda: FittedRMax.load(path)
    yield lambda: learner.set_parameters(path)
    yield lambda: SourceInstances.load(path)
    yield lambda: learner.load_instances(path)
    yield lambda: FittedRMax(Walk(), transfer=COMBREL(str(path)))


def test_none_of_two_hundred_hostile_files_is_run(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for number in range(N_FILES):
        kind = KINDS[number % len(KINDS)]
        suffix, content = kind(rng, model)
        path = tmp_path / f"file_{number}{suffix}"
        path.write_bytes(content)
        chosen = list(readers(path))
        if kind is pickled_by_sb3:
            # Parameters alone are read without these parts.
            del chosen[1]
        for read in [chosen[k] for k in rng.choice(len(chosen), 2, replace=False)]:
            with pytest.raises((ValueError, FileNotFoundError)) as refused:
                read()
            assert "\n" not in str(refused.value)
        assert not (tmp_path / WITNESS).exists(), f"{kind.__name__} ran a program"


def test_the_witness_would_tell(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(Hostile()))
    assert (tmp_path / WITNESS).exists()
