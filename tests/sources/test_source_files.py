"""Files of source instances: nothing is changed on the way, and damage is reported in one sentence."""

import io
import json

import numpy as np
import pytest
import torch as th
from helpers.sources import assert_same, some_source
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import SourceInstances

SOURCE_BYTES = some_source(5).to_bytes()
SENTENCE = r"(^|source.npz: |model.npz: )these are not source instances, or they are cut short \([^\n]+\)"


@pytest.mark.parametrize("name", ["source.npz", "source", "source.v2"])
def test_saving_and_loading_changes_nothing(tmp_path, name):
    source = some_source()
    written = source.save(tmp_path / "new folder" / name)
    assert written.suffix == ".npz"
    assert_same(SourceInstances.load(tmp_path / "new folder" / name), source)
    assert_same(SourceInstances.load(written), source)
    # Nothing else is left in the folder.
    assert list(written.parent.iterdir()) == [written]


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = some_source().save(tmp_path / "source")
    monkeypatch.setattr(np, "savez_compressed", lambda *args, **kwargs: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        some_source(3, seed=1).save(path)
    assert_same(SourceInstances.load(path), some_source())
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_are_missing_cut_short_or_of_another_kind_are_reported(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no source file .*nowhere\.npz"):
        SourceInstances.load(tmp_path / "nowhere")
    path = tmp_path / "source.npz"
    for kept in (0.0, 0.3, 0.99):
        path.write_bytes(SOURCE_BYTES[: int(kept * len(SOURCE_BYTES))])
        with pytest.raises(ValueError, match=SENTENCE):
            SourceInstances.load(path)
    th.save({"a": 1}, tmp_path / "model.npz")
    with pytest.raises(ValueError, match=SENTENCE):
        SourceInstances.load(tmp_path / "model")


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_no_damage_escapes_as_another_error(data):
    content = bytearray(SOURCE_BYTES)
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(start + 8, len(content))))
        content[start:stop] = data.draw(st.binary(max_size=8))
    try:
        found = SourceInstances.from_bytes(bytes(content))
    except ValueError as error:
        assert str(error).startswith("these are not source instances")
    else:
        assert isinstance(found, SourceInstances)


@pytest.mark.parametrize(
    "change",
    [
        *[{"header": np.array("not json")}, {"header": {"format": "other"}}, {"header": {"version": 99}}],
        *[{"header": {"n_actions": 2.5}}, {"header": {"state_names": None}}],
        *[{"header": np.array([{"pickled": "object"}], dtype=object)}, {"states": None}],
        *[{"rewards": np.full(5, np.nan)}, {"actions": np.full((5, 1), 2**63, dtype=np.uint64)}],
    ],
)
def test_archives_with_other_contents_are_reported(change):
    with np.load(io.BytesIO(SOURCE_BYTES)) as archive:
        arrays = dict(archive)
    (name, value), changed = *change.items(), io.BytesIO()
    if isinstance(value, dict):
        value = np.array(json.dumps({**json.loads(str(arrays["header"])), **value}))
    arrays[name] = value
    np.savez(changed, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=SENTENCE):
        SourceInstances.from_bytes(changed.getvalue())
