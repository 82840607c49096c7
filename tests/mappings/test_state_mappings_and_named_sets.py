"""The state mappings of the named sets, against brute force over itertools."""

import itertools
from collections import Counter

import numpy as np
import pytest
from helpers.mappings import MOUNTAIN_CAR, SMALL_SIZES, choices

from sb3_combrel import InterTaskMapping, MappingSet
from sb3_combrel.mappings.inter_task_mapping import UNMAPPED
from sb3_combrel.mappings.named_sets import resolve
from sb3_combrel.mappings.state_mappings import copies_of_source


def is_injective(state, n_source):
    used = [i for i in state if i is not None]
    return len(used) == len(set(used)) == min(n_source, len(state))


def is_complete(state, n_source):
    return len({i for i in state if i is not None}) == min(n_source, len(state))


class TestStateMappings:
    @pytest.mark.parametrize(("n_source", "n_target"), SMALL_SIZES)
    @pytest.mark.parametrize(
        ("name", "belongs"),
        [
            ("injective", is_injective),
            ("all", is_complete),
            ("surjective", lambda state, n_source: None not in state and is_complete(state, n_source)),
        ],
    )
    def test_the_named_sets_have_the_members_that_their_definitions_ask_for(self, name, belongs, n_source, n_target):
        found = MappingSet.from_name(name, n_source, n_target, 1, 1)
        expected = [state for state in choices(n_source, n_target) if belongs(state, n_source)]
        assert Counter(mapping.state for mapping in found) == Counter(expected)

    @pytest.mark.parametrize(("n_source", "n_target"), [(1, 3), (2, 3), (3, 2)])
    def test_signs_add_every_mirrored_variant_once(self, n_source, n_target):
        plain = MappingSet.all(n_source, n_target, 1, 1)
        expected = {
            InterTaskMapping(mapping.state, (0,), sign)
            for mapping in plain
            for sign in itertools.product((1, -1), repeat=n_target)
        }
        found = list(MappingSet.all(n_source, n_target, 1, 1, signs=True))
        assert found == list(MappingSet.from_name("signed_all", n_source, n_target, 1, 1)) and set(found) == expected
        assert len(found) == len(expected)

    @pytest.mark.parametrize(
        ("name", "sizes", "message"),
        [
            *[("injective", (9, 9), "362,880"), ("signed_all", (20, 40), "")],
            *[("surjective", (50, 100), r"about 10\^166"), ("signed_surjective", (1, 70), r"about 10\^21")],
        ],
    )
    def test_too_many_state_mappings_are_refused_before_they_are_built(self, name, sizes, message):
        with pytest.raises(ValueError, match=f"{message} state mappings of that kind"):
            MappingSet.from_name(name, *sizes, 2, 2)

    @pytest.mark.parametrize(
        ("numbers", "message"),
        [
            ((10**6, 10**6), "n_source_variables must be a whole number from 1 to 1,000, got 1,000,000"),
            ((1, 10**5), "n_target_variables must be a whole number from 1 to 100, got 100,000"),
            ((2, 10**400), r"n_target_variables .*, got about 10\^400"),
            ((float("inf"), 4), "n_source_variables .*, got inf"),
            ((2.5, 4), "n_source_variables .*, got 2.5"),
            ((True, 4), "n_source_variables .*, got True"),
            (("2", 4), "n_source_variables .*, got '2'"),
        ],
    )
    def test_impossible_numbers_of_variables_are_refused(self, numbers, message):
        for name in ("injective", "surjective", "all", "balanced"):
            with pytest.raises(ValueError, match=message):
                MappingSet.from_name(name, *numbers, 3, 5)


def test_copies_of_a_source_are_all_its_parts_each_once():
    rows = copies_of_source(2, 4)
    assert len(rows) == len({tuple(row) for row in rows.tolist()}) == 4 * 3 + 2 * 4
    assert [sorted(row[row >= 0].tolist()) for row in rows] == [[0, 1]] * 12 + [[0]] * 4 + [[1]] * 4
    # A source with more variables than the target gives as many as there is room for.
    assert copies_of_source(3, 1).tolist() == [[0], [1], [2]]
    with pytest.raises(ValueError, match="more than"):
        copies_of_source(8, 12)
    assert np.array_equal(copies_of_source(1, 1), [[0]])


