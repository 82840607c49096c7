"""Eqs. 1-7 in NumPy: their properties, cases with a known answer, and the compiled code against them."""

import math
from itertools import pairwise

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.naive_transfer import as_sample, as_transitions, problem
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.candidates import stacked_instances, stacked_table
from sb3_combrel.transfer.equations import Bandwidths, Transitions
from sb3_combrel.transfer.instances.compliance import ComplianceScratch, transition_compliance
from sb3_combrel.transfer.instances.relevance import near_relevance, relevance

GUARD = naive.LEAST_EVIDENCE
seeds = st.integers(0, 2**32 - 1)
sizes = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
some_bandwidths = st.builds(Bandwidths, start=st.floats(0.003, 0.5), outcome=st.floats(0.002, 0.5), reward=st.floats(0.1, 5.0))
some_mus = st.floats(0.02, 1.0)


def compiled_tables(sample, sources, sets, bandwidths, min_evidence=GUARD, starts=None):
    """
    Compiled compliance, shape (n_transitions, n_state_mappings, n_source_actions).

    :param starts: start bandwidth of each state mapping, or None for that of ``bandwidths``
    """
    instances, table = stacked_instances(sources), stacked_table(sets)
    tables = np.full((len(sample.reward), len(table.variable), len(instances.size)), np.nan)
    scratch = ComplianceScratch.for_mappings(table, instances, bandwidths.start if starts is None else starts, min_evidence)
    given = tuple(instances), tuple(table), tuple(bandwidths), tuple(scratch)
    for state, effect, reward, found in zip(sample.state, sample.effect, sample.reward.tolist(), tables, strict=True):
        transition_compliance(state, effect, reward, *given, found)
    return tables


def compiled_relevances(sample, source, mapping, action, bandwidths, mu):
    """Compiled relevance, and the one that does not favour distant instances, of the instances for ``action``, in order."""
    instances, source_action, of_action = stacked_instances([source]), mapping.action[action], sample.with_action(action)
    found, near, evidence = np.full((3, int(instances.size.max())), np.nan)
    target, scratch = (of_action.state, of_action.effect, of_action.reward), np.empty(len(of_action.reward))
    given = instances, source_action, (mapping.state_index, mapping.state_sign, np.zeros(len(mapping.state), bool)), bandwidths
    relevance(target, *given, mu, scratch, found)
    near_relevance(target, *given, scratch, evidence, near)
    order = naive.places_of(source, instances)[source.actions == source_action]
    return found[order], near[order]


@settings(max_examples=30, deadline=None)
@given(seeds, sizes, some_bandwidths, st.sampled_from([0.0, 0.01, GUARD, 1.0]), st.sampled_from([1, 40]))
def test_compiled_compliance_is_that_of_the_equations(seed, sizes, bandwidths, guard, n_instances):
    source, mapping, transitions = problem(seed, sizes, n_instances)
    sample, mappings = as_sample(transitions, sizes[1]), MappingSet.from_list([mapping])
    expected = equations.sample_compliance(sample, as_transitions(source), mapping, bandwidths, guard)
    tables = compiled_tables(sample, [source], [mappings], bandwidths, guard)
    found = tables[np.arange(len(transitions)), 0, np.array(mapping.action)[sample.action]]
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seeds, some_bandwidths, st.integers(1, 3))
def test_compiled_compliance_has_a_start_bandwidth_for_each_state_mapping(seed, bandwidths, n_source):
    source, _, transitions = problem(seed, (n_source, 3, 2, 2), n_instances=40)
    rng, instances = np.random.default_rng(seed), as_transitions(source)
    sample, mappings = as_sample(transitions, 3), MappingSet.all(n_source, 3, 2, 2)
    starts = rng.choice([bandwidths.start, 0.01, 0.2], mappings.n_state_mappings)
    tables = compiled_tables(sample, [source], [mappings], bandwidths, starts=starts)
    for number in rng.choice(len(mappings), 6):
        mapping, row = mappings[int(number)], int(number) // mappings.n_action_mappings
        own = bandwidths._replace(start=starts[row])
        expected = equations.sample_compliance(sample, instances, mapping, own, GUARD)
        found = tables[np.arange(len(transitions)), row, np.array(mapping.action)[sample.action]]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        assert equations.task_compliance(expected, prior=0.25) == pytest.approx(expected.mean() / 4)


