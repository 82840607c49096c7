"""Mappings whose variables and actions are given by name."""

import json
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import FactoredMapping, InterTaskMapping, MappingSet
from sb3_combrel.common.serialisation import from_plain, to_plain
from sb3_combrel.mappings.inter_task_mapping import MappingNames
from sb3_combrel.mappings.named_sets import check_mappings, with_numbers

CAR = MappingNames(
    source_variables=("x", "v"),
    target_variables=("x", "y", "vx", "vy"),
    source_actions=("Neutral", "Left", "Right"),
    target_actions=("Neutral", "West", "East", "South", "North"),
)
BY_NUMBER = InterTaskMapping((0, None, 1, None), (0, 1, 2, 0, 0))
ACTIONS = {"Neutral": "Neutral", "West": "Left", "East": "Right", "South": "Neutral", "North": "Neutral"}
BY_NAME = {
    "sequences": InterTaskMapping(("x", None, "v", None), ("Neutral", "Left", "Right", "Neutral", "Neutral")),
    "dicts": InterTaskMapping({"x": "x", "vx": "v"}, ACTIONS),
    "dicts in another order": InterTaskMapping({"vx": "v", "y": None, "x": "x"}, dict(reversed(ACTIONS.items()))),
    "mixed": InterTaskMapping({0: "x", "vx": 1}, (0, "Left", 2, "Neutral", 0)),
    "numbers and signs": InterTaskMapping((0, None, 1, None), ACTIONS, (1, 1, 1, 1)),
    "dict of signs": InterTaskMapping((0, None, 1, None), (0, 1, 2, 0, 0), {"vy": -1}),
}


@pytest.mark.parametrize("name", BY_NAME)
def test_names_stand_for_numbers_once_both_tasks_are_known(name):
    mapping = BY_NAME[name]
    assert mapping.has_names and not BY_NUMBER.has_names and mapping.with_names(*CAR) == BY_NUMBER
    assert mapping.with_names(*CAR).names == CAR
    assert InterTaskMapping(mapping.state, mapping.action, mapping.sign, names=CAR) == BY_NUMBER


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_mapping_is_the_same_by_number_by_name_and_as_a_dict(data):
    state = data.draw(st.lists(st.sampled_from([None, 0, 1]), min_size=4, max_size=4).filter(any_mapped))
    action = data.draw(st.lists(st.integers(0, 2), min_size=5, max_size=5))
    sign = data.draw(st.lists(st.sampled_from([1, -1]), min_size=4, max_size=4))
    expected = InterTaskMapping(state, action, sign)
    variables = [None if k is None else CAR.source_variables[k] for k in state]
    actions = [CAR.source_actions[k] for k in action]
    assert InterTaskMapping(variables, actions, sign).with_names(*CAR) == expected
    pairs = dict(zip(CAR.target_variables, variables, strict=True)), dict(zip(CAR.target_actions, actions, strict=True))
    assert InterTaskMapping(*pairs, dict(zip(CAR.target_variables, sign, strict=True))).with_names(*CAR) == expected


def any_mapped(state):
    return any(k is not None for k in state)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"state": ("z", None, "v", None)}, "state must hold names of the source's variables, x, v, got 'z'"),
        (
            {"state": {"z": "x"}},
            "state must hold names of the target's variables, x, y, vx, vy, got 'z'; a task that names none",
        ),
        ({"state": {"x": "x", 0: "v"}}, "each of the target's variables once, got 0 twice"),
        ({"state": {7: "x"}}, "state must have keys from 0 to 3 or names, .* got 7"),
        ({"state": {"x": None}}, "state must map at least one target variable"),
        ({"action": ("Up",) * 5}, "action must hold names of the source's actions, Neutral, Left, Right, got 'Up'"),
        ({"action": {"West": "Left"}}, "source action for each target action, got none for Neutral, East, South, North"),
        ({"sign": {"x": 2}}, r"sign must have 4 entries, \+1 or -1"),
        ({"sign": {"z": -1}}, "sign must hold names of the target's variables"),
    ],
)
def test_names_that_stand_for_nothing_or_several_are_refused(change, message):
    mapping = InterTaskMapping(**{"state": {"x": "x"}, "action": ACTIONS, **change})
    with pytest.raises(ValueError, match=message):
        mapping.with_names(*CAR)
    with pytest.raises(ValueError, match="got 'x', which is the name of several"):
        BY_NAME["dicts"].with_names(*CAR._replace(source_variables=("x", "x")))