# What a user may write for a set of mappings, and the sets of the paper.
class TestPaperSets:
    def test_the_papers_mountain_car_set_has_24_state_and_90_action_mappings(self):
        mapping_set = MappingSet.paper_mountain_car()
        assert (mapping_set.n_state_mappings, mapping_set.n_action_mappings, len(mapping_set)) == (24, 90, 2160)
        assert len(set(mapping_set)) == 1080 and set(mapping_set) == set(MappingSet.balanced(**MOUNTAIN_CAR))
        assert len(mapping_set.candidates(0)[0]) == 12 * 3
        # Table 2: Left, Neutral, Right are source actions 1, 0, 2.
        table = "LLRNR LNRNR RNLRL RLLRN LNLRR NLRLR RNRLL LNRRN LNRRL".split()
        actions = {mapping_set.actions[i] for i in range(90)}
        assert {tuple("NLR".index(letter) for letter in row) for row in table} <= actions

    def test_the_papers_icub_set_has_24_state_and_48_action_mappings(self):
        mapping_set = MappingSet.paper_icub()
        assert (mapping_set.n_state_mappings, mapping_set.n_action_mappings, len(mapping_set)) == (24, 48, 1152)
        assert ((mapping_set.state_mappings == UNMAPPED).sum(axis=1) == 2).all()
        actions = {mapping_set.actions[i] for i in range(48)}
        assert len(actions) == 48
        for action in actions:
            joints = [b // 2 for b in action]
            assert joints[::2] == joints[1::2] and sorted(joints[::2]) == [0, 0, 1, 1]
            assert all({action[2 * j] % 2, action[2 * j + 1] % 2} == {0, 1} for j in range(4)) and action[0] % 2 == 1
        # Table 4, columns T1- T1+ ... T4+.
        table = [
            *("S1+ S1- S2+ S2- S2- S2+ S1+ S1-", "S1+ S1- S2+ S2- S2+ S2- S1+ S1-", "S1+ S1- S2+ S2- S1- S1+ S2+ S2-"),
            "S1+ S1- S1+ S1- S2- S2+ S2+ S2-",
        ]
        code = {"S1-": 0, "S1+": 1, "S2-": 2, "S2+": 3}
        assert {tuple(code[entry] for entry in row.split()) for row in table} <= actions


class TestResolve:
    @pytest.mark.parametrize(
        ("mappings", "size"),
        [
            ("injective", 2916),
            ("paper_mountain_car", 2160),
            (MappingSet.all(**MOUNTAIN_CAR), 12150),
            (InterTaskMapping((0, None, 1, None), (0,) * 5), 1),
            ({"state": [0, None, 1, None], "action": [1, 0, 2, 1, 1], "sign": [1, 1, -1, 1]}, 1),
            ([InterTaskMapping((0, None, 1, None), (0,) * 5), {"state": [0, 0, 1, 1], "action": [1] * 5}], 2),
        ],
    )
    def test_resolve_takes_names_sets_mappings_and_dicts(self, mappings, size):
        assert len(resolve(mappings, **MOUNTAIN_CAR)) == size

    @pytest.mark.parametrize(
        ("mappings", "message"),
        [
            ("bijective", "one of injective, .*, signed_injective, .*, paper_icub; .*factored.* got 'bijective'"),
            ("paper_icub", 'target with 4 state variables and 5 actions, got "paper_icub", which is for 4 and 8'),
            (MappingSet.injective(3, 4, 3, 5), "state must hold indices from 0 to 1"),
            ([InterTaskMapping((0,), (0,)), InterTaskMapping((0, 1), (0,))], "same numbers of target variables"),
        ],
    )
    def test_resolve_refuses_everything_else(self, mappings, message):
        with pytest.raises(ValueError, match=message):
            resolve(mappings, **MOUNTAIN_CAR)
