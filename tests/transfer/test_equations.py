"""Eqs. 1-7 in NumPy: properties, known answers, the compiled code against them; their bandwidths and evidence."""

import math
from itertools import pairwise

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.naive_transfer import as_sample, as_transitions, problem
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.candidates import Candidates, stacked_instances, stacked_table
from sb3_combrel.transfer.equations import Bandwidths, Transitions
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths, start_bandwidths
from sb3_combrel.transfer.instances.compliance import ComplianceScratch, transition_compliance
from sb3_combrel.transfer.instances.relevance import near_relevance, relevance

GUARD = naive.LEAST_EVIDENCE
seeds = st.integers(0, 2**32 - 1)
sizes = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
some_bandwidths = st.builds(Bandwidths, start=st.floats(0.003, 0.5), outcome=st.floats(0.002, 0.5), reward=st.floats(0.1, 5.0))
some_mus = st.floats(0.02, 1.0)


def compiled_tables(sample, sources, sets, bandwidths, min_evidence=GUARD, starts=None):
    """Compiled compliance, shape (n_transitions, n_state_mappings, n_source_actions).

    :param starts: start bandwidth of each state mapping, or None for that of ``bandwidths``
    """
    instances, table = stacked_instances(sources), stacked_table(sets)
    tables = np.full((len(sample.reward), len(table.variable), len(instances.size)), np.nan)
    scratch = ComplianceScratch.for_mappings(table, instances, bandwidths.start if starts is None else starts, min_evidence)
    given = tuple(instances), tuple(table), tuple(bandwidths), tuple(scratch)
    for state, effect, reward, found in zip(sample.state, sample.effect, sample.reward.tolist(), tables, strict=True):
        transition_compliance.call(state, effect, reward, *given, found)
    return tables


def compiled_relevances(sample, source, mapping, action, bandwidths, mu):
    """Compiled relevance, and the one that does not favour distant instances, of the instances for ``action``, in order."""
    instances, source_action, of_action = stacked_instances([source]), mapping.action[action], sample.with_action(action)
    found, near, evidence = np.full((3, int(instances.size.max())), np.nan)
    target, scratch = (of_action.state, of_action.effect, of_action.reward), np.empty(len(of_action.reward))
    given = instances, source_action, (mapping.state_index, mapping.state_sign, np.zeros(len(mapping.state), bool)), bandwidths
    relevance.call(target, *given, mu, scratch, found)
    near_relevance.call(target, *given, scratch, evidence, near)
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
        expected = equations.sample_compliance(sample, instances, mapping, bandwidths._replace(start=starts[row]), GUARD)
        found = tables[np.arange(len(transitions)), row, np.array(mapping.action)[sample.action]]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        assert equations.task_compliance(expected, prior=0.25) == pytest.approx(expected.mean() / 4)


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
    at, effect = np.linspace(0.0, 1.0, 5)[:, None], np.array([[0.1], [-0.1], [0.05], [0.0], [-0.2]])
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
@example([3.0, 1.0, 2.0, 4.0], 1.0, 0.02)
def test_average_distance_takes_the_nearest_whose_weights_stay_below_mu(distances, delta, mu):
    distances = np.array(distances)
    [weights] = equations.normalized_weights(distances[None, :], delta)
    found = equations.average_distance(distances, weights, mu)
    assert found == pytest.approx(average_distance(distances, weights, mu), rel=1e-12)
    larger = equations.average_distance(distances, weights, min(1.0, 1.5 * mu))
    assert larger >= found - 1e-12, "a larger fraction reaches at least as far"
    for wrong in (0.0, 1.01, float("nan")):
        with pytest.raises(ValueError, match="mu must be above 0 and at most 1, got"):
            equations.average_distance(distances, weights, wrong)


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
    assert contradicted < 1e-6 and far == 1.0
    # Also where rounding makes the compliance of an instance that every transition repeats a little less than 1.
    repeated = Transitions(*(np.repeat(column[:1], 7, axis=0) for column in instances))
    assert equations.source_relevances(instances, identity, 0, repeated, Bandwidths(0.3, 0.1, 0.7), 0.5)[0] == 1.0


