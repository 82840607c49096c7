"""A source's own model against a plain computation, and as a prior: what it says of targets that it fits, and of others."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import bound, inside, naive_prediction, show
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, InterTaskMapping
from sb3_combrel.common.instances import Instances
from sb3_combrel.transfer.prior.evidence import PROBABILITIES, SMALLEST_ERROR, STRENGTHS, PriorEvidence
from sb3_combrel.transfer.source_model import N_NEIGHBORS, OUTCOME_BREADTH, SourceModel

TWO = f.copies_mapping(2, (0, 2, 1, 3))
ALONG_FIRST = InterTaskMapping([0, None, 1, None], [0, 1, 2, 0, 0])


def naive(source, mapping, state, action):
    """Effect, mean reward and least weight of a factored mapping's copies, one after the other."""
    effect, rewards, weights = np.zeros(len(state)), [], []
    unit_states = source.scaling.to_unit(source.states)
    unit_effects = source.scaling.to_unit(source.next_states) - unit_states
    for copy in mapping.copies:
        used = sorted({k for k in copy.state if k is not None})
        rows = source.actions == copy.action[action]
        at = copy.target_to_source(state, source.n_variables)[used]
        data = unit_states[rows][:, used], unit_effects[rows][:, used], source.rewards[rows], source.terminated[rows]
        predicted, reward, _, weight = f.naive_prediction(*data, at, 0.2, 24, 0.05)
        whole = np.zeros(source.n_variables)
        whole[used] = predicted
        effect += copy.displacement_to_target(whole)
        rewards.append(reward), weights.append(weight)
    return effect, np.mean(rewards), min(weights)


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
    effect, reward, weight = prior._raw(states, actions)
    for i in range(0, n, 1 + n // 20):
        expected = naive(source, mapping, states[i], actions[i])
        for ours, theirs in zip((effect[i], reward[i], weight[i]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-9)


def test_before_any_transition_a_mapping_that_is_given_or_drawn_predicts_and_one_to_be_chosen_does_not():
    states, actions = inside(300, 4, 5)
    given, chosen = (bound(COMBREL(f.oscillator_source(), each, use="prior")) for each in (TWO, "factored"))
    drawn = bound(TIMBREL(f.oscillator_source(), "random", mappings="factored", use="prior"))
    np.testing.assert_allclose(given.prior(states, actions).effect, f.target_effects(TWO, states, actions), atol=1e-3)
    # As much as one own instance where it has many data, and never more.
    weight = given.prior(states, actions).weight
    assert (weight > 0.35).all() and (weight < 1.0).all()
    assert not any(array.any() for array in chosen.prior(states, actions))
    assert drawn.prior(states, actions).effect.any()


@pytest.mark.parametrize(("n_copies", "seed"), [(2, 0), (3, 1)])
def test_an_exact_source_is_found(n_copies, seed):
    mapping = f.copies_mapping(n_copies, np.random.default_rng(seed).permutation(2 * n_copies).tolist())
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"), 2 * n_copies, 2 * n_copies + 1, seed)
    versions = show(transfer, f.walk(mapping, 150 * n_copies, seed))
    states, actions = inside(300, 2 * n_copies, 2 * n_copies + 1)
    found = transfer.prior(states, actions)
    np.testing.assert_allclose(found.effect, f.target_effects(mapping, states, actions), atol=1e-3)
    assert (found.weight > 0.35).all()
    assert transfer.statistics()["transfer/prediction_error"] < 0.01
    # Ever more rarely.
    assert max(show(transfer, f.walk(mapping, 300, seed + 100))) <= versions[-1] + 3 and 1 <= versions[-1] <= 30
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


def test_a_source_of_noise_bounds_no_values_and_weighs_next_to_nothing_once_the_learner_predicts_better():
    states, actions = inside(300, 4, 5)
    for transfer in (
        COMBREL(noise_source(0), "factored", use="prior"),
        COMBREL(noise_source(0), "injective", use="prior"),
        TIMBREL(noise_source(0), "random", mappings="factored", use="prior"),
    ):
        bound(transfer)
        for part in range(3):
            show(transfer, f.walk(TWO, 70, 10 * part), own_error=0.001)
            assert transfer.value_bound() is None
        assert transfer.prior(states, actions).weight.mean() < 0.05


def test_a_warning_says_so_of_a_given_mapping_that_is_wrong():
    transfer = bound(TIMBREL(noise_source(0), TWO, use="prior"))
    with pytest.warns(UserWarning, match=r"Oscillator-v0 predicts the target worse .* is \d") as caught:
        show(transfer, f.walk(TWO, 600))
    [warning] = caught
    assert "tests" in Path(warning.filename).parts and transfer.statistics()["transfer/prediction_error"] > 1.0


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
        # It says nothing of what the copy does not have.
        assert found.weight[:, explained].all() and not found.weight[:, rest].any()


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
        assert (found.weight > 0.35).mean() > 0.95


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
    assert (found.weight >= 0.0).all()


def test_of_two_sources_the_one_that_fits_is_found_and_it_says_which_copies_each_action_moves():
    transfer = bound(COMBREL([noise_source(3), f.oscillator_source()], "factored", use="prior"))
    assert transfer.describe_prior().startswith("a0: nothing; a1: nothing")
    assert (transfer.choices() == -1).all() and transfer.mapping_counts() == []
    show(transfer, f.walk(TWO, 300))
    first, second = "of source 2 on (s0, s2) as (x, v)", "of source 2 on (s1, s3) as (x, v)"
    assert transfer.describe_prior() == (
        f"a0: Wait {first}, Wait {second}; a1: Down {first}, Wait {second}; a2: Up {first}, Wait {second}; "
        f"a3: Wait {first}, Down {second}; a4: Wait {first}, Up {second}"
    )
    [first, *_] = transfer.choices().reshape(5, -1)[3]
    assert transfer.candidate(first) == (3, "Wait of source 2 + Down of source 2", "(s0, s2) + (s1, s3)", ())
    assert (transfer.selected(np.zeros((2, 4)), np.array([3, 3])) == first).all()
    assert transfer.describe(first) == "a3<-Wait of source 2 + Down of source 2 with (s0, s2) + (s1, s3)"
    assert "Wait of source 2 + Down of source 2" in transfer.source_action_names() and sum(transfer.uses().values()) > 250
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
    st.sampled_from([0.03, 0.2, 0.6]),
)
def test_predictions_are_those_of_a_weighted_regression(seed, d, n, breadth):
    rng = np.random.default_rng(seed)
    instances = random_instances(rng, n, d, 2)
    model = SourceModel(instances, breadth)
    states, actions = 1.4 * rng.random((20, d)) - 0.2, rng.integers(2, size=20)
    found = model.predict(states, actions)
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        size = instances.size[action]
        if size == 0:
            assert not np.any(found.effect[i]) and found.weight[i] == found.end[i] == found.reward[i] == 0.0
            continue
        of_action = (array[action, :size] for array in instances[:4])
        expected = naive_prediction(*of_action, state, breadth, N_NEIGHBORS, OUTCOME_BREADTH)
        for ours, theirs in zip((found.effect[i], found.reward[i], found.end[i], found.weight[i]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)


# How much a source's effects weigh.
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 40))
def test_strength_is_the_mean_of_the_posterior_of_as_how_many_own_instances_it_counts(seed, d, n):
    rng = np.random.default_rng(seed)
    evidence, actions = PriorEvidence(2, d), rng.integers(2, size=n)
    effects, predicted, own = rng.normal(size=(3, n, d)) * np.array([1.0, 0.1, 1.0])[:, None, None]
    leverage, weights = np.maximum(0.0, rng.normal(size=n)), rng.gamma(1.0, size=n)
    for i in range(n):
        evidence.note(int(actions[i]), effects[i], predicted[i], (own[i], leverage[i]), (-1.0, -1.0), weights[i])
    np.testing.assert_array_equal(evidence.strength, STRENGTHS @ PROBABILITIES)
    evidence.renew()
    for a in range(2):
        for v in range(d):
            rows = [i for i in range(n) if actions[i] == a and leverage[i] > 0.0]
            squared = [(effects[i, v] - own[i, v]) ** 2 + SMALLEST_ERROR**2 for i in rows]
            density = np.zeros(len(STRENGTHS))
            for k, i in enumerate(rows):
                scale = np.exp(0.5 * np.mean(np.log(squared[: k + 1])))
                # The mean of so many instances at the state, and of own ones that are worth 1 / leverage of them.
                p = STRENGTHS * weights[i] / (1.0 + weights[i])
                mean = (p * predicted[i, v] + own[i, v] / leverage[i]) / (p + 1.0 / leverage[i])
                density += stats.t.logpdf((effects[i, v] - mean) / scale, df=1)
            posterior = PROBABILITIES * np.exp(density - density.max())
            np.testing.assert_allclose(evidence.strength[a, v], posterior @ STRENGTHS / posterior.sum(), rtol=1e-6)
            alone = evidence.no_source(np.arange(d) == np.full((2, 1), v))[a]
            np.testing.assert_allclose(alone, posterior[0] / posterior.sum(), rtol=1e-6, atol=1e-12)
    assert np.isnan(evidence.no_source(np.zeros((2, d), dtype=np.bool_))).all()
    found = evidence.weights(weights, actions)
    np.testing.assert_allclose(found, (weights / (1.0 + weights))[:, None] * evidence.strength[actions])
    restored = PriorEvidence(2, d)
    restored.set_state(evidence.get_state())
    np.testing.assert_array_equal(restored.get_state(), evidence.get_state())


