"""The lines of Algorithm 1 in NumPy: neighbours, the choice of a mapping, transferred instances, against plain loops."""

import math

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.equation_problems import as_sample, as_transitions, problem
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.equations import Bandwidths, TransferRules, Transitions

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=200, deadline=None)
@given(seeds, st.integers(0, 40), st.integers(1, 8), st.sampled_from([0.0, 0.3, math.inf]))
def test_nearest_transitions_are_those_of_a_full_sort(seed, n_transitions, k, action_distance):
    rng = np.random.default_rng(seed)
    transitions = [naive.random_transition(rng, 2, 3) for _ in range(n_transitions)]
    state, action = rng.random(2), int(rng.integers(3))
    apart = []
    for i, t in enumerate(transitions):
        between = 0.0 if t.action == action else action_distance
        if between < math.inf:
            apart.append((math.sqrt(naive.distance(state, t.state) ** 2 + between**2), i))
    found = equations.nearest_transitions(state, action, as_sample(transitions, 2), k, action_distance)
    assert found.tolist() == [i for _, i in sorted(apart)[:k]]


def test_best_mapping_has_the_highest_mean_compliance_of_the_neighbours():
    compliances = np.array([[0.9, 0.4, 0.5, 0.5], [0.0, 0.6, 0.5, 0.4]])
    assert equations.best_mapping(compliances) == 1, "of equal means the first"
    assert equations.best_mapping(compliances[:1]) == 0
    assert equations.best_mapping(compliances, baseline=0.49) == 1
    assert equations.best_mapping(compliances, baseline=0.5) is None
    assert equations.best_mapping(np.zeros((3, 4))) is None
    assert equations.best_mapping(compliances[:0]) is None


def test_whole_action_mappings_differ_only_when_neighbours_of_other_actions_count():
    """Two mappings that agree in the first action: Table 2 counts such mappings apart."""
    source = Transitions(
        np.array([[0.5], [0.5], [0.5]]), np.array([0, 1, 2]), np.array([[0.0], [-0.1], [0.1]]), np.zeros(3), np.zeros(3, bool)
    )
    sample = Transitions(np.array([[0.5], [0.5]]), np.array([0, 1]), np.array([[0.0], [0.1]]), np.zeros(2), np.zeros(2, bool))
    mappings = [InterTaskMapping([0], [0, 1]), InterTaskMapping([0], [0, 2])]
    bandwidths = Bandwidths(0.02, 0.001, 1.0)
    compliances = np.column_stack([equations.sample_compliance(sample, source, m, bandwidths) for m in mappings])
    same_action = equations.nearest_transitions(np.array([0.5]), 0, sample, 3)
    together = equations.nearest_transitions(np.array([0.5]), 0, sample, 3, action_distance=0.2)
    assert same_action.tolist() == [0]
    assert compliances[same_action].mean(axis=0).tolist() == [1.0, 1.0]
    assert together.tolist() == [0, 1]
    assert equations.best_mapping(compliances[together]) == 1


@settings(max_examples=80, deadline=None)
@given(
    seeds,
    st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 2), st.just(1)),
    st.builds(
        TransferRules, st.floats(0.05, 0.6), st.floats(0.3, 4.0), st.sampled_from([0.001, 0.3]), st.sampled_from([0.01, 0.5])
    ),
    st.booleans(),
)
def test_transferred_instances_are_those_of_plain_loops(seed, sizes, rules, by_relevance):
    source, mapping, _ = problem(seed, sizes, n_instances=40, spread=1.0)
    rng = np.random.default_rng(seed)
    state, own = rng.random(sizes[1]), float(rng.choice([0.0, rng.uniform(0.0, 1.2 * rules.threshold)]))
    relevances = rng.random(len(source)) if by_relevance else None
    of_action = source.actions == mapping.action[0]
    virtual = equations.virtual_source(as_transitions(source), mapping, 0, state[None, :])
    numbers, weights = equations.transferred_instances(
        state, own, virtual, rules, relevances[of_action] if by_relevance else None
    )
    task = naive.target_task(state[None, :], 1, rules.threshold, rules.min_weight, rules.min_fraction)
    merit = (lambda _, j: relevances[j]) if by_relevance else None
    expected = naive.transferred(state, own, [(source, mapping, 0)], task, rules.breadth, merit)
    assert len(numbers) == len(expected)
    for j, weight, (naive_weight, effect, reward, terminated) in zip(numbers, weights, expected, strict=True):
        assert weight == pytest.approx(naive_weight, rel=1e-9)
        np.testing.assert_allclose(virtual.effect[j], effect, atol=1e-12)
        assert (virtual.reward[j], virtual.terminated[j]) == (reward, terminated)


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0.05, 0.6), st.floats(0.3, 4.0), st.booleans())
def test_transferred_instances_reach_the_threshold_with_none_to_spare_or_there_are_none(
    seed, breadth, threshold, by_relevance
):
    source, mapping, _ = problem(seed, (2, 3, 1, 1), n_instances=40, spread=1.0)
    rng = np.random.default_rng(seed)
    state, own, rules = rng.random(3), rng.uniform(0.0, 1.2 * threshold), TransferRules(breadth, threshold, 0.01, 0.1)
    virtual = equations.virtual_source(as_transitions(source), mapping, 0, state[None, :])
    relevances = rng.random(40) if by_relevance else None
    numbers, weights = equations.transferred_instances(state, own, virtual, rules, relevances)
    assert len(set(numbers.tolist())) == len(numbers)
    if own >= threshold:
        assert len(numbers) == 0
    if len(numbers):
        assert own + weights.sum() >= threshold - 1e-12 > own + weights[:-1].sum() - 2e-12
        order = weights if relevances is None else relevances[numbers]
        assert (np.diff(order) <= 0.0).all()
