"""Sets of mappings: members, look-ups against a search through all members, copies, and what they refuse."""

import copy
import pickle

import numpy as np
import pytest
from helpers.mappings import MOUNTAIN_CAR, mappings
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import InterTaskMapping, MappingSet
from sb3_combrel.mappings.action_mappings import AllActionMappings, ListedActionMappings


def check_against_members(mapping_set):
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
        assert len(found) == len(expected) and set(found) == expected
        assert mapping_set.source_actions_for(a).tolist() == sorted({b for _, b in expected})
        for s, b in zip(states.tolist(), source_actions.tolist(), strict=True):
            one = mapping_set.of_candidate(s, b)
            assert (one.state, one.sign, one.action) == (*rows[s], (b,) * mapping_set.n_target_actions)


class TestMappingSet:
    @pytest.mark.parametrize(
        "mapping_set",
        [
            *[MappingSet.injective(2, 3, 2, 3), MappingSet.all(1, 2, 2, 2, signs=True), MappingSet.balanced(2, 2, 2, 3)],
            *[MappingSet.balanced(1, 1, 3, 5), MappingSet.balanced(1, 1, 3, 4), MappingSet.balanced(1, 1, 4, 2)],
            MappingSet([[0]], ListedActionMappings([[0, 2, 2], [2, 0, 2], [0, 0, 1]], n_source_actions=4)),
            # Equal state mappings in several rows, as in the paper's layings.
            MappingSet([[0, -1], [-1, 0], [0, -1]], [[0, 1], [1, 1]], signs=[[1, -1], [1, 1], [1, 1]]),
        ],
    )
    def test_lookups_agree_with_a_search_through_the_members(self, mapping_set):
        assert len(mapping_set) == len(list(mapping_set)) == mapping_set.n_state_mappings * mapping_set.n_action_mappings
        check_against_members(mapping_set)

    @settings(max_examples=20, deadline=None)
    @given(st.lists(mappings(n_source=2, n_target=2), min_size=1, max_size=8))
    def test_a_list_holds_exactly_its_mappings_in_order(self, listed):
        mapping_set = MappingSet.from_list(listed)
        assert list(mapping_set) == listed
        check_against_members(mapping_set)

    @settings(max_examples=20, deadline=None)
    @given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), min_size=1, max_size=8))
    def test_pairs_choose_members_of_the_factors(self, pairs):
        # Equal state mappings in two rows, as in the paper's sets.
        factors = ([[0, -1], [-1, 0], [0, -1]], AllActionMappings(2, 2))
        product, chosen = MappingSet(*factors), MappingSet(*factors, pairs=pairs)
        assert list(chosen) == [product[4 * state + action] for state, action in pairs]
        assert chosen.pairs.tolist() == [list(pair) for pair in pairs]
        check_against_members(chosen)

    def test_sets_with_more_candidates_than_practical_are_refused(self):
        with pytest.raises(ValueError, match="12,000,000 candidates, more than the 10,000,000 that are practical"):
            MappingSet.injective(2, 4, 1000, 1000)
        assert len(MappingSet([[0, 1]], AllActionMappings(1000, 1000), pairs=[[0, 5]])) == 1

    def test_check_looks_at_every_mapping_of_a_large_set(self):
        sizes = {"n_source_variables": 2, "n_target_variables": 4, "n_source_actions": 500, "n_target_actions": 500}
        mapping_set = MappingSet.injective(**sizes)
        mapping_set.check(**sizes)
        for name, message in (
            ("n_source_variables", "state must hold indices from 0 to 0"),
            ("n_target_variables", "state must have 3 entries"),
            ("n_source_actions", "action must hold indices from 0 to 498"),
            ("n_target_actions", "action must have 499 entries"),
        ):
            with pytest.raises(ValueError, match=message):
                mapping_set.check(**{**sizes, name: sizes[name] - 1})

    def test_members_by_number(self):
        mapping_set = MappingSet.injective(**MOUNTAIN_CAR)
        assert mapping_set[-1] == list(mapping_set)[2915] and mapping_set[np.int64(7)] == mapping_set[7]
        for index in (2916, -2917):
            with pytest.raises(IndexError, match="2916"):
                mapping_set[index]

    def test_sets_of_any_size_have_members_by_number(self):
        mapping_set, balanced = MappingSet.injective(1, 1, 10, 30), MappingSet.balanced(2, 4, 8, 16)
        assert mapping_set.n_mappings == 10**30 and mapping_set[10**30 - 1].action == (9,) * 30
        assert repr(mapping_set) == "<about 10^30 mappings: 1 state mappings x about 10^30 action mappings>"
        assert len(balanced) == 12 * 81_729_648_000
        assert balanced[-1].action == tuple(b for b in range(7, -1, -1) for _ in range(2))

    def test_names_reach_the_members(self):
        named = MappingSet.injective(1, 1, 1, 1).with_names(["v"], ["vx"], ["Go"], ["East"])
        assert repr(named[0]) == "InterTaskMapping(vx<-v; East<-Go)"

    def test_copies_and_pickles_are_alike(self):
        for mapping_set in (MappingSet.balanced(**MOUNTAIN_CAR), MappingSet.from_list([InterTaskMapping((0,), (1, 0))])):
            for copied in (copy.deepcopy(mapping_set), pickle.loads(pickle.dumps(mapping_set))):
                assert list(copied) == list(mapping_set)

    @pytest.mark.parametrize("action", [-1, 5])
    def test_unknown_target_actions_are_refused(self, action):
        for method in (MappingSet.candidates, MappingSet.source_actions_for):
            with pytest.raises(ValueError, match="action must be a target action from 0 to 4"):
                method(MappingSet.injective(**MOUNTAIN_CAR), action)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (([0, 1], [[0]]), "state_mappings must be integers of shape"),
            (([[0.5]], [[0]]), "state_mappings must be integers"),
            (([[-1]], [[0]]), "at least one of them not -1"),
            (([[-2, 0]], [[0]]), "-1 for None"),
            (([[0]], [0]), "action mappings must be integers of shape"),
            (([[0]], [[-1]]), "source actions from 0"),
            (([[0]], [[0]], [[2]]), r"signs must be \+1 and -1"),
            ((np.array([[2**64 - 1]], dtype=np.uint64), [[0]]), "state_mappings must hold indices up to 2147483647"),
            (([[0], [0, 1]], [[0]]), "state_mappings must be integers of shape"),
        ],
    )
    def test_wrong_factors_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            MappingSet(*arguments)

    @pytest.mark.parametrize("pairs", [[], [[0]], [[1, 0]], [[0, 2]], [[-1, 0]], [[0.5, 0]], [[0, 0, 0]]])
    def test_wrong_pairs_are_named(self, pairs):
        with pytest.raises(ValueError, match="pairs must be"):
            MappingSet([[0]], [[0], [1]], pairs=pairs)


