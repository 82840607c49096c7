"""A source's own model against a plain computation, and as a prior: what it claims of targets that it fits, and of others."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import bound, inside, naive_prediction, show
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, InterTaskMapping
from sb3_combrel.common.instances import Instances
from sb3_combrel.transfer.outcome_evidence import GOES_ON
from sb3_combrel.transfer.prior.claims import PRESUMED, trust_in
from sb3_combrel.transfer.source_model import SourceModel

TWO = f.copies_mapping(2, (0, 2, 1, 3))
ALONG_FIRST = InterTaskMapping([0, None, 1, None], [0, 1, 2, 0, 0])


def naive(source, mapping, state, action):
    """Effect, mean reward, product of ends and least weight of a factored mapping's copies, one after the other."""
    effect, rewards, ends, weights = np.zeros(len(state)), [], [], []
    unit_states = source.scaling.to_unit(source.states)
    unit_effects = source.scaling.to_unit(source.next_states) - unit_states
    for copy in mapping.copies:
        used = sorted({k for k in copy.state if k is not None})
        rows = source.actions == copy.action[action]
        at = copy.target_to_source(state, source.n_variables)[used]
        data = unit_states[rows][:, used], unit_effects[rows][:, used], source.rewards[rows], source.terminated[rows]
        predicted, reward, end, weight = f.naive_prediction(*data, at, 0.2, 24, 0.05)
        whole = np.zeros(source.n_variables)
        whole[used] = predicted
        effect += copy.displacement_to_target(whole)
        if len(used) < source.n_variables:
            end = min(1.0, end / naive_largest_end(source, tuple(used)))
        rewards.append(reward), ends.append(end), weights.append(weight)
    return effect, np.mean(rewards), np.prod(ends), min(weights)


@cache
def naive_largest_end(source, used):
    """The largest probability of termination that some variables predict of the instances that have ended an episode."""
    found = []
    for state, action in zip(source.states[source.terminated], source.actions[source.terminated], strict=True):
        rows = source.actions == action
        unit_states = source.scaling.to_unit(source.states[rows])[:, list(used)]
        data = unit_states, np.zeros_like(unit_states), source.rewards[rows], source.terminated[rows]
        found.append(f.naive_prediction(*data, source.scaling.to_unit(state[None])[0, list(used)], 0.2, 24, 0.05)[2])
    return max(found)


MAPPINGS = [
    TWO,
    FactoredMapping([InterTaskMapping([0, None, 1, None], [0, 1, 2, 0, 0], [-1, 1, -1, 1])]),
    # Parts of the source; a source variable that is two variables of the target.
    FactoredMapping([InterTaskMapping([None, 1, None, None], [0, 1, 2, 0, 1]), InterTaskMapping([0, None, None, 0], [2] * 5)]),
    FactoredMapping([InterTaskMapping([0, 0, 1, 1], [0, 1, 2, 0, 0], [1, -1, 1, -1])]),
]


