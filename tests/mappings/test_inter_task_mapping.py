"""One inter-task mapping: translation of states, displacements and actions, and what it refuses."""

import numpy as np
import pytest
from helpers.mappings import MOUNTAIN_CAR, mappings
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import InterTaskMapping, MappingSet

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
