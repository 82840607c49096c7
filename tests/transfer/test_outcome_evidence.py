"""What confirms and what contradicts the ends and rewards that a source predicts."""

import numpy as np
import pytest

from sb3_combrel.transfer.outcome_evidence import EPISODES_IN_VAIN, MIN_ABSENT, STEPS_OF_A_VISIT, OutcomeEvidence

SURE, NONE = 0.9, 0.0


def evidence():
    return OutcomeEvidence(np.full(10, -1.0), threshold=1.0)


def note(made, ends, terminated=False, weight=5.0, reward=-1.0, predicted=-1.0):
    """Note one transition for each predicted probability of an end; the last may end the episode."""
    for k, end in enumerate(ends):
        made.note(weight, end, predicted, reward, terminated and k == len(ends) - 1)


@pytest.mark.parametrize(
    ("ends", "terminated", "confirmed", "contradicted"),
    [
        ([NONE] * 20, False, 0, 0),
        ([NONE, SURE], True, 1, 0),
        # At the border a kernel average decides nothing: an end a step or two later is the one that was predicted.
        *[([NONE, SURE, 0.3, 0.2], True, 1, 0), ([NONE, 0.2], True, 1, 0), ([NONE, NONE], True, 0, 1)],
        *[([NONE, SURE, SURE, NONE], False, 0, 1), ([NONE, SURE, NONE, SURE, NONE], False, 0, 2)],
        ([NONE, 0.3, 0.3, NONE], False, 0, 0),
        # Whoever stays where an end is predicted contradicts it again and again.
        ([SURE] * STEPS_OF_A_VISIT, False, 0, 1),
        ([SURE] * 3 * STEPS_OF_A_VISIT + [NONE], False, 0, 3),
    ],
)
def test_visits_count_once(ends, terminated, confirmed, contradicted):
    made = evidence()
    note(made, ends, terminated)
    assert (made.confirmed, made.contradicted) == (confirmed, contradicted)
    assert made.doubted == (made.absent >= MIN_ABSENT)


def test_where_the_source_has_no_data_nothing_is_contradicted():
    made = evidence()
    note(made, [SURE, SURE, NONE], weight=0.5)
    note(made, [NONE], terminated=True, weight=0.5)
    note(made, [NONE] * 30, weight=0.5, reward=1.0)
    assert made.contradicted == made.rewards_wrong == 0 and not made.doubted


def test_after_an_end_has_come_ends_that_do_not_are_doubted_and_nothing_else():
    made = evidence()
    note(made, [SURE], terminated=True)
    assert made.ends_believed and not made.doubted
    note(made, [SURE, NONE])
    assert made.ends_believed
    note(made, [SURE, NONE])
    assert (made.absent, made.unpredicted) == (2, 0) and not made.ends_believed and not made.doubted
    note(made, [SURE], terminated=True)
    assert made.ends_believed
    note(made, [NONE], terminated=True)
    note(made, [NONE], terminated=True)
    note(made, [NONE], terminated=True)
    assert not made.doubted
    note(made, [NONE], terminated=True)
    assert (made.absent, made.unpredicted) == (2, 4) and made.doubted and made.contradicted == 6


def test_ends_that_few_data_do_not_predict_contradict_nothing():
    made = OutcomeEvidence(np.full(10, -1.0), threshold=1.0, no_end=3.0)
    note(made, [NONE], terminated=True, weight=2.9)
    assert made.unpredicted == 0 and not made.doubted
    note(made, [NONE, SURE, NONE], weight=1.0)
    assert made.absent == 1
    note(made, [NONE], terminated=True, weight=3.0)
    assert made.unpredicted == 1 and not made.doubted
    note(made, [NONE], terminated=True, weight=3.0)
    assert made.unpredicted == 2 and made.doubted


def test_ends_that_are_never_reached_are_doubted_if_rewards_tell_nothing():
    for rewards, doubted in ((lambda t: -1.0, True), (lambda t: -1.0 - 0.01 * t, False)):
        made = evidence()
        for episode in range(EPISODES_IN_VAIN):
            assert not made.doubted
            for t in range(5):
                note(made, [NONE], reward=rewards(t), predicted=rewards(t))
            made.end_episode(truncated=True)
            assert made.in_vain == episode + 1
        assert made.doubted == doubted
    made = evidence()
    note(made, [SURE], terminated=True)
    for _ in range(9):
        note(made, [NONE])
        made.end_episode(truncated=True)
    assert not made.doubted


def test_rewards_of_the_wrong_sign_are_doubted_and_small_differences_are_not():
    made = evidence()
    note(made, [NONE] * 30, reward=-1.05)
    assert made.rewards_right == 30 and not made.doubted
    made = evidence()
    note(made, [NONE] * 9, reward=1.0)
    assert not made.doubted
    note(made, [NONE], reward=1.0)
    assert made.doubted
    spread = OutcomeEvidence(np.array([-5.0, 5.0]), 1.0)
    note(spread, [NONE] * 30, reward=2.0)
    assert not spread.doubted


def test_counts_are_saved():
    made, other = evidence(), evidence()
    for terminated in (False, True):
        note(made, [NONE, SURE, NONE, SURE, NONE], terminated)
    note(made, [SURE, SURE])
    other.set_state(made.get_state())
    for each in (made, other):
        note(each, [SURE, NONE])
        each.end_episode(True)
    assert vars(made) == vars(other)
