"""Transfer objects as plain data: what comes back is what was written, and what cannot be written is refused."""

import copy
import json
import pathlib

import numpy as np
import pytest
from helpers.sources import assert_same, some_source
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.serialisation import KIND, from_plain, to_plain
from sb3_combrel.mappings import AllActionMappings, BalancedActionMappings, InterTaskMapping, ListedActionMappings, MappingSet


def there_and_back(value):
    """By way of text, as in a file."""
    return from_plain(json.loads(json.dumps(to_plain(value))))


@pytest.mark.parametrize(
    ("value", "comes_back"),
    [
        (None, None),
        (True, True),
        (3, 3),
        (0.1 + 0.2, 0.1 + 0.2),
        ("injective", "injective"),
        (np.float64(0.1), 0.1),
        (np.int32(7), 7),
        (np.bool_(True), True),
        (np.array([[1.5, 2.0], [3.0, 4.0]]), [[1.5, 2.0], [3.0, 4.0]]),
        ((1, None, "x"), [1, None, "x"]),
        (pathlib.PurePosixPath("a/b.npz"), "a/b.npz"),
        ({"state": (0, None), "action": [1, 0]}, {"state": [0, None], "action": [1, 0]}),
    ],
    ids=str,
)
def test_plain_values_and_arrays_come_back_as_plain_values(value, comes_back):
    back = there_and_back(value)
    assert back == comes_back
    assert type(back) is type(comes_back)


def test_a_mapping_comes_back_as_it_was_written():
    mapping = InterTaskMapping([0, None, 1], [1, 0], [1, -1, -1])
    assert there_and_back(mapping) == mapping
    assert there_and_back([mapping, {"one": mapping}]) == [mapping, {"one": mapping}]


SETS = {
    "injective": MappingSet.injective(2, 3, 2, 3),
    "signs": MappingSet([[0, 1], [1, -1]], AllActionMappings(2, 3), [[1, -1], [-1, 1]]),
    "balanced": MappingSet([[0, 1, 1]], BalancedActionMappings(2, 4)),
    "listed actions": MappingSet([[0, 1], [1, 0]], ListedActionMappings([[0, 2], [1, 1]], 4)),
    "list": MappingSet.from_list([InterTaskMapping([0, None], [1, 0]), InterTaskMapping([None, 1], [0, 0], [1, -1])]),
}


@pytest.mark.parametrize("mappings", SETS.values(), ids=SETS)
def test_a_set_of_mappings_comes_back_with_the_same_members(mappings):
    back = there_and_back(mappings)
    assert type(back) is type(mappings)
    assert list(back) == list(mappings)
    assert len(back) > 0


def test_source_instances_come_back_to_the_last_bit():
    source = some_source()
    assert_same(there_and_back({"source": [source]})["source"][0], source)


class SecretiveSet(MappingSet):
    """May contain more than would be written."""


@pytest.mark.parametrize(
    "value",
    [
        lambda n: n,
        object(),
        {1, 2},
        {1: "one"},
        b"bytes",
        1j,
        [[lambda n: n]],
        np.array([object()]),
        {KIND: "InterTaskMapping"},
        SecretiveSet([[0, 1]], AllActionMappings(2, 2)),
    ],
    ids=[
        "function",
        "object",
        "set",
        "number as key",
        "bytes",
        "complex",
        "function inside",
        "objects",
        "reserved key",
        "subclass",
    ],
)
def test_what_is_not_plain_is_refused(value):
    with pytest.raises(TypeError, match="plain data"):
        to_plain(value)


def test_unknown_kinds_are_refused_with_those_that_are_known():
    with pytest.raises(ValueError, match=r"'Sandwich' is not known; known are AllActionMappings, .*, SourceInstances"):
        from_plain([{"a": {KIND: "Sandwich"}}])