def test_sources_side_by_side_have_the_compliance_that_each_has_alone():
    rng = np.random.default_rng(0)
    sources = [naive.random_source(rng, 50, 1, 2), naive.random_source(rng, 80, 3, 4)]
    sets = [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources]
    sample, bandwidths = as_sample([naive.random_transition(rng, 3, 2) for _ in range(10)], 3), Bandwidths(0.1, 0.05, 1.0)
    together = compiled_tables(sample, sources, sets, bandwidths)
    rows = np.cumsum([0] + [s.n_state_mappings for s in sets])
    actions = np.cumsum([0] + [s.n_actions for s in sources])
    for k, (source, mappings) in enumerate(zip(sources, sets, strict=True)):
        alone = compiled_tables(sample, [source], [mappings], bandwidths)
        assert (alone > 0.0).any()
        of_source = together[:, rows[k] : rows[k + 1], actions[k] : actions[k + 1]]
        np.testing.assert_allclose(of_source, alone, rtol=1e-12, atol=1e-15)


@settings(max_examples=25, deadline=None)
@given(seeds, sizes, some_bandwidths, st.sampled_from([0.0, 0.1, 1.0]))
def test_compliance_is_between_0_and_1_and_does_not_depend_on_the_order_of_instances(seed, sizes, bandwidths, guard):
    source, mapping, transitions = problem(seed, sizes)
    sample, instances = as_sample(transitions, sizes[1]), as_transitions(source)
    found = equations.sample_compliance(sample, instances, mapping, bandwidths, guard)
    assert ((found >= 0.0) & (found <= 1.0 + 1e-12)).all()
    order = np.random.default_rng(seed).permutation(len(source))
    shuffled = Transitions(*(column[order] for column in instances))
    again = equations.sample_compliance(sample, shuffled, mapping, bandwidths, guard)
    np.testing.assert_allclose(again, found, rtol=1e-12, atol=1e-15)


@settings(max_examples=25, deadline=None)
@given(seeds, sizes, some_bandwidths)
def test_more_evidence_demanded_makes_compliances_0_and_changes_no_other(seed, sizes, bandwidths):
    source, mapping, transitions = problem(seed, sizes)
    sample, instances = as_sample(transitions, sizes[1]), as_transitions(source)
    paper = equations.sample_compliance(sample, instances, mapping, bandwidths)
    kept = [equations.sample_compliance(sample, instances, mapping, bandwidths, e) for e in (0.0, 0.1, 1.0, 16.0)]
    np.testing.assert_array_equal(kept[0], paper)
    for less, more in pairwise(kept):
        assert ((more == less) | (more == 0.0)).all()
    assert not kept[-1].any(), "15 instances cannot weigh 16"


def test_compliance_of_the_source_with_itself_is_1_where_instances_do_not_overlap():
    """Far enough from each other, each instance is predicted by itself alone."""
    at = np.linspace(0.0, 1.0, 5)[:, None]
    effect = np.array([[0.1], [-0.1], [0.05], [0.0], [-0.2]])
    instances = Transitions(at, np.array([0, 1, 0, 1, 0]), effect, np.arange(5.0), np.zeros(5, dtype=bool))
    bandwidths, mirrored = Bandwidths(0.001, 0.0001, 0.1), instances._replace(state=1.0 - at, effect=-effect)
    identity, swapped = InterTaskMapping([0], [0, 1]), InterTaskMapping([0], [1, 0])
    np.testing.assert_allclose(equations.sample_compliance(instances, instances, identity, bandwidths), 1.0, rtol=1e-12)
    assert equations.sample_compliance(instances, instances, swapped, bandwidths).max() < 1e-3
    mapping = InterTaskMapping([0], [0, 1], [-1])
    np.testing.assert_allclose(equations.sample_compliance(mirrored, instances, mapping, bandwidths), 1.0, rtol=1e-12)