def test_a_source_that_an_episode_has_contradicted_weighs_less_at_its_end_and_nothing_changes_without_evidence():
    transfer, (states, actions) = bound(TIMBREL(noise_source(0), TWO, use="prior")), inside(300, 4, 5)
    transitions = f.walk(TWO, 330)
    show(transfer, tuple(array[:270] for array in transitions))
    transfer.end_episode(True)
    version, before = transfer.prior_version(), transfer.prior(states, actions).weight.mean()
    assert show(transfer, tuple(array[270:330] for array in transitions), own_error=0.001) == [version] * 60
    transfer.end_episode(True)
    assert transfer.prior_version() == version + 1 and transfer.prior(states, actions).weight.mean() < 0.05 * before
    transfer.end_episode(True)
    assert transfer.prior_version() == version + 1
    strengths = transfer.report().history[-1].strengths
    show(transfer, tuple(array[:1] for array in transitions))
    *_, earlier, of_end, now = transfer.report().history
    assert earlier.step < of_end.step == 330 < now.step and of_end.strengths == strengths != earlier.strengths


@pytest.mark.parametrize(
    ("rewards", "expected", "explained"),
    [
        # As predicted; all alike, but not as predicted; of the other sign; ten times as large; less far off than their mean.
        ([-1.0, -1.0, -1.0], [-1.0, -1.0, -1.0], True),
        ([0.0, 0.0, 0.0], [-1.0, -1.0, -1.0], False),
        ([1.0, 2.0, 3.0], [-1.0, -2.0, -3.0], False),
        ([1.0, 2.0, 3.0], [10.0, 20.0, 30.0], False),
        ([0.0, 1.0, 0.0], [0.1, 0.9, 0.1], True),
    ],
)
@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_rewards_that_are_another_function_are_noticed(rewards, expected, explained, unit):
    evidence, effect = PriorEvidence(1, 1, unit), np.array([0.1])
    for reward, foretold in zip(rewards, expected, strict=True):
        evidence.note(0, effect, effect, None, (unit * reward, unit * foretold), 100.0)
    assert evidence.explains_rewards() == explained


