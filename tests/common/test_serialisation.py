"""Transfer objects as plain data: what comes back is what was written, and what cannot be written is refused."""

import json
import pathlib

import numpy as np
import pytest

from sb3_combrel.common.serialisation import KIND, from_plain, to_plain
from sb3_combrel.mappings.mapping_factors import AllActionMappings, BalancedActionMappings, ListedActionMappings
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances


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
def test_numbers_text_arrays_and_what_they_are_in(value, comes_back):
    back = there_and_back(value)
    assert back == comes_back
    assert type(back) is type(comes_back)


def test_a_mapping():
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
def test_a_set_of_mappings(mappings):
    back = there_and_back(mappings)
    assert type(back) is type(mappings)
    assert list(back) == list(mappings)
    assert len(back) > 0


def test_source_instances_to_the_last_bit():
    rng = np.random.default_rng(0)
    source = SourceInstances(
        states=rng.normal(size=(9, 2)),
        actions=rng.integers(3, size=9),
        rewards=rng.normal(size=9),
        next_states=rng.normal(size=(9, 2)),
        terminated=rng.random(9) < 0.5,
        low=[-9.0, -8.0],
        high=[9.0, 8.0],
        n_actions=3,
        state_names=("x", "ü"),
        origin={"env": "a/b"},
    )
    back = there_and_back({"source": [source]})["source"][0]
    for name in ("states", "actions", "rewards", "next_states", "terminated", "low", "high"):
        np.testing.assert_array_equal(getattr(back, name), getattr(source, name))
    for name in ("n_actions", "state_names", "action_names", "origin"):
        assert getattr(back, name) == getattr(source, name)


class SecretiveSet(MappingSet):
    """May hold more than would be written."""


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
    with pytest.raises(ValueError, match=r"'Sandwich' is not known; known are SourceInstances, InterTaskMapping"):
        from_plain([{"a": {KIND: "Sandwich"}}])