ONE = {KIND: "InterTaskMapping", "state": [0, None], "action": [1, 0], "sign": [-1, 1]}
FILES = {
    "mapping": (ONE, InterTaskMapping([0, None], [1, 0], [-1, 1])),
    "product": (
        {
            KIND: "MappingSet",
            "state_mappings": [[0, 1], [1, -1]],
            "signs": [[1, -1], [-1, 1]],
            "actions": {KIND: "AllActionMappings", "n_source_actions": 2, "n_target_actions": 3},
        },
        SETS["signs"],
    ),
    "balanced": (
        {
            KIND: "MappingSet",
            "state_mappings": [[0, 1, 1]],
            "signs": [[1, 1, 1]],
            "actions": {KIND: "BalancedActionMappings", "n_source_actions": 2, "n_target_actions": 4},
        },
        SETS["balanced"],
    ),
    "listed actions": (
        {
            KIND: "MappingSet",
            "state_mappings": [[0, 1], [1, 0]],
            "signs": [[1, 1], [1, 1]],
            "actions": {KIND: "ListedActionMappings", "mappings": [[0, 2], [1, 1]], "n_source_actions": 4},
        },
        SETS["listed actions"],
    ),
    "list": (
        {
            KIND: "ListedMappingSet",
            "mappings": [
                {"state": [0, None], "action": [1, 0], "sign": [1, 1]},
                {"state": [None, 1], "action": [0, 0], "sign": [1, -1]},
            ],
        },
        SETS["list"],
    ),
}


@pytest.mark.parametrize(("written", "expected"), FILES.values(), ids=FILES)
def test_the_written_format_is_that_of_the_first_version(written, expected):
    assert to_plain(expected) == written
    found = from_plain(written)
    if isinstance(expected, InterTaskMapping):
        assert found == expected
    else:
        assert list(found) == list(expected)
        assert type(found.actions) is type(expected.actions)


WRONG = st.recursive(
    st.sampled_from([None, True, -1, 0, 2**31, 2**63, -(10**30), 1.5, float("nan"), float("inf"), "", "x", "MappingSet"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", KIND, "state"]), inner, max_size=2),
    max_leaves=4,
)


def places(value, path=()):
    """Paths to everything within plain data."""
    yield path
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_damaged_objects_are_reported_in_one_sentence(data):
    """Entries are replaced, removed and added; what is still valid comes back as an object that can be used."""
    originals = [*(written for written, _ in FILES.values()), to_plain(some_source(4))]
    damaged = {"argument": copy.deepcopy(data.draw(st.sampled_from(originals)))}
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from([path for path in places(damaged) if path]))
        parent = damaged
        for key in path[:-1]:
            parent = parent[key]
        change = data.draw(st.sampled_from(["replace", "remove", "add"]))
        if change == "remove" and len(path) > 1:
            del parent[path[-1]]
        elif change == "add" and isinstance(parent[path[-1]], dict):
            parent[path[-1]]["extra"] = data.draw(WRONG)
        else:
            parent[path[-1]] = data.draw(WRONG)
    try:
        found = from_plain(damaged)
    except ValueError as error:
        assert "damaged" in str(error) or "is not known" in str(error)
        assert "\n" not in str(error)
    else:
        if isinstance(found["argument"], MappingSet):
            assert isinstance(found["argument"][0], InterTaskMapping)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sign": [1]}, "what was written of InterTaskMapping is damaged .*sign must have 2 entries"),
        ({"action": 3}, "what was written of InterTaskMapping is damaged .*action must be a sequence"),
        ({"state": [10**30, None]}, "what was written of InterTaskMapping is damaged .*state must hold indices up to"),
        ({"more": 1}, "what was written of InterTaskMapping is damaged .*unexpected keyword argument 'more'"),
        ({KIND: ["InterTaskMapping"]}, "an object of the kind .* is not known"),
    ],
)
def test_the_message_of_damage_names_the_kind_and_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        from_plain({**ONE, **change})


def test_a_missing_entry_of_a_list_is_named():
    with pytest.raises(ValueError, match=r"of ListedMappingSet is damaged \('sign' is missing\)"):
        from_plain({KIND: "ListedMappingSet", "mappings": [{"state": [0], "action": [0]}]})


def test_data_nested_without_end_is_refused():
    nested = []
    for _ in range(100_000):
        nested = [nested]
    with pytest.raises(ValueError, match="nested too deeply"):
        from_plain(nested)


@pytest.mark.parametrize("npz", ["", "AAAA", "no base64!", 5, None])
def test_source_instances_that_are_no_archive_are_refused(npz):
    with pytest.raises(ValueError, match="what was written of SourceInstances is damaged"):
        from_plain({KIND: "SourceInstances", "npz": npz})
