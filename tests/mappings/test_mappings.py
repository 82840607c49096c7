"""Inter-task mappings and their sets, against brute force over itertools."""

import copy
import itertools
import pickle
import tracemalloc
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.mappings.mapping_factors import AllActionMappings, BalancedActionMappings, ListedActionMappings
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet, resolve

MOUNTAIN_CAR = {"n_source_variables": 2, "n_target_variables": 4, "n_source_actions": 3, "n_target_actions": 5}
SMALL_SIZES = [(n_s, n_t) for n_s in range(1, 4) for n_t in range(1, 5)]


def choices(n_source, n_target):
    """All state mappings whatsoever, as a brute-force starting point."""
    return itertools.product([None, *range(n_source)], repeat=n_target)


def is_injective(state, n_source):
    used = [i for i in state if i is not None]
    return len(used) == len(set(used)) == min(n_source, len(state))


def is_complete(state, n_source):
    return len({i for i in state if i is not None}) == min(n_source, len(state))


@st.composite
def mappings(draw, n_source=3, n_target=4):
    state = draw(st.tuples(*[st.sampled_from([None, *range(n_source)])] * n_target).filter(lambda s: s != (None,) * n_target))
    sign = draw(st.tuples(*[st.sampled_from([1, -1])] * n_target))
    action = draw(st.tuples(*[st.integers(0, 2)] * 5))
    return InterTaskMapping(state, action, sign)


units = st.lists(st.floats(-0.5, 1.5), min_size=12, max_size=12)