@pytest.mark.parametrize("mapping", MAPPINGS, ids=["two copies", "mirrored", "parts", "twice the same"])
@pytest.mark.parametrize("n", [1, 100])
def test_predictions_are_those_of_the_copies(mapping, n):
    source = f.oscillator_source(rewards=lambda states: states[:, 0])
    prior, rng = bound(TIMBREL(source, mapping, use="prior")).source_prior, np.random.default_rng(n)
    # Few different values, as on a grid, in any order.
    states, actions = rng.integers(0, 5, size=(n, 4)) / 4.0, rng.integers(5, size=n)
    effect, reward, end, weight = prior._raw(states, actions)
    for i in range(0, n, 1 + n // 20):
        expected = naive(source, mapping, states[i], actions[i])
        for ours, theirs in zip((effect[i], reward[i], end[i], weight[i]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-9)


def test_before_any_transition_a_mapping_that_is_given_or_drawn_predicts_and_claims_nothing():
    states, actions = inside(300, 4, 5)
    given, chosen = (bound(COMBREL(f.oscillator_source(), each, use="prior")) for each in (TWO, "factored"))
    drawn = bound(TIMBREL(f.oscillator_source(), "random", mappings="factored", use="prior"))
    np.testing.assert_allclose(given.prior(states, actions).effect, f.target_effects(TWO, states, actions), atol=1e-3)
    assert not given.prior(states, actions).weight.any()
    assert not any(array.any() for array in chosen.prior(states, actions))
    assert drawn.prior(states, actions).effect.any() and not drawn.prior(states, actions).weight.any()


@pytest.mark.parametrize(("n_copies", "seed"), [(2, 0), (3, 1)])
def test_an_exact_source_is_found_and_claims_what_it_knows(n_copies, seed):
    mapping = f.copies_mapping(n_copies, np.random.default_rng(seed).permutation(2 * n_copies).tolist())
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"), 2 * n_copies, 2 * n_copies + 1, seed)
    versions = show(transfer, f.walk(mapping, 150 * n_copies, seed))
    states, actions = inside(300, 2 * n_copies, 2 * n_copies + 1)
    found = transfer.prior(states, actions)
    np.testing.assert_allclose(found.effect, f.target_effects(mapping, states, actions), atol=1e-3)
    np.testing.assert_allclose(found.reward, -1.0)
    assert (found.weight[found.end < 0.1] > 1.0).mean() > 0.95
    assert transfer.statistics()["transfer/prediction_error"] < 0.01
    # Ten times as many transitions change nothing any more.
    assert max(show(transfer, f.walk(mapping, 300, seed + 100))) <= versions[-1] + 2 and 1 <= versions[-1] <= 30
    assert not transfer.changed(np.zeros((2 * n_copies + 1, 3), dtype=bool))
    assert not transfer.transferred(states, actions, np.zeros(300)).length.any()


def test_its_version_grows_whenever_its_predictions_change():
    transfer = bound(COMBREL(f.oscillator_source(noise=0.01), "factored", use="prior"))
    states, actions = inside(40, 4, 5)
    transitions = f.walk(TWO, 300)
    last, version = transfer.prior(states, actions), transfer.prior_version()
    n_changes = 0
    for i in range(300):
        show(transfer, tuple(array[i : i + 1] for array in transitions), ends=[i % 60 == 59])
        if i % 60 == 59:
            transfer.end_episode(False)
        found = transfer.prior(states, actions)
        transfer.prior(states[: 1 + i % 7], actions[: 1 + i % 7])  # asking leaves no trace
        if transfer.prior_version() == version:
            assert all(np.array_equal(one, other) for one, other in zip(found, last, strict=True))
        else:
            assert transfer.prior_version() > version
            n_changes += 1
        last, version = found, transfer.prior_version()
    assert 3 <= n_changes <= 30


def noise_source(seed):
    rng = np.random.default_rng(seed)
    return f.oscillator_source(seed=seed, effects=lambda states, actions: 0.05 * rng.normal(size=states.shape))


def test_a_source_of_noise_claims_nothing():
    states, actions = inside(300, 4, 5)
    for transfer in (
        COMBREL(noise_source(0), "factored", use="prior"),
        COMBREL(noise_source(0), "injective", use="prior"),
        TIMBREL(noise_source(0), "random", mappings="factored", use="prior"),
    ):
        bound(transfer)
        for part in range(3):
            show(transfer, f.walk(TWO, 70, 10 * part))
            assert not transfer.prior(states, actions).weight.any()


def test_a_given_mapping_that_is_wrong_stops_predicting_and_a_warning_says_so():
    transfer = bound(TIMBREL(noise_source(0), TWO, use="prior"))
    states, actions = inside(50, 4, 5)
    assert transfer.prior(states, actions).effect.any()
    with pytest.warns(UserWarning, match=r"Oscillator-v0 predicts the target worse .* is \d") as caught:
        show(transfer, f.walk(TWO, 600))
    assert len(caught) == 1 and transfer.statistics()["transfer/prediction_error"] > 1.0
    found = transfer.prior(states, actions)
    # By chance noise may explain some of one variable's effects.
    assert (found.effect == 0.0).mean() > 0.7 and not found.weight.any()


@pytest.mark.parametrize("mappings", ["all", [ALONG_FIRST, TWO.copies[1]]])
def test_sets_that_are_not_factored_give_one_mapping_for_each_action(mappings):
    transfer = bound(COMBREL(f.oscillator_source(), mappings, use="prior"))
    show(transfer, f.walk(TWO, 300))
    states = inside(200, 4, 5)[0]
    for action, (explained, rest) in enumerate([([0, 2], [1, 3])] * 3 + [([1, 3], [0, 2])] * 2):
        found = transfer.prior(states, np.full(200, action))
        if action > 0:
            expected = f.target_effects(TWO, states, np.full(200, action))
            np.testing.assert_allclose(found.effect[:, explained], expected[:, explained], atol=1e-3)
            assert not found.effect[:, rest].any()
        # What it predicts to stay moves.
        assert not found.weight.any()


def test_angles_go_around():
    """The same dynamics seen half a turn on, so that the target crosses from 1 to 0 where the source is amid its data."""
    source = f.oscillator_source()
    states, actions, effects = f.walk(f.copies_mapping(1), 200)
    turned = np.column_stack([(states[:, 0] + 0.5) % 1.0, states[:, 1]])
    next_states = np.column_stack([(turned[:, 0] + effects[:, 0]) % 1.0, states[:, 1] + effects[:, 1]])
    half = np.array([2.0, 0.0])
    on = dict(states=source.states + half, next_states=source.next_states + half, periodic=(True, False))
    transfer = COMBREL(dataclasses.replace(source, **on), "factored", use="prior")
    transfer.bind(dataclasses.replace(f.target_task(2, 3), periodic=(True, False)), np.random.default_rng(0))
    for state, action, after in zip(turned, actions.tolist(), next_states, strict=True):
        transfer.observe(state, action, -1.0, after, False)
    assert transfer.describe_prior() == (
        "a0: Wait on (s0, s1) as (x, v); a1: Down on (s0, s1) as (x, v); a2: Up on (s0, s1) as (x, v)"
    )
    inner, actions = inside(100, 2, 3)
    for turns in (0.0, 1.0, -1.0):
        found = transfer.prior(np.column_stack([(inner[:, 0] + 0.5) % 1.0 + turns, inner[:, 1]]), actions)
        np.testing.assert_allclose(found.effect, f.oscillate(inner, actions), atol=2e-3)
        assert (found.weight[found.end < 0.1] > 1.0).mean() > 0.95


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 4), st.integers(1, 60))
def test_whatever_the_target_does_predictions_are_finite(seed, n_actions, d, n):
    rng = np.random.default_rng(seed)
    transfer = bound(COMBREL(f.oscillator_source(30, seed=seed % 7), "factored", use="prior"), d, n_actions)
    states = rng.random((n, d)) * rng.choice([0.0, 1.0, 30.0])
    effects = rng.normal(size=(n, d)) * rng.choice([0.0, 1e-9, 0.1, 10.0])
    transitions = states, rng.integers(n_actions, size=n), effects
    show(transfer, transitions, rewards=rng.normal(size=n) * 1e3, ends=rng.random(n) < 0.2)
    found = transfer.prior(states, transitions[1])
    assert all(np.isfinite(array).all() for array in found)
    assert (found.weight >= 0.0).all() and (found.end >= 0.0).all() and (found.end <= 1.0).all()


