"""A source as a prior: what it predicts and claims of targets that it fits, and of others."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import bound, inside, show
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, InterTaskMapping
from sb3_combrel.transfer.prior.claims import MIN_TRANSITIONS

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
@pytest.mark.parametrize("n", [1, 7, 400])
def test_predictions_are_those_of_the_copies(mapping, n):
    source = f.oscillator_source(rewards=lambda states: states[:, 0])
    prior = bound(TIMBREL(source, mapping, use="prior")).source_prior
    rng = np.random.default_rng(n)
    # Few different values, as on a grid, in any order.
    states, actions = rng.integers(0, 5, size=(n, 4)) / 4.0, rng.integers(5, size=n)
    effect, reward, end, weight = prior._raw(states, actions)
    for i in range(0, n, 1 + n // 50):
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
    order = np.random.default_rng(seed).permutation(2 * n_copies).tolist()
    mapping = f.copies_mapping(n_copies, order)
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"), 2 * n_copies, 2 * n_copies + 1, seed)
    versions = show(transfer, f.walk(mapping, 150 * n_copies, seed))
    states, actions = inside(300, 2 * n_copies, 2 * n_copies + 1)
    found = transfer.prior(states, actions)
    np.testing.assert_allclose(found.effect, f.target_effects(mapping, states, actions), atol=1e-3)
    np.testing.assert_allclose(found.reward, -1.0)
    assert (found.weight[found.end < 0.1] > 1.0).mean() > 0.95
    assert transfer.statistics()["transfer/prediction_error"] < 0.01
    # Ten times as many transitions change nothing any more.
    again = show(transfer, f.walk(mapping, 300, seed + 100))
    assert max(again) <= versions[-1] + 2
    assert 1 <= versions[-1] <= 30
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


def shuffled_source(seed):
    source = f.oscillator_source(seed=seed)
    order = np.random.default_rng(seed).permutation(len(source))
    arrays = {
        name: getattr(source, name) for name in ("states", "actions", "rewards", "terminated", "low", "high", "n_actions")
    }
    return type(source)(**arrays, next_states=source.next_states[order])


@pytest.mark.parametrize("make", [noise_source, shuffled_source])
def test_sources_of_noise_claim_nothing(make, seed=0):
    states, actions = inside(300, 4, 5)
    for transfer in (
        COMBREL(make(seed), "factored", use="prior"),
        COMBREL(make(seed), "injective", use="prior"),
        TIMBREL(make(seed), "random", mappings="factored", use="prior"),
    ):
        bound(transfer, seed=seed)
        for part in range(4):
            show(transfer, f.walk(TWO, 70, seed + 10 * part))
            assert not transfer.prior(states, actions).weight.any()


def test_a_given_mapping_that_is_wrong_stops_predicting_and_a_warning_says_so():
    transfer = bound(TIMBREL(noise_source(0), TWO, use="prior"))
    states, actions = inside(50, 4, 5)
    assert transfer.prior(states, actions).effect.any()
    with pytest.warns(UserWarning, match=r"Oscillator-v0 predicts the target worse .* is \d") as caught:
        show(transfer, f.walk(TWO, 600))
    assert len(caught) == 1
    assert transfer.statistics()["transfer/prediction_error"] > 1.0
    found = transfer.prior(states, actions)
    # By chance noise may explain some of one variable's effects.
    assert (found.effect == 0.0).mean() > 0.7 and not found.weight.any()


def test_a_wrong_source_action_is_not_believed_where_it_shows():
    """In Wait's place Up: that differs in v alone, and for the first two actions of the first copy only."""
    first, second = TWO.copies
    wrong = FactoredMapping([InterTaskMapping(first.state, (2, 2, 2, 0, 0)), second])
    transfer = bound(TIMBREL(f.oscillator_source(), wrong, use="prior"))
    states, effects, weights = inside(200, 4, 5)[0], [], []
    show(transfer, f.walk(TWO, 400))
    for action in range(5):
        found = transfer.prior(states, np.full(200, action))
        effects.append(found.effect)
        weights.append(found.weight[found.end < 0.1])
    assert not weights[1].any()
    for action in (2, 3, 4):
        assert (weights[action] > 1.0).mean() > 0.95
    # The variables that it does explain are predicted still.
    assert effects[1][:, [0, 1, 3]].any(axis=0).all()


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


