"""Soft homomorphisms: they find mappings that are known, and claim nothing else; their parts against plain loops."""

from itertools import product

import numpy as np
import pytest
import torch as th
from helpers import factored as f
from helpers.factored import bound, inside, show
from helpers.naive_transfer import random_source
from helpers.ring import Ring

from sb3_combrel import FittedRMax, SoftHomomorphism, SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.methods import soft_mapping as soft
from sb3_combrel.transfer.methods.soft_homomorphism import MAX_MAPPINGS
from sb3_combrel.transfer.methods.soft_mapping import count_mappings
from sb3_combrel.transfer.source_model import SourceModel

SWAPPED = f.copies_mapping(1, (1, 0))


def lopsided(states, actions):
    """Effects that are not those of the mirrored source, unlike those of the oscillator."""
    return (states - [0.2, 0.6]) @ f.SLOPES.T + 2.0 * np.abs(f.PUSH[actions])


def test_swapped_variables_are_found_from_a_few_transitions():
    method = bound(SoftHomomorphism(f.oscillator_source(), mirrored=False, n_starts=1), 2, 3)
    walked = f.walk(SWAPPED, 100)
    show(method, walked, ends=f.ends((walked[0] + walked[2])[:, ::-1]))
    state, action = method.mixture()
    assert state[0, 0, 0, 1] > 0.95 and state[0, 0, 1, 0] > 0.95
    assert action[0, 1].argmax() == 1 and action[0, 2].argmax() == 2
    assert action[0, 1].max() > 0.9 and action[0, 2].max() > 0.9
    states, actions = inside(100, 2, 3)
    predicted, expected = method.prior(states, actions), f.target_effects(SWAPPED, states, actions)
    assert ((predicted.effect - expected) ** 2).sum() < 0.01 * (expected**2).sum()
    assert predicted.weight.min() > 0.35
    assert method.statistics()["transfer/prediction_error"] < 0.1
    assert 10 <= method.statistics()["transfer/mapping_last_changed"] <= 100


def test_a_mirrored_variable_and_renamed_actions_are_found():
    """The target's first variable is the source's second, mirrored; its actions are the source's in another order."""
    rng, renamed = np.random.default_rng(1), np.array([2, 0])
    states, actions = rng.random((150, 2)), rng.integers(2, size=150)
    at = np.column_stack([states[:, 1], 1.0 - states[:, 0]])

    def pushed(states, actions):
        return lopsided(states, actions) + np.array([[0.0, 0.05], [0.0, 0.0], [0.04, -0.05]])[actions]

    effects = pushed(at, renamed[actions])
    method = bound(SoftHomomorphism(f.oscillator_source(effects=pushed), n_starts=2), 2, 2)
    show(method, (states, actions, np.column_stack([-effects[:, 1], effects[:, 0]])))
    state, action = method.mixture()
    assert state[0, 0, 0, 1] > 0.95 and state[0, 1, 1, 0] > 0.95 and action[0, [0, 1], renamed].min() > 0.85


def test_two_copies_of_the_source_are_told_apart():
    mapping = f.copies_mapping(2, (0, 2, 1, 3))
    method = bound(SoftHomomorphism(f.oscillator_source(), mirrored=False, n_starts=1), 4, 5)
    show(method, f.walk(mapping, 200))
    state, _ = method.mixture()
    read = [tuple(copy.argmax(axis=1).tolist()) for copy in state[:, 0]]
    assert sorted(read) == [(0, 2), (1, 3)] and state[:, 0].max(axis=2).min() > 0.95
    states, actions = inside(100, 4, 5)
    expected = f.target_effects(mapping, states, actions)
    assert ((method.prior(states, actions).effect - expected) ** 2).sum() < 0.03 * (expected**2).sum()


def test_the_prior_changes_with_each_fit_and_with_nothing_else():
    method = bound(SoftHomomorphism(f.oscillator_source(200), n_starts=1, max_transitions=40), 2, 3)
    versions = show(method, f.walk(SWAPPED, 60))
    # When there are square root of 2 times as many transitions as at the last fit.
    assert (np.flatnonzero(np.diff([0, *versions])) + 1).tolist() == [10, 15, 22, 32]
    assert method.statistics()["transfer/fits"] == 4


