"""What a source as a prior claims to know: how far it is trusted, and which of its ends and rewards count."""

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import bound, inside, show

from sb3_combrel import TIMBREL, InterTaskMapping
from sb3_combrel.transfer.outcome_evidence import GOES_ON
from sb3_combrel.transfer.prior.claims import PRESUMED, part_explained, trust_in

TWO = f.copies_mapping(2, (0, 2, 1, 3))


@pytest.mark.parametrize(
    ("unexplained", "n_covered", "trust"),
    [
        # Nothing seen; too little seen, however exact.
        (0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.01, 2.0, 0.0),
        # From three transitions on, in steps of a tenth, and more with every other one.
        (0.0, 3.0, 0.5),
        (0.6, 4.0, 0.4),
        (0.0, 10.0, 0.7),
        (0.0, 200.0, 0.9),
        # Less than half of what has been seen, or so little of it that hardly anything is left.
        (51.0, 100.0, 0.0),
        (49.0, 100.0, 0.4),
        (2.0, 4.0, 0.0),
        (200.0, 100.0, 0.0),
    ],
)
def test_trust_is_what_is_explained_in_steps_or_nothing(unexplained, n_covered, trust):
    # Of a second variable everything is explained, of a second action nothing.
    unexplained, n_covered = np.array([[unexplained, 0.0], [n_covered, 0.0]]), np.full((2, 2), n_covered)
    np.testing.assert_allclose(trust_in(unexplained, n_covered), [trust, 0.0], atol=1e-12)


def test_what_is_explained_is_that_of_the_variable_of_which_least_is():
    unexplained, n_covered = np.array([[1.0, 5.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[10.0, 10.0, 2.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(part_explained(unexplained, n_covered), [min(9.0 / 13.0, 5.0 / 13.0, 2.0 / 5.0), 0.0])


def test_claims_are_ten_times_the_weight_of_the_data_times_trust():
    transfer = bound(TIMBREL(f.oscillator_source(), TWO, use="prior"))
    show(transfer, f.walk(TWO, 60))
    assert 0.0 < transfer.source_prior.claims.trust.max() < 1.0
    states, actions = inside(100, 4, 5)
    coverage = transfer.source_prior._raw(states, actions)[3]
    found, trust = transfer.prior(states, actions), transfer.source_prior.claims.trust
    np.testing.assert_allclose(found.weight, np.where(found.end > 0.0, 0.0, 10.0 * coverage * trust[actions]))


def test_small_chances_of_an_end_are_none_also_before_an_end_was_confirmed():
    transfer = bound(TIMBREL(f.oscillator_source(2000), f.copies_mapping(1), use="prior"), 2, 3)
    show(transfer, f.walk(f.copies_mapping(1), 60))
    states = np.column_stack([np.linspace(0.7, 1.0, 200), np.full(200, 0.5)])
    actions = np.zeros(200, dtype=np.int64)
    raw, found = transfer.source_prior._raw(states, actions)[2], transfer.prior(states, actions)
    small = (raw > 0.0) & (raw < GOES_ON)
    assert small.any() and not found.end[small].any() and (found.weight[small] > 1.0).all()
    large = raw >= GOES_ON
    np.testing.assert_array_equal(found.end[large], raw[large])
    assert large.any() and not found.weight[large].any()


def with_noise_at_rest(size, seed=3):
    """Transitions of one copy, and a variable in no copy, which the first action moves by 0.05, the others by noise."""
    rng = np.random.default_rng(seed)
    states, actions, effects = f.walk(f.copies_mapping(1), 300)
    third = np.where(actions == 0, 0.05, size * rng.normal(size=300))
    return np.column_stack([states, rng.random(300)]), actions, np.column_stack([effects, third])


@pytest.mark.parametrize(("size", "trusted"), [(0.0, True), (0.005, True), (0.05, False)])
def test_noise_in_a_variable_that_an_action_leaves_alone_is_no_motion(size, trusted):
    mapping = InterTaskMapping([0, 1, None], [0, 1, 2])
    transfer = bound(TIMBREL(f.oscillator_source(), mapping, use="prior"), 3, 3)
    states, actions, effects = with_noise_at_rest(size)
    show(transfer, (states, actions, effects))
    squares = np.array([(effects[actions == action, 2] ** 2).mean() for action in range(3)])
    explained = transfer.source_prior.explained()
    n = np.bincount(actions, minlength=3)
    np.testing.assert_allclose(explained, (1.0 - np.sqrt(squares / squares.max())) * n / (n + PRESUMED), atol=0.03)
    trust = transfer.source_prior.claims.trust
    assert trust[0] == 0.0 and ((trust[1:] > 0.75).all() if trusted else not trust[1:].any())


def drive_to_the_end(n=200):
    """Transitions of one copy that pass where the source's episodes end, and where the target's would."""
    rng = np.random.default_rng(0)
    states, actions = 0.2 + 0.6 * rng.random((n, 2)), rng.integers(3, size=n)
    near_end = np.column_stack([np.full(40, 0.92), np.full(40, 0.6)])
    states, actions = np.vstack([states, near_end]), np.concatenate([actions, rng.integers(3, size=40)])
    return states, actions, f.oscillate(states, actions)


@pytest.mark.parametrize("transfer_terminals", [True, False])
def test_ends_are_claimed_once_confirmed_and_no_more_once_they_do_not_come(transfer_terminals):
    one = f.copies_mapping(1)
    make = dict(use="prior", transfer_terminals=transfer_terminals)
    transfer = bound(TIMBREL(f.oscillator_source(2000), one, **make), 2, 3)
    states, actions, effects = drive_to_the_end()
    show(transfer, (states[:200], actions[:200], effects[:200]))
    at_end, amid = (np.tile([[0.92, 0.6]], (3, 1)), np.arange(3)), (np.tile([[0.5, 0.5]], (3, 1)), np.arange(3))
    assert (transfer.prior(*at_end).end > 0.5).all() and not transfer.prior(*at_end).weight.any()
    assert (transfer.prior(*amid).weight > 1.0).all()
    version = transfer.prior_version()
    show(transfer, (states[200:201], actions[200:201], effects[200:201]), ends=[True])
    transfer.end_episode(False)
    assert (transfer.prior(*at_end).weight > 1.0).all() == transfer_terminals
    assert transfer.prior_version() == version + transfer_terminals
    show(transfer, (states[201:], actions[201:], effects[201:]))
    found = transfer.prior(*amid)
    assert transfer.statistics()["transfer/ends_contradicted"] > transfer.statistics()["transfer/ends_confirmed"] == 1
    assert not transfer.prior(*at_end).weight.any() and (found.weight > 1.0).all()
    # Ends where none is predicted are another thing: the source knows nothing of what matters.
    show(transfer, (states[:1], actions[:1], effects[:1]))
    for _ in range(3):
        show(transfer, (states[:1], actions[:1], effects[:1]), ends=[True])
    found = transfer.prior(*amid)
    assert not found.weight.any()
    np.testing.assert_allclose(found.effect, f.oscillate(*amid), atol=1e-3)


def test_rewards_of_the_wrong_sign_leave_the_effects():
    one = f.copies_mapping(1)
    transfer = bound(TIMBREL(f.oscillator_source(), one, use="prior"), 2, 3)
    states, actions, effects = f.walk(one, 100)
    show(transfer, (states, actions, effects), rewards=np.ones(100))
    found = transfer.prior(*inside(50, 2, 3))
    assert not found.weight.any() and found.effect.any()
    assert transfer.statistics()["transfer/prior_doubted"] == 1.0
