"""Factored mappings: what they refuse, how they read, and that they are written and read again."""

import json

import pytest

from sb3_combrel import FactoredMapping, InterTaskMapping
from sb3_combrel.common.serialisation import from_plain, to_plain

FIRST = InterTaskMapping([0, None, 1, None], [0, 1, 2, 0, 0])
SECOND = InterTaskMapping([None, 0, None, 1], [0, 0, 0, 1, 2])
NAMES = (("x", "v"), ("x", "y", "vx", "vy"), ("Neutral", "Left", "Right"), ("Neutral", "West", "East", "South", "North"))


def test_it_says_what_each_target_action_does_to_each_copy():
    text = repr(FactoredMapping([SECOND, FIRST]).with_names(*NAMES))
    assert "East: Right on (x, vx), Neutral on (y, vy)" in text
    assert text.startswith("Neutral: Neutral on (x, vx), Neutral on (y, vy); West: Left on (x, vx), Neutral on (y, vy); ")
    mirrored = InterTaskMapping([None, 1, None, 0], [0, 0, 0, 1, 2], [1, 1, 1, -1])
    assert "Left on (-vy, y)" in repr(FactoredMapping([mirrored]).with_names(*NAMES))


def test_without_names_its_repr_makes_it_again():
    mapping = FactoredMapping([SECOND, FIRST])
    assert eval(repr(mapping)) == mapping
    assert mapping.copies == (FIRST, SECOND)


def test_it_is_written_as_plain_data_and_read_again_and_made_of_dicts():
    mapping = FactoredMapping([FIRST, SECOND])
    assert from_plain(json.loads(json.dumps(to_plain(mapping)))) == mapping
    assert FactoredMapping([{"state": each.state, "action": each.action} for each in (FIRST, SECOND)]) == mapping


@pytest.mark.parametrize(
    ("copies", "says"),
    [
        ([], "at least one"),
        (FIRST, "copies must be a list"),
        ("factored", "copies must be a list"),
        ({"state": [0], "action": [0]}, "copies must be a list"),
        ([FIRST, 3], "got 3"),
        ([{"state": [0]}], "dict of state, action"),
        ([FIRST, InterTaskMapping([0, None, 1], [0, 1, 2, 0, 0])], "same numbers"),
        ([FIRST, InterTaskMapping([None, 0, None, 1], [0, 1])], "same numbers"),
        ([FIRST, InterTaskMapping([None, 0, 1, None], [0, 0, 0, 1, 2])], "no target variable in common, got variable 2"),
    ],
)
def test_what_is_no_division_of_the_target_is_refused(copies, says):
    with pytest.raises(ValueError, match=says):
        FactoredMapping(copies)


def test_it_is_checked_against_both_tasks():
    mapping = FactoredMapping([FIRST, SECOND])
    fits = dict(n_source_variables=2, n_target_variables=4, n_source_actions=3, n_target_actions=5)
    mapping.check(**fits)
    wrong = dict(n_source_variables=1, n_target_variables=5, n_source_actions=2, n_target_actions=4)
    for name, number in wrong.items():
        with pytest.raises(ValueError, match=r"state must|action must"):
            mapping.check(**{**fits, name: number})