def test_before_the_first_fit_nothing_is_predicted():
    method = bound(SoftHomomorphism(f.oscillator_source(60)), 2, 3)
    show(method, f.walk(SWAPPED, 9))
    states, actions = inside(5, 2, 3)
    assert not any(np.any(array) for array in method.prior(states, actions))
    assert not method.changed(np.zeros((3, 3), dtype=bool))
    assert method.transferred(states, actions, np.zeros(5)).length.tolist() == [0] * 5
    with pytest.raises(ValueError, match="no mapping before the target has been seen for 10 transitions"):
        method.mixture()


def test_of_a_target_that_has_nothing_in_common_it_weighs_next_to_nothing_once_the_learner_predicts_better():
    rng = np.random.default_rng(2)
    states, actions = rng.random((100, 2)), rng.integers(3, size=100)
    method = bound(SoftHomomorphism(f.oscillator_source(), n_starts=1), 2, 3)
    show(method, (states, actions, 0.1 * np.sin(40.0 * states[:, ::-1])), own_error=0.001)
    assert 0.0 < method.prior(*inside(50, 2, 3)).weight.max() < 0.05


def test_periodic_variables_are_taken():
    rng, env = np.random.default_rng(0), Ring()
    states, actions = rng.random((300, 2)), rng.integers(2, size=300)
    low, high = env.observation_space.low, env.observation_space.high
    speed = np.clip(states[:, 1] + np.where(actions == 1, 0.075, -0.075), 0.0, 1.0)
    after = np.column_stack([(states[:, 0] + 0.05 * (2.0 * speed - 1.0)) % 1.0, speed])
    raw = [low + (high - low) * each for each in (states, after)]
    source = SourceInstances(raw[0], actions, -np.ones(300), raw[1], np.zeros(300, bool), low, high, 2, periodic=(True, False))
    method = SoftHomomorphism(source, n_starts=1)
    model = FittedRMax(env, transfer=method, periodic=[True, False], resolution=4, seed=0).learn(120)
    assert model.policy.transfer.statistics()["transfer/prediction_error"] < 0.2


def test_too_many_mappings_are_refused_when_bound():
    five = random_source(np.random.default_rng(0), 20, 5, 1)
    assert count_mappings(5, 5, True) == 3840 > MAX_MAPPINGS
    with pytest.raises(ValueError, match=r"at most 2,000 mappings of states, got 3,840 .*mirrored=False"):
        bound(SoftHomomorphism(five), 5, 3)
    bound(SoftHomomorphism(five, mirrored=False), 5, 3)


def test_a_source_with_more_variables_than_the_target_leaves_some_out():
    """The target is the source's first variable under a push that is the source's second, held at its mean."""
    rng = np.random.default_rng(3)
    states, actions = rng.random((100, 1)), rng.integers(2, size=100)
    source = f.oscillator_source()
    mean = source.scaling.to_unit(source.states)[:, 0].mean()
    moves = f.oscillate(np.column_stack([np.full(100, mean), states[:, 0]]), actions + 1)[:, 1:]
    method = bound(SoftHomomorphism(source, mirrored=False, n_starts=1), 1, 2)
    show(method, (states, actions, moves))
    state, action = method.mixture()
    assert state.shape == (1, 2, 2, 1) and state[0, 0, 1, 0] > 0.9
    assert action[0].argmax(axis=1).tolist() == [1, 2]


SIZES = [(1, 1, True), (2, 2, False), (2, 2, True), (2, 4, True), (3, 2, True), (3, 1, False)]


def naive_mappings(n_source, n_target, mirrored):
    """Every way to read: None, or a target variable and its sign, for each source variable."""
    choices = [None, *product(range(n_target), (1, -1) if mirrored else (1,))]
    found = []
    for row in product(choices, repeat=n_source):
        read = [each[0] for each in row if each is not None]
        if len(read) == len(set(read)) == min(n_source, n_target):
            found.append(row)
    return found


