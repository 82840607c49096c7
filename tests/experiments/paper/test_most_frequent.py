"""The mapping that COMBREL used most, from how often it used each."""

from collections import Counter

import pytest

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.paper.most_frequent import Use, most_frequent_mapping

SOURCE = (("pitch", "yaw"), ("S1-", "S1+", "S2-", "S2+"))
TARGET = (("a", "b", "c"), ("T1-", "T1+"))
USES = Counter(
    {
        Use("T1-", "S1-", "a<-pitch, c<-(-yaw)"): 6,
        Use("T1-", "S2+", "a<-pitch, c<-(-yaw)"): 2,
        Use("T1-", "S2+", "a<-yaw, b<-pitch"): 5,
        Use("T1+", "S1+", "a<-yaw, b<-pitch"): 1,
    }
)


def test_the_most_frequent_mapping_is_the_state_mapping_used_most_with_its_own_actions():
    mapping = most_frequent_mapping(USES, SOURCE[0], TARGET[0], SOURCE[1], TARGET[1])
    # T1+ was never seen through it: what stood for it otherwise takes its place.
    assert mapping == InterTaskMapping(state=(0, None, 1), action=(0, 1), sign=(1, 1, -1))


def test_an_action_never_seen_through_it_is_counted_over_all_state_mappings():
    others = {Use("T1+", "S1+", "a<-yaw"): 2, Use("T1+", "S2-", "b<-yaw"): 3, Use("T1+", "S1+", "c<-yaw"): 2}
    for uses in ({**USES, **others}, {**USES, **dict(reversed(others.items()))}):
        # S1+ stood for it 1 + 2 + 2 times.
        assert most_frequent_mapping(uses, SOURCE[0], TARGET[0], SOURCE[1], TARGET[1]).action == (0, 1)


def test_without_uses_there_is_no_most_frequent_mapping():
    with pytest.raises(ValueError, match="no mapping has been used"):
        most_frequent_mapping({}, SOURCE[0], TARGET[0], SOURCE[1], TARGET[1])
