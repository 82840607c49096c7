"""What a user may write for a set of mappings, and the sets of the paper."""

import pytest
from helpers.mappings import MOUNTAIN_CAR

from sb3_combrel import InterTaskMapping, MappingSet
from sb3_combrel.mappings import UNMAPPED, resolve


class TestPaperSets:
    def test_the_papers_mountain_car_set_has_24_state_and_90_action_mappings(self):
        mapping_set = MappingSet.paper_mountain_car()
        assert (mapping_set.n_state_mappings, mapping_set.n_action_mappings, len(mapping_set)) == (24, 90, 2160)
        assert len(set(mapping_set)) == 1080
        assert set(mapping_set) == set(MappingSet.balanced(**MOUNTAIN_CAR))
        assert len(mapping_set.candidates(0).state_index) == 12 * 3
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
            assert joints[::2] == joints[1::2]
            assert sorted(joints[::2]) == [0, 0, 1, 1]
            assert all({action[2 * j] % 2, action[2 * j + 1] % 2} == {0, 1} for j in range(4))
            assert action[0] % 2 == 1
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
            (3, "mappings must be a name, .* got 3"),
            ([3], "each of the mappings must be"),
            ("paper_icub", "action must have 5 entries, .* got 8"),
            (MappingSet.injective(3, 4, 3, 5), "state must hold indices from 0 to 1"),
            ([InterTaskMapping((0,), (0,)), InterTaskMapping((0, 1), (0,))], "same numbers of target variables"),
        ],
    )
    def test_resolve_refuses_everything_else(self, mappings, message):
        with pytest.raises(ValueError, match=message):
            resolve(mappings, **MOUNTAIN_CAR)