@pytest.mark.parametrize("size", SIZES)
def test_all_mappings_are_listed_once_and_counted(size):
    readings = soft.all_readings(*size)
    rows = [
        tuple(None if v < 0 else (v, int(s)) for v, s in zip(variable, sign, strict=True))
        for variable, sign in zip(readings.variable.tolist(), readings.sign.tolist(), strict=True)
    ]
    assert sorted(rows, key=str) == sorted(naive_mappings(*size), key=str) and len(rows) == soft.count_mappings(*size)
    # Different readings have different logits, and the same one the same.
    means = set(zip(readings.number.ravel(), readings.variable.ravel(), readings.sign.ravel(), strict=True))
    assert sorted(number for number, _, _ in means) == list(range(1 + readings.number.max()))


@pytest.mark.parametrize("size", SIZES)
def test_states_and_effects_are_carried_over_variable_by_variable(size):
    rng = np.random.default_rng(0)
    n_source, n_target, _ = size
    readings, mean = soft.all_readings(*size), rng.random(n_source)
    for m, (variable, sign) in enumerate(zip(readings.variable, readings.sign, strict=True)):
        states, effects = rng.random((5, n_target)), rng.normal(size=(5, n_source))
        expected, back = np.empty((5, n_source)), np.zeros((5, n_target))
        for k, v in enumerate(variable):
            expected[:, k] = mean[k] if v < 0 else states[:, v] if sign[k] > 0 else 1.0 - states[:, v]
            if v >= 0:
                back[:, v] = effects[:, k] if sign[k] > 0 else -effects[:, k]
        for mapping in (m, np.full(5, m)):
            np.testing.assert_array_equal(soft.to_source(states, readings, mapping, mean), expected)
            np.testing.assert_array_equal(soft.to_target(effects, readings, mapping, n_target), back)


def softmax(values):
    return np.exp(values) / np.exp(values).sum()


def naive_probabilities(logits, readings):
    of_mapping = []
    for copy in logits.state:
        weights = [np.prod([softmax(copy[k])[r] for k, r in enumerate(row)]) for row in readings.number]
        of_mapping.append(np.array(weights) / np.sum(weights))
    return np.array(of_mapping), np.array([[softmax(row) for row in copy] for copy in logits.action])


def naive_loss(logits, readings, data):
    of_mapping, of_action = naive_probabilities(logits, readings)
    total = 0.0
    for i, a in enumerate(data.action):
        for v in range(data.effect.shape[1]):
            mean = 0.0
            for c in range(len(of_mapping)):
                for m in range(of_mapping.shape[1]):
                    for b in range(of_action.shape[2]):
                        mean += of_mapping[c, m] * of_action[c, a, b] * data.predicted[i, m, b, v]
            total += np.sqrt(1.0 + ((mean - data.effect[i, v]) / data.scale[v]) ** 2) - 1.0
    return total + sum((each**2).sum() for each in logits) / (2.0 * soft.LOGIT_DEVIATION**2)


def problem(seed=0, n=6, n_copies=2):
    """Random parameters and transitions of two source and three target variables."""
    rng, readings = np.random.default_rng(seed), soft.all_readings(2, 3, True)
    logits = soft.Logits(rng.normal(size=(n_copies, 2, 6)), rng.normal(size=(n_copies, 4, 3)))
    data = soft.FitData(
        predicted=rng.normal(size=(n, len(readings.variable), 3, 3)),
        action=rng.integers(4, size=n),
        effect=rng.normal(size=(n, 3)),
        scale=0.5 + rng.random(3),
    )
    return readings, logits, data


