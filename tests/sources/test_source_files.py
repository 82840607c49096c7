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
from sb3_combrel.sources.source_file import ARRAY_NAMES

SOURCE_BYTES = some_source(5).to_bytes()

# None of them fits five instances.
wrong_arrays = st.sampled_from(
    [
        np.zeros(0),
        np.zeros((3, 7)),
        np.array("text"),
        np.array(["a"] * 5),
        np.full(5, 1j),
        np.full((5, 2), np.nan),
        np.array([{"an": "object"}], dtype=object),
        np.array(5),
        np.full(5, "2020-01-01", dtype="datetime64[D]"),
        np.full((5, 1), 2**63, dtype=np.uint64),
        np.zeros(5, dtype=[("a", "i4")]),
    ]
)
wrong_entries = st.sampled_from([None, -1, 2.5, 10**30, float("nan"), "x", [1], [[]], ["a"] * 9])


class TestSourceFiles:
    @pytest.mark.parametrize("name", ["source.npz", "source", "source.v2"])
    def test_saving_and_loading_changes_nothing(self, tmp_path, name):
        source = some_source()
        written = source.save(tmp_path / "new folder" / name)
        assert written.suffix == ".npz"
        assert_same(SourceInstances.load(tmp_path / "new folder" / name), source)
        assert_same(SourceInstances.load(written), source)
        # Nothing else is left in the folder.
        assert list(written.parent.iterdir()) == [written]

    def test_a_failed_save_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = some_source().save(tmp_path / "source")
        monkeypatch.setattr(np, "savez_compressed", lambda *args, **kwargs: (_ for _ in ()).throw(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            some_source(3, seed=1).save(path)
        assert_same(SourceInstances.load(path), some_source())
        assert list(tmp_path.iterdir()) == [path]

    def test_a_missing_file_is_said_to_be_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no source file .*nowhere\.npz"):
            SourceInstances.load(tmp_path / "nowhere")

    @pytest.mark.parametrize("kept", [0.0, 0.3, 0.99])
    def test_a_truncated_file_is_reported(self, tmp_path, kept):
        path = some_source().save(tmp_path / "source")
        content = path.read_bytes()
        path.write_bytes(content[: int(kept * len(content))])
        with pytest.raises(ValueError, match=r"source\.npz is damaged or not a file of source instances"):
            SourceInstances.load(path)

    def test_no_damage_escapes_as_another_error(self, tmp_path):
        path = some_source(5).save(tmp_path / "source")
        content = path.read_bytes()
        rng = np.random.default_rng(0)
        refused = 0
        for _ in range(300):
            damaged = bytearray(content)
            for place in rng.integers(len(content), size=2):
                damaged[place] = rng.integers(256)
            path.write_bytes(damaged)
            try:
                SourceInstances.load(path)
            except ValueError as error:
                refused += 1
                assert "damaged" in str(error)
        assert refused > 100

    @settings(max_examples=300, deadline=None)
    @given(st.data())
    def test_damaged_bytes_are_reported_in_one_sentence(self, data):
        content = bytearray(SOURCE_BYTES)
        for _ in range(data.draw(st.integers(1, 4))):
            start = data.draw(st.integers(0, len(content)))
            stop = data.draw(st.integers(start, min(start + 8, len(content))))
            content[start:stop] = data.draw(st.binary(max_size=8))
        content = content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))]
        try:
            found = SourceInstances.from_bytes(bytes(content))
        except ValueError as error:
            assert str(error).startswith("the source instances are damaged (")
            assert "\n" not in str(error)
        else:
            assert isinstance(found, SourceInstances)

    @settings(max_examples=200, deadline=None)
    @given(st.sampled_from([*ARRAY_NAMES, "header"]), wrong_arrays | st.none())
    def test_archives_with_other_arrays_are_reported_in_one_sentence(self, name, array):
        with np.load(io.BytesIO(SOURCE_BYTES)) as archive:
            arrays = dict(archive)
        if array is None:
            del arrays[name]
        else:
            arrays[name] = array
        changed = io.BytesIO()
        np.savez(changed, **arrays)
        with pytest.raises(ValueError, match=r"^the source instances are damaged \(.+\)$"):
            SourceInstances.from_bytes(changed.getvalue())

    @settings(max_examples=200, deadline=None)
    @given(st.sampled_from(["format", "version", "n_actions", "state_names", "action_names", "origin"]), wrong_entries)
    def test_headers_with_other_entries_are_reported_in_one_sentence(self, name, value):
        with np.load(io.BytesIO(SOURCE_BYTES)) as archive:
            arrays = dict(archive)
        header = {**json.loads(str(arrays["header"])), name: value}
        changed = io.BytesIO()
        np.savez(changed, **{**arrays, "header": np.array(json.dumps(header))})
        with pytest.raises(ValueError, match=r"^the source instances are damaged \(.+\)$"):
            SourceInstances.from_bytes(changed.getvalue())

    @pytest.mark.parametrize(
        "content",
        [
            {"a": np.zeros(3)},
            {"header": np.array("not json")},
            {"header": np.array('{"format": "other"}')},
            {"header": np.array('{"format": "sb3_combrel.SourceInstances", "version": 99}')},
            {"header": np.array('["a list"]')},
            {"header": np.array([{"pickled": "object"}], dtype=object)},
        ],
    )
    def test_foreign_archives_are_reported(self, tmp_path, content):
        np.savez(tmp_path / "foreign.npz", **content)
        with pytest.raises(ValueError, match="not a file of source instances"):
            SourceInstances.load(tmp_path / "foreign")

    def test_pickles_and_single_arrays_are_reported(self, tmp_path):
        np.save(tmp_path / "array.npy", np.zeros(3))
        th.save({"a": 1}, tmp_path / "model.npz")
        for name in ("array.npy", "model.npz"):
            with pytest.raises(ValueError, match="not a file of source instances"):
                SourceInstances.load(tmp_path / name)

    def test_a_file_with_impossible_contents_is_reported(self, tmp_path):
        path = some_source().save(tmp_path / "source")
        with np.load(path) as archive:
            arrays = dict(archive)
        np.savez(path, **{**arrays, "rewards": np.full(40, np.nan)})
        with pytest.raises(ValueError, match=r"damaged .*rewards must be finite"):
            SourceInstances.load(path)