def test_compliance_with_unmapped_variables_depends_on_their_change_and_not_on_their_value():
    source = Transitions(np.array([[0.3]]), np.array([0]), np.array([[0.1]]), np.zeros(1), np.zeros(1, dtype=bool))
    states = np.array([[0.3, 0.0], [0.3, 0.9], [0.3, 0.9], [0.3, 0.9]])
    effects = np.array([[0.1, 0.0], [0.1, 0.0], [0.1, -0.2], [0.1, 0.0]])
    sample = Transitions(states, np.zeros(4, dtype=int), effects, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(4, dtype=bool))
    found = equations.sample_compliance(sample, source, InterTaskMapping([0, None], [0]), Bandwidths(0.02, 0.04, 4.0))
    np.testing.assert_allclose(found, [1.0, 1.0, math.exp(-1.0), math.exp(-0.25)], rtol=1e-12)


def average_distance(distances, weights, mu):
    """Eq. 4 by trying every number of nearest transitions."""
    near = sorted(zip(distances, weights, strict=True))
    h = max((h for h in range(1, len(near) + 1) if sum(w for _, w in near[:h]) < mu - 1e-12), default=1)
    return sum(d for d, _ in near[:h]) / h


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.0, 2.0), min_size=1, max_size=25), st.floats(0.01, 1.0), some_mus)
@example([0.5, 0.5, 0.5], 0.1, 1.0)
def test_average_distance_takes_the_nearest_whose_weights_stay_below_mu(distances, delta, mu):
    distances = np.array(distances)
    [weights] = equations.normalized_weights(distances[None, :], delta)
    found = equations.average_distance(distances, weights, mu)
    assert found == pytest.approx(average_distance(distances, weights, mu), rel=1e-12)
    larger = equations.average_distance(distances, weights, min(1.0, 1.5 * mu))
    assert larger >= found - 1e-12, "a larger fraction reaches at least as far"


def test_average_distance_leaves_out_the_transition_that_crosses_mu_but_never_the_nearest():
    distances, weights = np.array([3.0, 1.0, 2.0, 4.0]), np.array([0.2, 0.4, 0.3, 0.1])
    for mu, expected in ((0.1, 1.0), (0.4, 1.0), (0.5, 1.0), (0.7, 1.0), (0.71, 1.5), (0.9, 1.5), (0.95, 2.0), (1.0, 2.0)):
        assert equations.average_distance(distances, weights, mu) == pytest.approx(expected), mu
    for mu in (0.0, -0.5, 1.01, float("nan")):
        with pytest.raises(ValueError, match="mu must be above 0 and at most 1, got"):
            equations.average_distance(distances, weights, mu)


@settings(max_examples=30, deadline=None)
@given(seeds, sizes, some_bandwidths, st.integers(0, 20), some_mus)
@example(0, (2, 2, 1, 1), Bandwidths(0.1, 0.1, 1.0), 12, 1.0)
def test_relevances_are_those_of_compiled_code(seed, sizes, bandwidths, n_transitions, mu):
    source, mapping, transitions = problem(seed, sizes, n_transitions=n_transitions)
    sample, instances = as_sample(transitions, sizes[1]), as_transitions(source)
    for action in range(sizes[3]):
        compiled, compiled_near = compiled_relevances(sample, source, mapping, action, bandwidths, mu)
        found = equations.source_relevances(instances, mapping, action, sample, bandwidths, mu)
        np.testing.assert_allclose(found, compiled, rtol=1e-7, atol=1e-9)
        found = equations.source_near_relevances(instances, mapping, action, sample, bandwidths)
        np.testing.assert_allclose(found, compiled_near, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("apart", [0.02, 0.1, 0.3, 1.0, 10.0])
def test_far_away_a_contradicted_instance_is_never_before_one_that_is_nearly_borne_out(apart):
    """By Eq. 7 it is, from some distance on: the case for another relevance."""
    of_far = 5.0 * math.exp(-(apart**2) / 0.01)
    near, _, far = equations.near_relevances(np.array([0.9, 0.2, 0.1]), np.array([5.0, 5.0, of_far]))
    assert near > far
    assert (equations.relevance(0.9, 0.02) > equations.relevance(0.1, apart)) == (apart < 0.15)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 8))