class TestInterTaskMapping:
    @given(mappings(), units, st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_source_to_target_and_back_is_the_identity_on_used_variables(self, mapping, source, current):
        source = np.array(source).reshape(4, 3)
        back = mapping.target_to_source(mapping.source_to_target(source, current), 3)
        used = sorted({i for i in mapping.state if i is not None})
        np.testing.assert_allclose(back[:, used], source[:, used], atol=1e-12)
        assert np.isnan(np.delete(back, used, axis=1)).all()

    @given(mappings(), units, st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_translation_agrees_with_a_loop_over_variables(self, mapping, source, current):
        source = np.array(source).reshape(4, 3)
        translated = mapping.source_to_target(source, current)
        for row in range(4):
            for i, (k, sign) in enumerate(zip(mapping.state, mapping.sign, strict=True)):
                expected = current[i] if k is None else source[row, k] if sign == 1 else 1 - source[row, k]
                assert translated[row, i] == pytest.approx(expected, abs=1e-12)

    @given(mappings(), units, units, st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_the_displacement_is_the_difference_of_translated_states(self, mapping, start, end, current):
        start, end = np.array(start).reshape(4, 3), np.array(end).reshape(4, 3)
        difference = mapping.source_to_target(end, current) - mapping.source_to_target(start, current)
        np.testing.assert_allclose(mapping.displacement_to_target(end - start), difference, atol=1e-12)
        assert (difference[:, ~mapping.mapped] == 0).all()

    def test_two_target_variables_on_one_source_variable_meet_at_their_mean(self):
        mapping = InterTaskMapping((0, 0, 1), (0,), (1, -1, 1))
        np.testing.assert_allclose(mapping.target_to_source([0.2, 0.4, 0.9], 2), [0.4, 0.9])

    def test_each_instance_may_have_its_own_target_state(self):
        mapping = InterTaskMapping((0, None), (0,))
        current = [[0.1, 0.2], [0.3, 0.4]]
        np.testing.assert_allclose(mapping.source_to_target([[0.5], [0.6]], current), [[0.5, 0.2], [0.6, 0.4]])

    def test_actions_translate_both_ways(self):
        mapping = InterTaskMapping((0, None, 1, None), (1, 0, 2, 1, 1))
        assert [mapping.source_action(a) for a in range(5)] == [1, 0, 2, 1, 1]
        assert [mapping.target_actions(b).tolist() for b in range(4)] == [[1], [0, 3, 4], [2], []]

    def test_arrays_for_compiled_loops(self):
        mapping = InterTaskMapping((0, None, 1, None), (0,), (1, 1, -1, -1))
        assert mapping.state_index.dtype == np.int64
        assert mapping.state_index.tolist() == [0, -1, 1, -1]
        # The sign of an unmapped variable has no effect, so it does not make mappings differ either.
        assert mapping.state_sign.tolist() == [1.0, 1.0, -1.0, 1.0]
        assert mapping == InterTaskMapping([0, None, np.int64(1), None], [0], np.array([1, 1, -1, 1]))

    @given(mappings())
    def test_repr_without_names_can_be_evaluated(self, mapping):
        assert eval(repr(mapping)) == mapping

    def test_repr_with_names_shows_what_stands_for_what(self):
        mapping = InterTaskMapping((0, None, 1, None), (0, 1, 2, 0, 0), (1, 1, -1, 1)).with_names(
            ["x", "v"],
            ["x", "y", "vx", "vy"],
            ["Neutral", "Left", "Right"],
            ["Neutral", "West", "East", "South", "North"],
        )
        assert repr(mapping) == (
            "InterTaskMapping(x<-x, vx<-(-v); Neutral<-Neutral, West<-Left, East<-Right, South<-Neutral, North<-Neutral)"
        )
        assert mapping == InterTaskMapping(mapping.state, mapping.action, mapping.sign)
        with pytest.raises(ValueError, match="target_variables must hold 4 names"):
            mapping.with_names("xv", "xy", "abc", "abcde")

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (((None, None), (0,)), "state must map at least one"),
            (((0,), ()), "action must hold one"),
            (((0.5,), (0,)), "state must hold integers or None, got the entry 0.5"),
            (((-1,), (0,)), "state must hold integers from 0 on or None, got the entry -1"),
            (((0,), (None,)), "action must hold integers, got the entry None"),
            (((True,), (0,)), "state .* entry True"),
            (("01", (0,)), "state must be a sequence"),
            (((0,), (0,), (1, 1)), r"sign must have 1 entries"),
            (((0,), (0,), (0,)), r"sign must hold \+1 and -1 only"),
        ],
    )
    def test_wrong_arguments_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            InterTaskMapping(*arguments)

    @pytest.mark.parametrize(
        ("state", "action", "message"),
        [
            ((0, None, 1), (0,) * 5, "state must have 4 entries, .* got 3"),
            ((0, None, 2, None), (0,) * 5, "state must hold indices from 0 to 1, .* got 2"),
            ((0, None, 1, None), (0,) * 4, "action must have 5 entries, .* got 4"),
            ((0, None, 1, None), (0, 0, 0, 0, 3), "action must hold indices from 0 to 2, .* got 3"),
        ],
    )
    def test_check_says_what_does_not_fit_the_tasks(self, state, action, message):
        mapping = InterTaskMapping(state, action)
        for check in (mapping.check, MappingSet.from_list([mapping]).check):
            with pytest.raises(ValueError, match=message):
                check(**MOUNTAIN_CAR)

    def test_translation_refuses_other_shapes(self):
        mapping = InterTaskMapping((0, None, 1, None), (0,))
        with pytest.raises(ValueError, match=r"target_units must have the shape \(..., 4\)"):
            mapping.target_to_source(np.zeros((3, 2)), 2)
        with pytest.raises(ValueError, match="n_source_variables must be above 1"):
            mapping.target_to_source(np.zeros((3, 4)), 1)
        with pytest.raises(ValueError, match="source_units must have the shape"):
            mapping.source_to_target(np.zeros((3, 1)), np.zeros(4))


class TestStateFactor:
    @pytest.mark.parametrize(("n_source", "n_target"), SMALL_SIZES)
    @pytest.mark.parametrize(
        ("name", "belongs"),
        [
            ("injective", is_injective),
            ("all", is_complete),
            ("surjective", lambda state, n_source: None not in state and is_complete(state, n_source)),
        ],
    )
    def test_the_named_sets_hold_what_they_say(self, name, belongs, n_source, n_target):
        found = MappingSet.from_name(name, n_source, n_target, 1, 1)
        expected = [state for state in choices(n_source, n_target) if belongs(state, n_source)]
        assert Counter(mapping.state for mapping in found) == Counter(expected)

    def test_sizes_from_mountain_car_2d_to_4d(self):
        sizes = {name: MappingSet.from_name(name, **MOUNTAIN_CAR) for name in ("injective", "surjective", "all", "balanced")}
        factors = {name: (each.n_state_mappings, each.n_action_mappings) for name, each in sizes.items()}
        assert factors == {"injective": (12, 243), "surjective": (14, 243), "all": (50, 243), "balanced": (12, 90)}

    @pytest.mark.parametrize("name", ["injective", "surjective", "all", "balanced"])
    def test_signed_sets_have_names_too(self, name):
        numbers = (2, 4, 1, 2)
        signed = MappingSet.from_name(name, *numbers, signs=True)
        assert list(MappingSet.from_name(f"signed_{name}", *numbers)) == list(signed)
        assert len(signed) > len(MappingSet.from_name(name, *numbers))

    @pytest.mark.parametrize(("n_source", "n_target"), [(1, 3), (2, 3), (3, 2)])
    def test_signs_add_every_mirrored_variant_once(self, n_source, n_target):
        plain = MappingSet.all(n_source, n_target, 1, 1)
        expected = {
            InterTaskMapping(mapping.state, (0,), sign)
            for mapping in plain
            for sign in itertools.product((1, -1), repeat=n_target)
        }
        found = list(MappingSet.all(n_source, n_target, 1, 1, signs=True))
        assert set(found) == expected
        assert len(found) == len(expected)

    def test_too_many_state_mappings_are_refused_before_they_are_built(self):
        with pytest.raises(ValueError, match=r"362,880 state mappings .* practical"):
            MappingSet.injective(9, 9, 2, 2)
        with pytest.raises(ValueError, match="state mappings of that kind"):
            MappingSet.all(20, 40, 2, 2, signs=True)


class TestActionFactor:
    @pytest.mark.parametrize(("n_source", "n_target"), SMALL_SIZES)
    def test_all_functions_in_order(self, n_source, n_target):
        found = AllActionMappings(n_source, n_target)
        assert [found[i] for i in range(found.n_mappings)] == list(itertools.product(range(n_source), repeat=n_target))

    @pytest.mark.parametrize(("n_source", "n_target"), [*SMALL_SIZES, (3, 5), (4, 5), (5, 3)])
    def test_balanced_functions_are_those_whose_uses_differ_by_at_most_one(self, n_source, n_target):
        expected = []
        for action in itertools.product(range(n_source), repeat=n_target):
            uses = [action.count(b) for b in range(n_source)]
            if max(uses) - min(uses) <= 1:
                expected.append(action)
        found = BalancedActionMappings(n_source, n_target)
        assert [found[i] for i in range(found.n_mappings)] == expected

    @pytest.mark.parametrize(
        "actions",
        [
            AllActionMappings(3, 4),
            BalancedActionMappings(3, 5),
            BalancedActionMappings(3, 4),
            BalancedActionMappings(4, 2),
            ListedActionMappings([[0, 2, 2], [2, 0, 2], [0, 0, 1]], n_source_actions=4),
        ],
    )
    def test_counts_and_first_members(self, actions):
        listed = [actions[i] for i in range(actions.n_mappings)]
        for a in range(actions.n_target_actions):
            assert actions.source_actions_for(a).tolist() == sorted({action[a] for action in listed})
            for b in range(actions.n_source_actions + 1):
                members = [i for i, action in enumerate(listed) if action[a] == b]
                assert actions.count(a, b) == len(members)
                if members:
                    assert actions.first(a, b) == members[0]
                else:
                    with pytest.raises(ValueError, match=f"no mapping of the set maps target action {a}"):
                        actions.first(a, b)

    def test_numbers_out_of_range_are_refused(self):
        for actions in (AllActionMappings(3, 2), BalancedActionMappings(3, 2), ListedActionMappings([[0, 1]])):
            with pytest.raises(IndexError):
                actions[actions.n_mappings]


def check_against_members(mapping_set, n_source_actions):
    """Compare every look-up with a search through all members."""
    members = list(mapping_set)
    key = [(mapping.state, mapping.sign) for mapping in members]
    rows = [
        (tuple(None if i < 0 else i for i in state.tolist()), tuple(sign.tolist()))
        for state, sign in zip(mapping_set.state_mappings, mapping_set.signs, strict=True)
    ]
    for a in range(mapping_set.n_target_actions):
        expected = {(k, mapping.action[a]) for k, mapping in zip(key, members, strict=True)}
        states, source_actions = mapping_set.candidates(a)
        assert states.dtype == source_actions.dtype == np.int64
        found = [(rows[s], b) for s, b in zip(states.tolist(), source_actions.tolist(), strict=True)]
        assert len(found) == len(expected)
        assert set(found) == expected
        assert mapping_set.source_actions_for(a).tolist() == sorted({b for _, b in expected})
        for s, row in enumerate(rows):
            for b in range(n_source_actions):
                matching = [i for i, mapping in enumerate(members) if key[i] == row and mapping.action[a] == b]
                assert mapping_set.count(s, a, b) == len(matching)
                if matching:
                    assert mapping_set.find(s, a, b) == matching[0]
                else:
                    with pytest.raises(ValueError, match="no mapping of the set"):
                        mapping_set.find(s, a, b)


class TestMappingSet:
    @pytest.mark.parametrize(
        "mapping_set",
        [
            MappingSet.injective(2, 3, 2, 3),
            MappingSet.all(1, 2, 2, 2, signs=True),
            MappingSet.balanced(2, 2, 2, 3),
            # Equal state mappings in several rows, as in the paper's layings.
            MappingSet([[0, -1], [-1, 0], [0, -1]], [[0, 1], [1, 1]], signs=[[1, -1], [1, 1], [1, 1]]),
        ],
    )
    def test_lookups_agree_with_a_search_through_the_members(self, mapping_set):
        assert len(mapping_set) == len(list(mapping_set)) == mapping_set.n_state_mappings * mapping_set.n_action_mappings
        check_against_members(mapping_set, 2)

    @settings(max_examples=30, deadline=None)
    @given(st.lists(mappings(n_source=2, n_target=2), min_size=1, max_size=8))
    def test_a_list_holds_exactly_its_mappings_in_order(self, listed):
        mapping_set = MappingSet.from_list(listed)
        assert list(mapping_set) == listed
        check_against_members(mapping_set, 3)

    def test_members_by_number(self):
        mapping_set = MappingSet.injective(**MOUNTAIN_CAR)
        assert mapping_set[-1] == list(mapping_set)[2915]
        assert mapping_set[np.int64(7)] == mapping_set[7]
        for index in (2916, -2917):
            with pytest.raises(IndexError, match="2916"):
                mapping_set[index]

    def test_millions_of_pairs_cost_no_memory(self):
        tracemalloc.start()
        mapping_set = MappingSet.injective(2, 4, 8, 8)
        balanced = MappingSet.balanced(2, 4, 8, 16)
        ends = mapping_set[0], mapping_set[-1], balanced[-1], next(iter(mapping_set))
        candidates = mapping_set.candidates(3)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(mapping_set) == 12 * 8**8
        assert len(balanced) == 12 * 81_729_648_000
        assert ends[0].action == (0,) * 8
        assert ends[1].action == (7,) * 8
        assert ends[2].action == tuple(b for b in range(7, -1, -1) for _ in range(2))
        assert len(candidates.state_index) == 12 * 8
        assert peak < 1_000_000

    def test_sets_that_len_cannot_count_still_have_a_size(self):
        mapping_set = MappingSet.injective(1, 1, 10, 30)
        assert mapping_set.n_mappings == 10**30
        assert mapping_set[10**30 - 1].action == (9,) * 30

    def test_the_papers_mountain_car_factors(self):
        mapping_set = MappingSet.paper_mountain_car()
        assert (mapping_set.n_state_mappings, mapping_set.n_action_mappings, len(mapping_set)) == (24, 90, 2160)
        assert len(set(mapping_set)) == 1080
        assert set(mapping_set) == set(MappingSet.balanced(**MOUNTAIN_CAR))
        assert len(mapping_set.candidates(0).state_index) == 12 * 3
        # Table 2: Left, Neutral, Right are source actions 1, 0, 2.
        table = "LLRNR LNRNR RNLRL RLLRN LNLRR NLRLR RNRLL LNRRN LNRRL".split()
        actions = {mapping_set.actions[i] for i in range(90)}
        assert {tuple("NLR".index(letter) for letter in row) for row in table} <= actions

    def test_the_papers_icub_factors(self):
        mapping_set = MappingSet.paper_icub()
        assert (mapping_set.n_state_mappings, mapping_set.n_action_mappings, len(mapping_set)) == (24, 48, 1152)
        actions = {mapping_set.actions[i] for i in range(48)}
        assert len(actions) == 48
        for action in actions:
            joints = [b // 2 for b in action]
            assert joints[::2] == joints[1::2]
            assert sorted(joints[::2]) == [0, 0, 1, 1]
            assert all({action[2 * j] % 2, action[2 * j + 1] % 2} == {0, 1} for j in range(4))
            assert action[0] % 2 == 1
        # Table 4, columns T1- T1+ ... T4+.
        table = [
            "S1+ S1- S2+ S2- S2- S2+ S1+ S1-",
            "S1+ S1- S2+ S2- S2+ S2- S1+ S1-",
            "S1+ S1- S2+ S2- S1- S1+ S2+ S2-",
            "S1+ S1- S1+ S1- S2- S2+ S2+ S2-",
        ]
        code = {"S1-": 0, "S1+": 1, "S2-": 2, "S2+": 3}
        assert {tuple(code[entry] for entry in row.split()) for row in table} <= actions

    def test_names_reach_the_members(self):
        named = MappingSet.injective(1, 1, 1, 1).with_names(["v"], ["vx"], ["Go"], ["East"])
        assert repr(named[0]) == "InterTaskMapping(vx<-v; East<-Go)"

    def test_copies_and_pickles_are_alike(self):
        for mapping_set in (MappingSet.balanced(**MOUNTAIN_CAR), MappingSet.from_list([InterTaskMapping((0,), (1, 0))])):
            for copied in (copy.deepcopy(mapping_set), pickle.loads(pickle.dumps(mapping_set))):
                assert list(copied) == list(mapping_set)

    @pytest.mark.parametrize("method", ["candidates", "source_actions_for"])
    @pytest.mark.parametrize("action", [-1, 5])
    def test_unknown_target_actions_are_refused(self, method, action):
        with pytest.raises(ValueError, match="action must be a target action from 0 to 4"):
            getattr(MappingSet.injective(**MOUNTAIN_CAR), method)(action)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (([0, 1], [[0]]), "state_mappings must be integers of shape"),
            (([[0.5]], [[0]]), "state_mappings must be integers"),
            (([[-1]], [[0]]), "at least one of them not -1"),
            (([[-2, 0]], [[0]]), "-1 for None"),
            (([[0]], [0]), "action mappings must be integers of shape"),
            (([[0]], [[-1]]), "source actions from 0"),
            (([[0]], [[0]], [[2]]), r"signs must hold \+1 and -1"),
        ],
    )
    def test_wrong_factors_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            MappingSet(*arguments)


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
    def test_what_a_user_may_write(self, mappings, size):
        assert len(resolve(mappings, **MOUNTAIN_CAR)) == size

    @pytest.mark.parametrize(
        ("mappings", "message"),
        [
            ("bijective", "one of injective, .*, signed_injective, .*, paper_mountain_car, paper_icub, got 'bijective'"),
            (3, "mappings must be a name, .* got 3"),
            ([], "at least one InterTaskMapping"),
            ([3], "each of the mappings must be"),
            ({"state": [0]}, "each of the mappings must be"),
            ("paper_icub", "action must have 5 entries, .* got 8"),
            (MappingSet.injective(3, 4, 3, 5), "state must hold indices from 0 to 1"),
            (MappingSet.injective(2, 4, 4, 5), "action must hold indices from 0 to 2"),
            ([InterTaskMapping((0,), (0,)), InterTaskMapping((0, 1), (0,))], "same numbers of target variables"),
        ],
    )
    def test_everything_else_is_refused(self, mappings, message):
        with pytest.raises(ValueError, match=message):
            resolve(mappings, **MOUNTAIN_CAR)