def test_probabilities_and_the_error_of_several_starts_are_those_of_plain_loops():
    readings, one, data = problem(0)
    for ours, theirs in zip(soft.probabilities(one, readings), naive_probabilities(one, readings), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    _, other, _ = problem(1)
    starts = [th.from_numpy(np.stack(pair)) for pair in zip(one, other, strict=True)]
    expected = [naive_loss(one, readings, data), naive_loss(other, readings, data)]
    np.testing.assert_allclose(soft.loss(*starts, readings, data).numpy(), expected, rtol=1e-12)


def test_a_fit_is_no_worse_than_where_it_starts_and_depends_on_its_seed_alone():
    readings, logits, data = problem(3)
    fits = [soft.fit(logits, logits, readings, data, 2, seed=seed) for seed in (5, 5, 6)]
    before = naive_loss(logits, readings, data)
    assert all(naive_loss(each, readings, data) < before for each in fits)
    for ours, theirs in zip(fits[0], fits[1], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    first = [soft.fit(None, logits, readings, data, 1, seed=seed).state for seed in (5, 6)]
    assert not np.array_equal(*first)


@pytest.mark.parametrize(("max_terms", "mass"), [(3, 1.0), (100, 0.5), (100, 1.0), (1, 0.1)])
def test_the_most_probable_parts_come_first_and_add_up_to_one(max_terms, mass):
    readings, logits, _ = problem(4)
    of_mapping, of_action = soft.probabilities(logits, readings)
    terms = soft.most_probable(of_mapping, of_action, max_terms, mass)
    for a in range(4):
        rows = slice(terms.first[a], terms.first[a + 1])
        for c in range(2):
            mine = terms.copy[rows] == c
            joint = np.sort(np.outer(of_mapping[c], of_action[c, a]).ravel())[::-1]
            n = min(max_terms, 1 + int((np.cumsum(joint) < mass - 1e-12).sum()), len(joint))
            assert mine.sum() == n
            np.testing.assert_allclose(terms.share[rows][mine], joint[:n] / joint[:n].sum())
            of_terms = of_mapping[c, terms.mapping[rows][mine]] * of_action[c, a, terms.action[rows][mine]]
            np.testing.assert_allclose(of_terms, joint[:n])


def mixture(n_target=3):
    """The predictions of a random mixture, and what they are made of."""
    source = f.oscillator_source(200, rewards=lambda states: states[:, 0])
    model = SourceModel(stacked_instances([source]), 0.2)
    rng, readings = np.random.default_rng(0), soft.all_readings(2, n_target, True)
    logits = soft.Logits(rng.normal(size=(2, 2, 2 * n_target)), rng.normal(size=(2, 4, 3)))
    predictions = soft.MixturePredictions(model, readings, np.array([0.5, 0.5]))
    predictions.set_terms(soft.most_probable(*soft.probabilities(logits, readings), 4, 0.9))
    return predictions


def naive_mixture(predictions, state, action):
    """Effect, reward and weight, term by term."""
    terms, readings = predictions.terms, predictions.readings
    effect, outcomes = np.zeros(len(state)), np.zeros((2, 2))
    for t in range(terms.first[action], terms.first[action + 1]):
        variable, sign = readings.variable[terms.mapping[t]], readings.sign[terms.mapping[t]]
        at = np.array([state[v] if s > 0 else 1.0 - state[v] for v, s in zip(variable, sign, strict=True)])
        found = predictions.model.predict(at[None], terms.action[t : t + 1])
        for k, v in enumerate(variable):
            effect[v] += terms.share[t] * sign[k] * found.effect[0, k]
        outcomes[:, terms.copy[t]] += terms.share[t] * np.array([found.reward[0], found.weight[0]])
    return effect, outcomes[0].mean(), outcomes[1].min()


def test_predictions_are_means_over_the_mixture():
    states, predictions = np.random.default_rng(1).integers(0, 4, size=(12, 3)) / 3.0, mixture()
    for actions in (np.full(12, 2), np.arange(12) % 4):
        found = predictions.predict(states, actions)
        for i in range(12):
            for ours, theirs in zip(found, naive_mixture(predictions, states[i], actions[i]), strict=True):
                np.testing.assert_allclose(ours[i], theirs, rtol=1e-7, atol=1e-10)