def test_of_two_sources_the_one_that_fits_is_found_and_it_says_which_copies_each_action_moves():
    transfer = bound(COMBREL([noise_source(3), f.oscillator_source()], "factored", use="prior"))
    assert transfer.describe_prior().startswith("a0: nothing; a1: nothing")
    assert (transfer.choices() == -1).all() and transfer.mapping_counts() == []
    show(transfer, f.walk(TWO, 300))
    first, second = "on (s0, s2) as (x, v)", "on (s1, s3) as (x, v)"
    assert transfer.describe_prior() == (
        f"a0: Wait {first}, Wait {second}; a1: Down {first}, Wait {second}; a2: Up {first}, Wait {second}; "
        f"a3: Wait {first}, Down {second}; a4: Wait {first}, Up {second}"
    )
    [first, *_] = transfer.choices().reshape(5, -1)[3]
    assert transfer.candidate(first) == (3, "Wait + Down", "(s0, s2) + (s1, s3)", ())
    assert (transfer.selected(np.zeros((2, 4)), np.array([3, 3])) == first).all()
    assert transfer.describe(first) == "a3<-Wait + Down with (s0, s2) + (s1, s3)"
    assert "Wait + Down" in transfer.source_action_names() and sum(transfer.uses().values()) > 250
    assert set(transfer.source_prior.copies.source[transfer.source_prior.choice.copies].ravel().tolist()) == {1}


