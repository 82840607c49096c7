"""The lines of Algorithm 1 in NumPy, and COMBREL against them."""

import math

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, show
from helpers.naive_transfer import as_sample, as_transitions, problem
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL, MappingSet
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.equations import TransferRules, Transitions
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(0, 40), st.integers(1, 8), st.sampled_from([0.0, 0.3, math.inf]))
def test_nearest_transitions_are_those_of_a_full_sort(seed, n_transitions, k, action_distance):
    rng = np.random.default_rng(seed)
    transitions = [naive.random_transition(rng, 2, 3) for _ in range(n_transitions)]
    state, action = rng.random(2), int(rng.integers(3))
    apart = []
    for i, t in enumerate(transitions):
        between = 0.0 if t.action == action else action_distance
        if between < math.inf:
            apart.append((math.sqrt(((state - t.state) ** 2).sum() + between**2), i))
    found = equations.nearest_transitions(state, action, as_sample(transitions, 2), k, action_distance)
    assert found.tolist() == [i for _, i in sorted(apart)[:k]]


def test_best_mapping_has_the_highest_mean_compliance_of_the_neighbours():
    compliances = np.array([[0.9, 0.4, 0.5, 0.5], [0.0, 0.6, 0.5, 0.4]])
    assert equations.best_mapping(compliances) == 1, "of equal means the first"
    assert equations.best_mapping(compliances[:1]) == 0 and equations.best_mapping(compliances, baseline=0.49) == 1
    assert equations.best_mapping(compliances, baseline=0.5) is None
    assert equations.best_mapping(np.zeros((3, 4))) is None and equations.best_mapping(compliances[:0]) is None


@settings(max_examples=25, deadline=None)
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
        assert (np.diff(weights if relevances is None else relevances[numbers]) <= 0.0).all()


MAPPINGS = MappingSet.all(2, 3, 2, 2, signs=True)
GRID = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def combrel_and_its_sample(seed, **kwargs):
    """COMBREL with every mapping, what it has observed, and the source."""
    rng = np.random.default_rng(seed)
    source, task = naive.random_source(rng, 60, 2, 2), naive.target_task(GRID, 2)
    method = bound(COMBREL(source, MAPPINGS, min_compliance=0.0, **kwargs), task)
    transitions = [naive.random_transition(rng, 3, 2) for _ in range(20)]
    for transition in transitions:
        show(method, transition)
    return method, as_sample(transitions, 3), as_transitions(source), rng


def mapping_of(method, candidate):
    """A candidate as a mapping; the source action of other actions than its own does not matter."""
    _, _, state_index, source_action = method.candidates.origins[candidate]
    of_row = [None if k < 0 else int(k) for k in MAPPINGS.state_mappings[state_index]]
    return InterTaskMapping(of_row, [source_action] * 2, MAPPINGS.state_signs[state_index])


def mean_compliances(method, sample, source, near, action, guard):
    """Lines 9-13 and 19 of Algorithm 1: mean compliance of every candidate of ``action`` with transitions ``near``."""
    first, usual = method.candidates.arrays.first, default_bandwidths(method.candidates.instances)
    sample_near, of_candidates = Transitions(*(column[near] for column in sample)), []
    for candidate in range(first[action], first[action + 1]):
        mapping = mapping_of(method, candidate)
        n_compared = len(mapping.state) - mapping.state.count(None)
        own = usual._replace(start=usual.start * n_compared / 2)
        of_candidates.append(equations.sample_compliance(sample_near, source, mapping, own, guard))
    return np.column_stack(of_candidates)


@settings(max_examples=5, deadline=None)
@given(seeds, st.integers(1, 5), st.sampled_from([0.0, 0.1]))
def test_combrel_selects_the_best_mapping_of_the_equations(seed, k, guard):
    method, sample, source, rng = combrel_and_its_sample(seed, n_neighbors=k, min_evidence=guard)
    states, actions, first = rng.random((4, 3)), np.tile(np.arange(2), 2), method.candidates.arrays.first
    chosen = method.selected(states, actions)
    changed_pairs(method)
    on_grid, asked = method.choices().reshape(2, -1), list(zip(states, actions, chosen, strict=True))
    asked += [(GRID[p], a, on_grid[a, p]) for a in (0, 1) for p in rng.choice(len(GRID), 2)]
    for state, action, candidate in asked:
        near = equations.nearest_transitions(state, action, sample, k)
        compliances = mean_compliances(method, sample, source, near, action, guard)
        best = equations.best_mapping(compliances)
        if best is None or candidate < 0:
            assert candidate < 0 and (best is None or compliances.mean(axis=0).max() < 1e-9)
        else:
            # Of mappings that comply equally well but for rounding either may be selected.
            means = compliances.mean(axis=0)
            assert means[candidate - first[action]] == pytest.approx(means[best], rel=1e-9)


@settings(max_examples=6, deadline=None)
@given(seeds, st.floats(0.1, 0.6))
def test_combrel_transfers_the_instances_of_the_equations(seed, breadth):
    method, _, source, rng = combrel_and_its_sample(seed, breadth=breadth)
    states, actions, own = rng.random((6, 3)), np.tile(np.arange(2), 3), rng.uniform(0.0, 1.2, 6)
    found = method.transferred(states, actions, own)
    chosen, last = method._instances.selector.select(states, actions, own)
    rules = TransferRules(breadth, method.task.exploration_threshold, method.task.min_weight, method.task.min_fraction)
    for row, (state, action) in enumerate(zip(states, actions, strict=True)):
        n = found.length[row]
        if chosen[row] == last[row]:
            assert n == 0
            continue
        virtual = equations.virtual_source(source, mapping_of(method, chosen[row]), action, state[None, :])
        numbers, weights = equations.transferred_instances(state, own[row], virtual, rules)
        assert n == len(numbers)
        np.testing.assert_allclose(found.weight[row, :n], weights, rtol=1e-9)
        np.testing.assert_allclose(found.effect[row, :n], virtual.effect[numbers], atol=1e-12)
        assert found.reward[row, :n].tolist() == virtual.reward[numbers].tolist()
        assert found.terminated[row, :n].tolist() == virtual.terminated[numbers].tolist()
