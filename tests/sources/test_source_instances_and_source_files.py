"""Source instances: their fields, the task they belong to, and subsets."""

import io
import json

import numpy as np
import pytest
import torch as th
from helpers.sources import assert_same, some_source
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import SourceInstances
from sb3_combrel.sources.subsets import covering_rows


def arguments(**changes):
    source = some_source(4)
    names = ("states", "actions", "rewards", "next_states", "terminated", "low", "high", "n_actions")
    return {**{name: getattr(source, name) for name in names}, **changes}


class TestSourceInstances:
    def test_names_have_defaults_and_arrays_are_fixed(self):
        source = SourceInstances(**arguments())
        assert source.state_names == ("s0", "s1") and source.action_names == ("a0", "a1", "a2")
        assert (len(source), source.n_variables) == (4, 2)
        np.testing.assert_array_equal(source.scaling.to_unit(source.states), source.states)
        with pytest.raises(ValueError, match="read-only"):
            source.states[0] = 0
        assert "4 source instances of an unnamed task" in repr(source)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"states": np.zeros((0, 2)), "actions": []}, "at least one instance"),
            ({"states": np.full((4, 2), np.nan)}, "states must be finite, .* instance 0"),
            ({"next_states": np.zeros((4, 3))}, r"next_states must have the shape \(4, 2\), got \(4, 3\)"),
            ({"rewards": np.array([0, 0, np.inf, 0])}, "rewards must be finite, got inf for instance 2"),
            ({"rewards": ["1", "2", "3", "4"]}, r"rewards must be numbers of shape \(4,\)"),
            ({"states": np.full((4, 2), "2020-01-01", "datetime64[D]")}, r"states must be numbers of shape \(4, 2\)"),
            ({"states": [[1, 2], [3]]}, r"states must be numbers of shape \(2, 2\)"),
            ({"actions": np.array([0, 1, 2, 3])}, "n_actions - 1 = 2, got 0 to 3"),
            ({"actions": np.zeros(4)}, "actions must be integers"),
            ({"terminated": np.zeros(4)}, "terminated must be booleans"),
            ({"low": np.ones(2)}, "below its upper bound"),
            ({"state_names": ("x",)}, "state_names must hold 2 names"),
            ({"action_names": ("x",)}, "action_names must hold 3 names"),
            ({"origin": {"env": object()}}, "origin must be a dict that JSON can hold"),
            ({"n_actions": 2.5}, "n_actions must be a whole number from 1 to 1,000,000"),
        ],
    )
    def test_wrong_arguments_are_named(self, changes, message):
        with pytest.raises(ValueError, match=message):
            SourceInstances(**arguments(**changes))


class TestSubset:
    @pytest.mark.parametrize("method", ["random", "covering"])
    @settings(max_examples=25, deadline=None)
    @given(n=st.integers(1, 60), seed=st.integers(0, 5))
    def test_a_subset_holds_different_instances_in_order_and_a_terminal_one(self, method, n, seed):
        source = some_source(40)
        subset = source.subset(n, method, seed)
        rows = [int(np.flatnonzero((source.states == state).all(axis=1))[0]) for state in subset.states]
        assert rows == sorted(set(rows)) and len(rows) == min(n, 40)
        np.testing.assert_array_equal(subset.rewards, source.rewards[rows])
        np.testing.assert_array_equal(subset.next_states, source.next_states[rows])
        assert subset.terminated.any()
        assert_same(subset, source.subset(n, method, seed))
        assert subset.origin["subset"] == {"method": method, "seed": seed, "chosen_from": 40}

    def test_a_covering_subset_is_never_farther_than_twice_the_best(self):
        # Farthest-point selection leaves no state farther than the least distance between two selected ones.
        rng = np.random.default_rng(3)
        points = rng.random((300, 2))
        rows = covering_rows(points, np.zeros(300, dtype=int), np.zeros(300, dtype=bool), 20, rng)
        distance = np.linalg.norm(points[:, None] - points[rows], axis=2)
        between = distance[rows]
        assert distance.min(axis=1).max() <= between[~np.eye(20, dtype=bool)].min()

    def test_a_covering_subset_shares_equally_among_actions(self):
        actions = np.repeat([0, 1, 2], [100, 5, 195])
        points = np.random.default_rng(0).random((300, 2))
        rows = covering_rows(points, actions, np.zeros(300, dtype=bool), 65, np.random.default_rng(0))
        assert np.bincount(actions[rows]).tolist() == [30, 5, 30]

    def test_equal_states_are_not_chosen_twice(self):
        rows = covering_rows(np.zeros((9, 2)), np.zeros(9, dtype=int), np.zeros(9, dtype=bool), 7, np.random.default_rng(0))
        assert len(set(rows.tolist())) == 7


# Files of source instances: nothing is changed on the way, and damage is reported in one sentence.
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