def test_near_relevance_lies_between_an_instances_own_compliance_and_the_mean(seed, m):
    rng = np.random.default_rng(seed)
    complied, evidence = rng.random(m), rng.exponential(size=m) * (rng.random(m) < 0.7)
    found = equations.near_relevances(complied, evidence)
    mean = np.average(complied, weights=evidence) if evidence.any() else 1.0
    own = np.where(evidence > 0.0, complied, mean)
    assert (np.minimum(own, mean) - 1e-12 <= found).all() and (found <= np.maximum(own, mean) + 1e-12).all()
    np.testing.assert_allclose(found[evidence == 0.0], mean)
    np.testing.assert_allclose(equations.near_relevances(complied, evidence + 1e9), complied, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 3), some_bandwidths, some_mus)
def test_relevance_is_compliance_with_the_roles_of_source_and_target_exchanged(seed, d, bandwidths, mu):
    """lambda_{T,sigma_j} is the compliance of a sample that is instance j alone, with the target as its source."""
    source, _, transitions = problem(seed, (d, d, 1, 1))
    instances, sample, identity = as_transitions(source), as_sample(transitions, d), InterTaskMapping(range(d), [0])
    found = equations.source_relevances(instances, identity, 0, sample, bandwidths, mu)
    with_target = equations.sample_compliance(instances, sample, identity, bandwidths)
    for j, rho in enumerate(found):
        distances = np.linalg.norm(sample.state - instances.state[j], axis=1)
        [weights] = equations.normalized_weights(distances[None, :], bandwidths.start)
        expected = math.exp(-(((with_target[j] - 1.0) / average_distance(distances, weights, mu)) ** 2))
        assert rho == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_relevance_is_1_for_perfect_compliance_and_for_instances_without_evidence():
    instances = Transitions(np.array([[0.2], [0.9]]), np.zeros(2, int), np.full((2, 1), 0.1), -np.ones(2), np.zeros(2, bool))
    identity, bandwidths = InterTaskMapping([0], [0]), Bandwidths(1e-4, 0.01, 1.0)
    assert equations.source_relevances(instances, identity, 0, instances, bandwidths, 0.5).tolist() == [1.0, 1.0]
    nothing = instances.with_action(1)
    assert equations.source_relevances(instances, identity, 0, nothing, bandwidths, 0.5).tolist() == [1.0, 1.0]
    differs = instances._replace(state=np.array([[0.2], [0.21]]), effect=np.array([[0.5], [0.5]]))
    contradicted, far = equations.source_relevances(instances, identity, 0, differs, bandwidths, 0.5)
    assert contradicted < 1e-6
    assert far == 1.0
    # Also where rounding makes the compliance of an instance that every transition repeats a little less than 1.
    repeated = Transitions(*(np.repeat(column[:1], 7, axis=0) for column in instances))
    assert equations.source_relevances(instances, identity, 0, repeated, Bandwidths(0.3, 0.1, 0.7), 0.5)[0] == 1.0


@pytest.mark.parametrize(
    ("with_target", "distance", "expected"),
    [
        (1.0, 0.0, 1.0),
        (1.0, 0.3, 1.0),
        (0.5, 0.0, 0.0),
        (0.5, 1e-300, 0.0),
        (0.0, 1.0, math.exp(-1)),
        (0.8, 0.1, math.exp(-4)),
    ],
)
def test_relevance_of_eq_7(with_target, distance, expected):
    assert equations.relevance(with_target, distance) == pytest.approx(expected, rel=1e-12)