def same(one, other, states, actions):
    assert one.statistics() == other.statistics() or np.allclose(
        list(one.statistics().values()), list(other.statistics().values()), equal_nan=True
    )
    assert one.prior_version() == other.prior_version()
    assert one.describe_prior() == other.describe_prior()
    assert one.mapping_counts() == other.mapping_counts()
    assert all(np.array_equal(a, b) for a, b in zip(one.prior(states, actions), other.prior(states, actions), strict=True))


METHODS = {
    "factored": lambda: COMBREL(f.oscillator_source(noise=0.01), "factored", use="prior"),
    "few transitions": lambda: COMBREL(f.oscillator_source(), "factored", use="prior", max_transitions=30),
    "two sources": lambda: COMBREL([noise_source(3), f.oscillator_source()], "factored", use="prior"),
    "given": lambda: TIMBREL(f.oscillator_source(), TWO, use="prior"),
    "random": lambda: TIMBREL(f.oscillator_source(), "random", use="prior"),
    "random factored": lambda: TIMBREL(f.oscillator_source(), "random", mappings="signed_factored", use="prior"),
}


@pytest.mark.filterwarnings("ignore:what was transferred")
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("n", [0, 65])
def test_what_was_learned_goes_on_after_saving_and_loading(name, n):
    ours, theirs = bound(METHODS[name](), seed=1), bound(METHODS[name](), seed=2)
    states, actions, effects = f.walk(TWO, n + 40, seed=4)
    ends = np.arange(n + 40) % 30 == 29

    def live(transfer, first, last):
        for i in range(first, last):
            show(transfer, (states[i : i + 1], actions[i : i + 1], effects[i : i + 1]), ends=ends[i : i + 1])
            if i % 30 in (14, 29):
                transfer.end_episode(i % 30 == 14)

    live(ours, 0, n)
    state = ours.get_state()
    fresh = bound(METHODS[name]()).get_state()
    assert {key: (array.ndim, array.shape[1:]) for key, array in state.items()} == {
        key: (array.ndim, array.shape[1:]) for key, array in fresh.items()
    }
    assert all(array.dtype == np.float64 for array in state.values())
    theirs.set_state(state)
    asked = inside(300, 4, 5)
    same(ours, theirs, *asked)
    for transfer in (ours, theirs):
        live(transfer, n, n + 40)
    same(ours, theirs, *asked)


def test_angles_go_around():
    """The same dynamics seen half a turn on, so that the target crosses from 1 to 0 where the source is amid its data."""
    rng = np.random.default_rng(0)
    source = dataclasses.replace(f.oscillator_source(), periodic=(True, False))
    states, actions, effects = f.walk(f.copies_mapping(1), 200)
    turned = np.column_stack([(states[:, 0] + 0.5) % 1.0, states[:, 1]])
    next_states = np.column_stack([(turned[:, 0] + effects[:, 0]) % 1.0, states[:, 1] + effects[:, 1]])
    half_a_turn = np.array([2.0, 0.0])
    states_on, next_states_on = source.states + half_a_turn, source.next_states + half_a_turn
    shifted = dataclasses.replace(source, states=states_on, next_states=next_states_on)
    transfer = COMBREL(shifted, "factored", use="prior")
    task = dataclasses.replace(f.target_task(2, 3), periodic=(True, False))
    transfer.bind(task, rng)
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


def test_with_two_sources_the_one_that_fits_is_found():
    transfer = bound(METHODS["two sources"]())
    show(transfer, f.walk(TWO, 200))
    assert set(transfer.source_prior.copies.source[transfer.source_prior.choice.copies].ravel().tolist()) == {1}


def test_asking_leaves_no_trace():
    ours, theirs = (bound(METHODS["factored"]()) for _ in range(2))
    asked = inside(300, 4, 5)
    for i in range(80):
        one = f.walk(TWO, 1, seed=i)
        for transfer in (ours, theirs):
            show(transfer, one)
        ours.prior(asked[0][: 1 + i % 7], asked[1][: 1 + i % 7])
        ours.prior(*asked)
    same(ours, theirs, *asked)


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


def test_it_says_which_copies_each_action_moves():
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"))
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
    assert "Wait + Down" in transfer.source_action_names()
    assert sum(transfer.uses().values()) > 250
    assert MIN_TRANSITIONS > 5