def test_relevance_of_eq_7():
    given = [(1.0, 0.0), (1.0, 0.3), (0.5, 0.0), (0.5, 1e-300), (0.0, 1.0), (0.8, 0.1)]
    expected = [1.0, 1.0, 0.0, 0.0, math.exp(-1), math.exp(-4)]
    assert [equations.relevance(*each) for each in given] == pytest.approx(expected, rel=1e-12)


def line(states, effects, rewards=None, actions=None):
    """Source instances of a task with the variables of ``states``, in the unit box."""
    states, effects = np.array(states, dtype=float), np.array(effects, dtype=float)
    n, d = states.shape
    actions = np.zeros(n, dtype=int) if actions is None else np.array(actions)
    rewards = -np.ones(n) if rewards is None else np.array(rewards, dtype=float)
    ends, n_actions = np.zeros(n, dtype=bool), int(actions.max()) + 1
    return SourceInstances(states, actions, rewards, states + effects, ends, np.zeros(d), np.ones(d), n_actions)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.integers(1, 3))
def test_default_bandwidths_are_what_they_are_said_to_be(seed, n, n_actions):
    source = naive.random_source(np.random.default_rng(seed), n, 2, n_actions)
    units, _, effects, rewards, _ = naive.as_transitions(source)
    to_the_20th = []
    for a in range(n_actions):
        of_action = units[source.actions == a]
        for state in of_action:
            apart = sorted(np.linalg.norm(of_action - state, axis=1))
            if len(apart) > 1:
                to_the_20th.append(apart[min(20, len(apart) - 1)])
    found = default_bandwidths(stacked_instances([source]))
    if to_the_20th:
        assert found.start == pytest.approx(np.median(to_the_20th) ** 2, rel=1e-9)
    assert found.outcome == pytest.approx((effects**2).sum(axis=1).mean(), rel=1e-9)
    if rewards.var() > 0:
        assert found.reward == pytest.approx(rewards.var(), rel=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        *[line([[0.5]], [[0.0]]), line([[0.5]] * 30, [[0.0]] * 30), line([[0.1], [0.9]], [[0.0], [0.0]], actions=[0, 2])],
        line([[0.1], [0.9], [0.2]], [[1e-12], [0.0], [1e-12]], rewards=[-1e9, 1e9, 0.0]),
    ],
    ids=["one", "all alike", "one an action", "extremes"],
)
def test_default_bandwidths_are_usable_whatever_the_source(source):
    bandwidths = default_bandwidths(stacked_instances([source]))
    assert all(np.isfinite(b) and b > 0.0 for b in bandwidths)
    transition = naive.Transition(source.states[0], 0, float(source.rewards[0]), source.next_states[0])
    assert 0.0 < naive.compliance(transition, source, InterTaskMapping([0], [0]), bandwidths) <= 1.0


@pytest.mark.parametrize("state", [(0, 0, None), (0, 1, 0), (0, 0, 1), (1, None, None), (0, 1, None)], ids=str)
@pytest.mark.parametrize("given", [0.02, None])
def test_an_instance_as_far_along_each_variable_weighs_the_same_whatever_their_number(state, given):
    source, n_mapped = naive.random_source(np.random.default_rng(0), 100, 2, 2), len(state) - state.count(None)
    candidates = Candidates(source, [InterTaskMapping(state, [0])], naive.target_task(np.zeros((1, 3)), 1))
    usual = default_bandwidths(candidates.instances).start if given is None else given
    [found] = start_bandwidths(candidates, usual)
    for along in (0.01, 0.1):
        two, all_mapped = (along * np.sqrt(n) for n in (2, n_mapped))
        assert equations.phi(all_mapped, found) == pytest.approx(equations.phi(two, usual), rel=1e-12)
    assert n_mapped != 2 or found == usual, "to the last bit"