def test_what_needs_numbers_is_refused_while_there_are_names():
    mapping = BY_NAME["dicts"]
    asked = [
        lambda: mapping.state_index,
        lambda: mapping.n_target_variables,
        lambda: mapping.n_target_actions,
        lambda: mapping.mapped,
        lambda: mapping.source_action(0),
        lambda: mapping.source_to_target([[0.1, 0.2]], [0.0] * 4),
        lambda: mapping.check(n_source_variables=2, n_target_variables=4, n_source_actions=3, n_target_actions=5),
        lambda: MappingSet.from_list([mapping]),
    ]
    for each in asked:
        with pytest.raises(ValueError, match="has names, which stand for numbers only when both tasks are known"):
            each()


@pytest.mark.parametrize("name", BY_NAME)
def test_names_are_shown_compared_pickled_and_written(name):
    mapping = BY_NAME[name]
    assert eval(repr(mapping)) == mapping == pickle.loads(pickle.dumps(mapping)) == from_plain(to_plain(mapping))
    assert len({mapping, BY_NUMBER}) == 2


def test_factored_mappings_take_names_as_well():
    north = {"Neutral": "Neutral", "West": "Neutral", "East": "Neutral", "South": "Left", "North": "Right"}
    along_x, along_y = BY_NAME["dicts"], InterTaskMapping({"y": "x", "vy": "v"}, north)
    named = FactoredMapping([along_y, along_x])
    assert named.has_names and eval(repr(named)) == named
    expected = FactoredMapping([BY_NUMBER, InterTaskMapping((None, 0, None, 1), (0, 0, 0, 1, 2))])
    assert named.with_names(*CAR) == expected
    with pytest.raises(ValueError, match="copies must have no target variable in common"):
        FactoredMapping([along_x, along_x]).with_names(*CAR)


def test_whatever_a_user_gives_has_its_names_replaced():
    by_name = BY_NAME["dicts"]
    for given_so, expected in (
        (by_name, BY_NUMBER),
        ([by_name, BY_NUMBER], [BY_NUMBER, BY_NUMBER]),
        ({"state": {"x": "x", "vx": "v"}, "action": ACTIONS}, BY_NUMBER),
        ({"copies": [{"state": {"x": "x", "vx": "v"}, "action": ACTIONS}]}, FactoredMapping([BY_NUMBER])),
        *((name, name) for name in ("injective", "signed_all", "paper_icub", "factored", "signed_factored", "balanced")),
        (BY_NUMBER, BY_NUMBER),
    ):
        check_mappings(given_so)
        assert with_numbers(given_so, [CAR, CAR]) == expected
    turned = CAR._replace(source_variables=("v", "x"))
    with pytest.raises(ValueError, match="means different variables or actions in each of the source tasks: give numbers"):
        with_numbers(BY_NAME["dicts"], [CAR, turned])


@pytest.mark.parametrize(
    ("mappings", "message"),
    [
        ("bijective", "mappings must be one of injective"),
        ("signed_paper_icub", "mappings must be one of injective"),
        ([], "mappings must hold at least one InterTaskMapping"),
        ([3], "each of the mappings must be an InterTaskMapping"),
        (3, "mappings must be a name, an InterTaskMapping"),
        ({"state": [0]}, "each of the mappings must be"),
        ({"copies": []}, "copies must hold at least one"),
        ({"copies": [], "more": 1}, "must be a FactoredMapping or a dict of copies"),
    ],
)
def test_what_is_no_set_of_mappings_is_refused_before_the_tasks_are_known(mappings, message):
    with pytest.raises(ValueError, match=message):
        check_mappings(mappings)


# Factored mappings: what they refuse, how they read, and that they are written and read again.
FIRST = InterTaskMapping([0, None, 1, None], [0, 1, 2, 0, 0])
SECOND = InterTaskMapping([None, 0, None, 1], [0, 0, 0, 1, 2])
NAMES = (("x", "v"), ("x", "y", "vx", "vy"), ("Neutral", "Left", "Right"), ("Neutral", "West", "East", "South", "North"))


def test_it_says_what_each_target_action_does_to_each_copy():
    text = repr(FactoredMapping([SECOND, FIRST]).with_names(*NAMES))
    assert "East: Right on (x, vx), Neutral on (y, vy)" in text
    assert text.startswith("Neutral: Neutral on (x, vx), Neutral on (y, vy); West: Left on (x, vx), Neutral on (y, vy); ")
    mirrored = InterTaskMapping([None, 1, None, 0], [0, 0, 0, 1, 2], [1, 1, 1, -1])
    assert "Left on (-vy, y)" in repr(FactoredMapping([mirrored]).with_names(*NAMES))


def test_it_is_written_as_plain_data_and_read_again_and_made_of_dicts():
    mapping = FactoredMapping([FIRST, SECOND])
    assert from_plain(json.loads(json.dumps(to_plain(mapping)))) == mapping
    assert FactoredMapping([{"state": each.state, "action": each.action} for each in (FIRST, SECOND)]) == mapping


@pytest.mark.parametrize(
    ("copies", "says"),
    [
        ([], "at least one"),
        (FIRST, "copies must be a list"),
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
