"""Transfer objects as plain data: what comes back is what was written, and what cannot be written is refused."""

import json
import pathlib

import numpy as np
import pytest
from helpers.sources import assert_same, some_source

from sb3_combrel import InterTaskMapping, MappingSet
from sb3_combrel.common.serialisation import KIND, from_plain, to_plain
from sb3_combrel.mappings.action_mappings import AllActionMappings, BalancedActionMappings, ListedActionMappings


def there_and_back(value):
    """By way of text, as in a file."""
    return from_plain(json.loads(json.dumps(to_plain(value))))


@pytest.mark.parametrize(
    ("value", "comes_back"),
    [
        *[(None, None), (True, True), (3, 3), (0.1 + 0.2, 0.1 + 0.2), ("injective", "injective")],
        *[(np.float64(0.1), 0.1), (np.int32(7), 7), (np.bool_(True), True)],
        *[(np.array([[1.5, 2.0], [3.0, 4.0]]), [[1.5, 2.0], [3.0, 4.0]]), ((1, None, "x"), [1, None, "x"])],
        (pathlib.PurePosixPath("a/b.npz"), "a/b.npz"),
        ({"state": (0, None), "action": [1, 0]}, {"state": [0, None], "action": [1, 0]}),
    ],
    ids=str,
)
def test_plain_values_and_arrays_come_back_as_plain_values(value, comes_back):
    back = there_and_back(value)
    assert back == comes_back and type(back) is type(comes_back)


SETS = {
    "injective": MappingSet.injective(2, 3, 2, 3),
    "signs": MappingSet([[0, 1], [1, -1]], AllActionMappings(2, 3), [[1, -1], [-1, 1]]),
    "balanced": MappingSet([[0, 1, 1]], BalancedActionMappings(2, 4)),
    "listed actions": MappingSet([[0, 1], [1, 0]], ListedActionMappings([[0, 2], [1, 1]], 4)),
    "list": MappingSet.from_list([InterTaskMapping([0, None], [1, 0]), InterTaskMapping([None, 1], [0, 0], [1, -1])]),
}


def test_source_instances_come_back_to_the_last_bit():
    source = some_source()
    assert_same(there_and_back({"source": [source]})["source"][0], source)


class SecretiveSet(MappingSet):
    """May contain more than would be written."""


@pytest.mark.parametrize(
    "value",
    [
        *[object(), {1: "one"}, b"bytes", [[lambda n: n]], np.array([object()]), {KIND: "InterTaskMapping"}],
        SecretiveSet([[0, 1]], AllActionMappings(2, 2)),
    ],
    ids=["object", "number as key", "bytes", "function inside", "objects", "reserved key", "subclass"],
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
def test_mappings_and_sets_are_written_and_read_in_the_format_of_files(written, expected):
    assert to_plain(expected) == written
    found = there_and_back({"argument": [expected]})["argument"][0]
    if isinstance(expected, InterTaskMapping):
        assert found == expected
    else:
        assert len(found) > 0 and list(found) == list(expected)
        assert type(found) is type(expected) and type(found.actions) is type(expected.actions)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ({**ONE, "sign": [1]}, "what was written of InterTaskMapping is damaged .*sign must have 2 entries"),
        ({**ONE, "more": 1}, "what was written of InterTaskMapping is damaged .*unexpected keyword argument 'more'"),
        ({**ONE, KIND: ["InterTaskMapping"]}, "an object of the kind .* is not known"),
        ({KIND: "ListedMappingSet", "mappings": [{"state": [0], "action": [0]}]}, r"damaged \('sign' is missing\)"),
        ({KIND: "SourceInstances", "npz": "AAAA"}, "what was written of SourceInstances is damaged"),
    ],
)
def test_the_message_of_damage_names_the_kind_and_what_is_wrong(written, message):
    with pytest.raises(ValueError, match=message):
        from_plain(written)