def random_instances(rng, n, d, n_actions):
    return Instances.of_rows(
        n_actions,
        rng.integers(n_actions, size=n),
        rng.random((n, d)),
        0.1 * rng.normal(size=(n, d)),
        rng.normal(size=n),
        rng.random(n) < 0.3,
    )


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.integers(1, 120),
    st.sampled_from([0.05, 0.2, 0.6]),
    st.sampled_from([3, 24]),
    st.sampled_from([0.03, 0.3]),
)
def test_predictions_are_those_of_a_weighted_regression(seed, d, n, breadth, n_neighbors, outcome_breadth):
    rng = np.random.default_rng(seed)
    instances = random_instances(rng, n, d, 2)
    model = SourceModel(instances, breadth, n_neighbors, outcome_breadth)
    states, actions = 1.4 * rng.random((20, d)) - 0.2, rng.integers(2, size=20)
    found = model.predict(states, actions)
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        size = instances.size[action]
        if size == 0:
            assert not np.any(found.effect[i]) and found.weight[i] == found.end[i] == found.reward[i] == 0.0
            continue
        of_action = (array[action, :size] for array in instances[:4])
        expected = naive_prediction(*of_action, state, breadth, n_neighbors, outcome_breadth)
        for ours, theirs in zip((found.effect[i], found.reward[i], found.end[i], found.weight[i]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)


# What a source as a prior claims to know: how far it is trusted, and which of its ends and rewards count.
@pytest.mark.parametrize(
    ("unexplained", "n_covered", "trust"),
    [
        # Nothing seen; too little seen, however exact.
        *[(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.01, 2.0, 0.0)],
        # From three transitions on, in steps of a tenth, and more with every other one.
        *[(0.0, 3.0, 0.5), (0.6, 4.0, 0.4), (0.0, 10.0, 0.7), (0.0, 200.0, 0.9)],
        # Less than half of what has been seen, or so little of it that hardly anything is left.
        *[(51.0, 100.0, 0.0), (49.0, 100.0, 0.4), (2.0, 4.0, 0.0), (200.0, 100.0, 0.0)],
    ],
)
def test_trust_is_what_is_explained_in_steps_or_nothing(unexplained, n_covered, trust):
    # Of a second variable everything is explained, of a second action nothing.
    unexplained, n_covered = np.array([[unexplained, 0.0], [n_covered, 0.0]]), np.full((2, 2), n_covered)
    np.testing.assert_allclose(trust_in(unexplained, n_covered), [trust, 0.0], atol=1e-12)


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
    explained, n = transfer.source_prior.explained(), np.bincount(actions, minlength=3)
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
    one, make = f.copies_mapping(1), dict(use="prior", transfer_terminals=transfer_terminals)
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
