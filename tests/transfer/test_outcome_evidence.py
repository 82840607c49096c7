"""What confirms and what contradicts the ends and rewards that transferred instances predict."""

import numpy as np
import pytest

from sb3_combrel.transfer.outcome_evidence import STEPS_OF_A_VISIT, OutcomeEvidence

SURE, NONE = 0.9, 0.0


def evidence():
    return OutcomeEvidence(np.full(10, -1.0))


def note(made, ends, terminated=False, reward=-1.0, predicted=-1.0, has_data=True):
    """Note one transition for each predicted probability of an end; the last may end the episode."""
    for k, end in enumerate(ends):
        made.note((end, predicted) if has_data else None, reward, terminated and k == len(ends) - 1)


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


def test_where_the_source_has_no_data_nothing_is_contradicted():
    made = evidence()
    note(made, [NONE] * 3, has_data=False)
    note(made, [NONE], terminated=True, has_data=False)
    note(made, [NONE] * 30, has_data=False, reward=1.0)
    assert made.contradicted == made.rewards_wrong == 0


def test_rewards_of_the_wrong_sign_are_wrong_and_small_differences_are_not():
    made = evidence()
    note(made, [NONE] * 30, reward=-1.05)
    note(made, [NONE] * 9, reward=1.0)
    assert (made.rewards_right, made.rewards_wrong) == (30, 9)
    spread = OutcomeEvidence(np.array([-5.0, 5.0]))
    note(spread, [NONE] * 30, reward=2.0)
    note(spread, [NONE] * 3, reward=5.0)
    assert (spread.rewards_right, spread.rewards_wrong) == (30, 3)


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


def test_visits_are_those_of_each_environment():
    """Twenty steps where an end is predicted, of one environment; another is where none is, and ends there."""
    evidence = OutcomeEvidence(np.full(10, -1.0))
    for _ in range(2 * STEPS_OF_A_VISIT):
        evidence.environment = 0
        evidence.note((1.0, -1.0), -1.0, False)
        evidence.environment = 1
        evidence.note((0.0, -1.0), -1.0, False)
    assert evidence.absent == 2
    evidence.note((0.0, -1.0), -1.0, True)
    assert (evidence.unpredicted, evidence.confirmed) == (1, 0)


def test_visits_that_go_on_are_restored_to_their_environments():
    evidence, restored = (OutcomeEvidence(np.full(10, -1.0)) for _ in range(2))
    for environment, steps in ((2, 4), (0, 0), (1, 3)):
        evidence.environment = environment
        for _ in range(steps):
            evidence.note((1.0, -1.0), -1.0, False)
    restored.set_state(evidence.get_state())
    restored.visits = evidence.visits
    for each in (evidence, restored):
        each.environment = 0
        each.note((0.0, -1.0), -1.0, False)
        each.environment = 2
        each.note((1.0, -1.0), -1.0, True)
        each.environment = 1
        each.note((0.0, -1.0), -1.0, False)
    assert evidence.confirmed == 1 and evidence.absent == 1
    np.testing.assert_array_equal(restored.get_state(), evidence.get_state())