# One inter-task mapping: translation of states, displacements and actions, and what it refuses.
units = st.lists(st.floats(-0.5, 1.5), min_size=12, max_size=12)


class TestInterTaskMapping:
    @settings(max_examples=40, deadline=None)
    @given(mappings(), units, st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_source_to_target_and_back_is_the_identity_on_used_variables(self, mapping, source, current):
        assert eval(repr(mapping)) == mapping
        source = np.array(source).reshape(4, 3)
        back = mapping.target_to_source(mapping.source_to_target(source, current), 3)
        used = sorted({i for i in mapping.state if i is not None})
        np.testing.assert_allclose(back[:, used], source[:, used], atol=1e-12)
        assert np.isnan(np.delete(back, used, axis=1)).all()

    @settings(max_examples=40, deadline=None)
    @given(mappings(), units, st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_translation_agrees_with_a_loop_over_variables(self, mapping, source, current):
        source = np.array(source).reshape(4, 3)
        translated = mapping.source_to_target(source, current)
        for row in range(4):
            for i, (k, sign) in enumerate(zip(mapping.state, mapping.sign, strict=True)):
                expected = current[i] if k is None else source[row, k] if sign == 1 else 1 - source[row, k]
                assert translated[row, i] == pytest.approx(expected, abs=1e-12)

    @settings(max_examples=40, deadline=None)
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
        mapping, current = InterTaskMapping((0, None), (0,)), [[0.1, 0.2], [0.3, 0.4]]
        np.testing.assert_allclose(mapping.source_to_target([[0.5], [0.6]], current), [[0.5, 0.2], [0.6, 0.4]])

    def test_actions_translate_both_ways(self):
        mapping = InterTaskMapping((0, None, 1, None), (1, 0, 2, 1, 1))
        assert [mapping.source_action(a) for a in range(5)] == [1, 0, 2, 1, 1]
        assert [mapping.target_actions(b).tolist() for b in range(4)] == [[1], [0, 3, 4], [2], []]

    def test_arrays_for_compiled_loops(self):
        mapping = InterTaskMapping((0, None, 1, None), (0,), (1, 1, -1, -1))
        assert mapping.state_index.dtype == np.int64 and mapping.state_index.tolist() == [0, -1, 1, -1]
        # The sign of an unmapped variable has no effect, so it does not make mappings differ either.
        assert mapping.state_sign.tolist() == [1.0, 1.0, -1.0, 1.0]
        assert mapping == InterTaskMapping([0, None, np.int64(1), None], [0], np.array([1, 1, -1, 1]))

    def test_repr_with_names_shows_the_source_of_each_variable_and_action(self):
        mapping = InterTaskMapping((0, None, 1, None), (0, 1, 2, 0, 0), (1, 1, -1, 1)).with_names(
            ["x", "v"], ["x", "y", "vx", "vy"], ["Neutral", "Left", "Right"], ["Neutral", "West", "East", "South", "North"]
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
            (((0.5,), (0,)), "state must hold integers from 0 on or None, got the entry 0.5"),
            (((-1,), (0,)), "state must hold integers from 0 on or None, got the entry -1"),
            (((0,), (None,)), "action must hold integers from 0 on, got the entry None"),
            (((10**30,), (0,)), "state must hold indices up to 2147483647 or None, got a larger entry"),
            (((0,), (2**31,)), "action must hold indices up to 2147483647, got a larger entry"),
            (((True,), (0,)), "state .* entry True"),
            (("01", (0,)), "state must be a sequence"),
            (((0,), (0,), (1, 1)), r"sign must have 1 entries"),
            (((0,), (0,), (0,)), r"sign must have 1 entries, \+1 or -1"),
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
