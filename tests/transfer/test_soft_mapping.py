"""Stochastic mappings: what they are made of, their error and its gradient, against plain loops."""

from itertools import product

import numpy as np
import pytest
import torch as th
from helpers import factored as f

from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.methods import soft_mapping as soft
from sb3_combrel.transfer.source_model import SourceModel

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
    assert sorted(rows, key=str) == sorted(naive_mappings(*size), key=str)
    assert len(rows) == soft.count_mappings(*size)


@pytest.mark.parametrize("size", SIZES)
def test_different_readings_have_different_logits_and_the_same_one_the_same(size):
    readings = soft.all_readings(*size)
    means = set(zip(readings.number.ravel(), readings.variable.ravel(), readings.sign.ravel(), strict=True))
    numbers = [number for number, _, _ in means]
    assert sorted(numbers) == list(range(soft.n_readings(*size)))


@pytest.mark.parametrize("size", SIZES)
def test_states_and_effects_are_carried_over_variable_by_variable(size):
    rng = np.random.default_rng(0)
    n_source, n_target, _ = size
    readings, mean = soft.all_readings(*size), rng.random(n_source)
    for variable, sign in zip(readings.variable, readings.sign, strict=True):
        states, effects = rng.random((5, n_target)), rng.normal(size=(5, n_source))
        expected, back = np.empty((5, n_source)), np.zeros((5, n_target))
        for k, v in enumerate(variable):
            expected[:, k] = mean[k] if v < 0 else states[:, v] if sign[k] > 0 else 1.0 - states[:, v]
            if v >= 0:
                back[:, v] = effects[:, k] if sign[k] > 0 else -effects[:, k]
        np.testing.assert_array_equal(soft.as_source(states, variable, sign, mean), expected)
        np.testing.assert_array_equal(soft.brought_back(effects, variable, sign, n_target), back)


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
    rng = np.random.default_rng(seed)
    readings = soft.all_readings(2, 3, True)
    logits = soft.Logits(rng.normal(size=(n_copies, 2, 6)), rng.normal(size=(n_copies, 4, 3)))
    data = soft.FitData(
        predicted=rng.normal(size=(n, len(readings.variable), 3, 3)),
        action=rng.integers(4, size=n),
        effect=rng.normal(size=(n, 3)),
        scale=0.5 + rng.random(3),
    )
    return readings, logits, data


def test_probabilities_are_products_normalised_over_the_mappings():
    readings, logits, _ = problem()
    for ours, theirs in zip(soft.probabilities(logits, readings), naive_probabilities(logits, readings), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_the_error_of_several_starts_is_that_of_plain_loops():
    readings, one, data = problem(0)
    _, other, _ = problem(1)
    starts = [th.from_numpy(np.stack(pair)) for pair in zip(one, other, strict=True)]
    expected = [naive_loss(one, readings, data), naive_loss(other, readings, data)]
    np.testing.assert_allclose(soft.loss(*starts, readings, data).numpy(), expected, rtol=1e-12)


def test_its_gradient_is_that_of_finite_differences():
    readings, logits, data = problem(2, n=3)
    starts = [th.from_numpy(each[None].copy()).requires_grad_() for each in logits]
    soft.loss(*starts, readings, data).sum().backward()
    for which, tensor in enumerate(starts):
        for place in np.ndindex(logits[which].shape):
            moved = []
            for step in (1e-6, -1e-6):
                there = soft.Logits(*(each.copy() for each in logits))
                there[which][place] += step
                moved.append(naive_loss(there, readings, data))
            assert tensor.grad[0][place].item() == pytest.approx((moved[0] - moved[1]) / 2e-6, rel=1e-4, abs=1e-6)


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


def mixture(sample, n_target=3):
    """The predictions of a random mixture, and what they are made of."""
    source = f.oscillator_source(200, rewards=lambda states: states[:, 0])
    model = SourceModel(stacked_instances([source]))
    rng = np.random.default_rng(0)
    readings = soft.all_readings(2, n_target, True)
    logits = soft.Logits(rng.normal(size=(2, 2, 2 * n_target)), rng.normal(size=(2, 4, 3)))
    predictions = soft.MixturePredictions(model, readings, np.array([0.5, 0.5]), sample)
    predictions.set_terms(soft.most_probable(*soft.probabilities(logits, readings), 4, 0.9))
    return predictions


def naive_mixture(predictions, state, action):
    """Effect, reward, end and weight, term by term."""
    terms, readings = predictions.terms, predictions.readings
    effect, outcomes = np.zeros(len(state)), np.zeros((3, 2))
    for t in range(terms.first[action], terms.first[action + 1]):
        variable, sign = readings.variable[terms.mapping[t]], readings.sign[terms.mapping[t]]
        at = np.array([state[v] if s > 0 else 1.0 - state[v] for v, s in zip(variable, sign, strict=True)])
        found = predictions.model.predict(at[None], terms.action[t : t + 1])
        for k, v in enumerate(variable):
            effect[v] += terms.share[t] * sign[k] * found.effect[0, k]
        outcomes[:, terms.copy[t]] += terms.share[t] * np.array([found.reward[0], found.end[0], found.weight[0]])
    return effect, outcomes[0].mean(), outcomes[1].prod(), outcomes[2].min()


@pytest.mark.parametrize("at_sample", [False, True])
def test_predictions_are_means_over_the_mixture(at_sample):
    sample = np.random.default_rng(1).integers(0, 4, size=(12, 3)) / 3.0
    predictions = mixture(sample)
    for action in range(4):
        actions = np.full(12, action)
        if not at_sample:
            actions[-1] = (action + 1) % 4
        found = predictions.predict(sample, actions)
        for i in range(12):
            expected = naive_mixture(predictions, sample[i], actions[i])
            for ours, theirs in zip(found, expected, strict=True):
                np.testing.assert_allclose(ours[i], theirs, rtol=1e-7, atol=1e-10)
