"""Sequences of action mappings, against brute force over itertools."""

import itertools

import numpy as np
import pytest
from helpers.mappings import SMALL_SIZES

from sb3_combrel.mappings.action_mappings import AllActionMappings, BalancedActionMappings, ListedActionMappings


class TestActionMappings:
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

    @pytest.mark.parametrize(("factor", "largest"), [(AllActionMappings, "1,000"), (BalancedActionMappings, "100")])
    @pytest.mark.parametrize("number", [10**5, 10**400, 0, float("inf"), float("nan"), 2.0, True, "3", None])
    def test_impossible_numbers_of_actions_are_refused(self, factor, largest, number):
        with pytest.raises(ValueError, match=f"n_source_actions must be a whole number from 1 to {largest}"):
            factor(number, 5)
        with pytest.raises(ValueError, match=f"n_target_actions must be a whole number from 1 to {largest}"):
            factor(3, number)

    def test_the_largest_factors_can_be_looked_up(self):
        for actions in (AllActionMappings(1000, 1000), BalancedActionMappings(100, 100)):
            n = actions.n_source_actions
            assert actions[0] == ((0,) * n if isinstance(actions, AllActionMappings) else tuple(range(n)))
            assert actions.source_actions_for(n - 1).tolist() == list(range(n))
            assert actions[actions.n_mappings - 1][0] == n - 1
            with pytest.raises(IndexError):
                actions[actions.n_mappings]

    def test_listed_source_actions_are_looked_up_however_large_their_numbers(self):
        actions = ListedActionMappings([[0, 10**9], [10**9, 5]])
        assert [actions.source_actions_for(a).tolist() for a in range(2)] == [[0, 10**9], [5, 10**9]]
        with pytest.raises(ValueError, match="action mappings must hold indices up to 2147483647"):
            ListedActionMappings(np.array([[2**64 - 1]], dtype=np.uint64))