@pytest.mark.parametrize("size", [1.0, 12345.678])
def test_rewards_that_differ_by_rounding_are_the_same(size):
    evidence, effect = PriorEvidence(1, 1, size), np.array([0.1])
    for _ in range(100):
        evidence.note(0, effect, effect, None, (float(np.float32(-size)), -size), 100.0)
    assert evidence.explains_rewards()


def test_the_strength_of_an_action_is_that_on_the_variables_of_which_the_source_speaks():
    evidence = PriorEvidence(3, 2)
    evidence.strength[:] = [[4.0, 0.01], [1.0, 4.0], [1.0, 1.0]]
    found = evidence.strength_of_actions(np.array([[True, False], [True, True], [False, False]]))
    np.testing.assert_allclose(found, [4.0, 2.0, np.nan])


def strength_after(n, predicted, own_error, **wall):
    """After so many transitions with an effect of 0.1; ``wall``: transitions besides, that nobody foresaw."""
    evidence = PriorEvidence(1, 1)
    for _ in range(n):
        evidence.note(0, np.array([0.1]), np.array([predicted]), (np.array([0.1 + own_error]), 1.0), (-1.0, -1.0), 100.0)
    for _ in range(wall.get("n_walls", 0)):
        evidence.note(0, np.array([0.0]), np.array([predicted]), (np.array([0.1 + own_error]), 1.0), (-1.0, -1.0), 100.0)
    evidence.renew()
    return evidence.strength[0, 0]


def test_a_source_that_is_right_counts_most_and_one_that_is_wrong_next_to_nothing():
    assert strength_after(50, 0.1, 0.02) > 0.95 * max(STRENGTHS)
    assert strength_after(50, 0.3, 0.02) < 0.01
    # As good as the learner itself, but wrong the other way: their mean is best.
    assert 0.5 < strength_after(50, 0.08, 0.02) < 2.0


def test_no_single_transition_decides():
    """One that hits a wall, which neither foresaw, among many of which the source is right."""
    assert strength_after(30, 0.1, 0.02, n_walls=1) > 0.9 * strength_after(30, 0.1, 0.02)
