"""Compliance and relevance against loops written from the paper's equations, and in cases with a known answer."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, choices_of, show
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.candidates import Candidates, stacked_instances, stacked_table
from sb3_combrel.transfer.equations import Bandwidths
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths, start_bandwidths
from sb3_combrel.transfer.instances.compliance import (
    ComplianceScratch,
    compliance_table,
    task_compliance,
    transition_compliance,
)
from sb3_combrel.transfer.instances.relevance import relevance

seeds = st.integers(0, 2**32 - 1)
sizes = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
some_bandwidths = st.builds(Bandwidths, start=st.floats(0.003, 0.5), outcome=st.floats(0.002, 0.5), reward=st.floats(0.1, 5.0))


def tables_of(transitions, sources, sets, bandwidths):
    """The package's compliances of all transitions, shape (n_transitions, n_state_mappings, n_source_actions)."""
    instances, table = stacked_instances(sources), stacked_table(sets)
    tables = np.full((len(transitions), len(table.variable), len(instances.size)), np.nan)
    compliance_table(
        np.array([t.state for t in transitions]),
        np.array([t.next_state - t.state for t in transitions]),
        np.array([t.reward for t in transitions]),
        instances,
        table,
        bandwidths,
        ComplianceScratch.for_mappings(table, instances, bandwidths.start),
        tables,
    )
    return tables


@settings(max_examples=60, deadline=None)
@given(seeds, sizes, some_bandwidths, st.integers(1, 40), st.sampled_from([0.2, 1.0]))
def test_every_mapping_has_the_compliance_of_the_equations(seed, sizes, bandwidths, n_instances, spread):
    n_source, n_target, n_source_actions, n_target_actions = sizes
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, n_instances, n_source, n_source_actions, spread)
    mappings = [naive.random_mapping(rng, *sizes) for _ in range(6)]
    transitions = [naive.random_transition(rng, n_target, n_target_actions, spread) for _ in range(3)]
    tables = tables_of(transitions, [source], [MappingSet.from_list(mappings)], bandwidths)
    listed = MappingSet.from_list(mappings)
    for transition, table in zip(transitions, tables, strict=True):
        for mapping in mappings:
            [row] = [
                r
                for r in range(listed.n_state_mappings)
                if np.array_equal(listed.state_mappings[r], mapping.state_index)
                and np.array_equal(listed.state_signs[r], mapping.state_sign)
            ]
            expected = naive.compliance(transition, source, mapping, bandwidths)
            assert table[row, mapping.action[transition.action]] == pytest.approx(expected, rel=1e-9, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(seeds, some_bandwidths)
def test_a_whole_mappings_compliance_is_the_mean_of_its_transitions(seed, bandwidths):
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 60, 2, 2)
    mappings = MappingSet.injective(2, 3, 2, 3, signs=True)
    transitions = [naive.random_transition(rng, 3, 3) for _ in range(4)]
    actions = np.array([t.action for t in transitions])
    tables = tables_of(transitions, [source], [mappings], bandwidths)
    for number in rng.choice(len(mappings), 5):
        mapping = mappings[int(number)]
        state_index = int(number) // mappings.n_action_mappings
        expected = naive.whole_compliance(transitions, source, mapping, bandwidths)
        whole = task_compliance(tables, actions, state_index, np.array(mapping.action))
        assert whole == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_sources_side_by_side_have_the_compliance_that_each_has_alone():
    rng = np.random.default_rng(0)
    sources = [naive.random_source(rng, 50, 1, 2), naive.random_source(rng, 80, 3, 4)]
    sets = [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources]
    transitions = [naive.random_transition(rng, 3, 2) for _ in range(10)]
    bandwidths = Bandwidths(0.1, 0.05, 1.0)
    together = tables_of(transitions, sources, sets, bandwidths)
    rows = np.cumsum([0] + [s.n_state_mappings for s in sets])
    actions = np.cumsum([0] + [s.n_actions for s in sources])
    for k, (source, mappings) in enumerate(zip(sources, sets, strict=True)):
        alone = tables_of(transitions, [source], [mappings], bandwidths)
        assert (alone > 0.0).any()
        np.testing.assert_allclose(
            together[:, rows[k] : rows[k + 1], actions[k] : actions[k + 1]], alone, rtol=1e-12, atol=1e-15
        )


def line(states, effects, rewards=None, actions=None):
    """Source instances of a task with the variables of ``states``, in the unit box."""
    states, effects = np.array(states, dtype=float), np.array(effects, dtype=float)
    n, d = states.shape
    return SourceInstances(
        states,
        np.zeros(n, dtype=int) if actions is None else np.array(actions),
        -np.ones(n) if rewards is None else np.array(rewards, dtype=float),
        states + effects,
        np.zeros(n, dtype=bool),
        np.zeros(d),
        np.ones(d),
        1 if actions is None else max(actions) + 1,
    )


def compliance_of(state, effect, source, mapping, bandwidths, reward=-1.0):
    transition = naive.Transition(np.array(state), 0, reward, np.array(state) + np.array(effect))
    tables = tables_of([transition], [source], [MappingSet.from_list([mapping])], Bandwidths(*bandwidths))
    return tables[0, 0, mapping.action[0]]


def test_the_same_transition_is_perfectly_compliant():
    source = line([[0.3]], [[0.1]])
    assert compliance_of([0.3], [0.1], source, InterTaskMapping([0], [0]), (0.02, 0.01, 1.0)) == 1.0
    mirrored = InterTaskMapping([0], [0], [-1])
    assert compliance_of([0.7], [-0.1], source, mirrored, (0.02, 0.01, 1.0)) == pytest.approx(1.0, abs=1e-12)
    assert compliance_of([0.7], [0.1], source, mirrored, (0.02, 0.01, 1.0)) < 0.1


def test_an_unmapped_variable_may_be_anywhere_but_must_not_move():
    source, mapping = line([[0.3]], [[0.1]]), InterTaskMapping([0, None], [0])
    for y in (0.0, 0.5, 1.0):
        assert compliance_of([0.3, y], [0.1, 0.0], source, mapping, (0.02, 0.01, 1.0)) == 1.0
        moved = compliance_of([0.3, y], [0.1, 0.1], source, mapping, (0.02, 0.01, 1.0))
        assert moved == pytest.approx(np.exp(-1.0), rel=1e-9)


def test_other_rewards_make_less_compliant():
    source, mapping = line([[0.3]], [[0.1]], rewards=[2.0]), InterTaskMapping([0], [0])
    by_reward = [compliance_of([0.3], [0.1], source, mapping, (0.02, 0.01, 4.0), reward=r) for r in (2.0, 3.0, 4.0, -8.0)]
    np.testing.assert_allclose(by_reward, np.exp([0.0, -0.25, -1.0, -25.0]), rtol=1e-9)


def test_far_instances_are_no_evidence_however_well_they_fit():
    """Normalized weights alone would make the only instance, wherever it is, as good as one right here."""
    mapping, bandwidths = InterTaskMapping([0], [0]), (0.01, 0.01, 1.0)
    by_distance = [compliance_of([0.1], [0.1], line([[0.1 + d]], [[0.1]]), mapping, bandwidths) for d in (0.14, 0.16, 0.8)]
    assert by_distance[0] == pytest.approx(1.0)
    assert by_distance[1:] == [0.0, 0.0]
    assert compliance_of([0.1], [0.1], line([[0.26]] * 2, [[0.1]] * 2), mapping, bandwidths) == pytest.approx(1.0)


def test_an_action_without_instances_is_no_evidence():
    source = line([[0.3], [0.4]], [[0.1], [0.1]], actions=[0, 2])
    tables = tables_of(
        [naive.Transition(np.array([0.35]), 0, -1.0, np.array([0.45]))],
        [source],
        [MappingSet.injective(1, 1, 3, 1)],
        Bandwidths(0.02, 0.01, 1.0),
    )
    np.testing.assert_allclose(tables[0, 0], [1.0, 0.0, 1.0])


def test_one_transition_and_many_go_through_the_same_equations():
    rng = np.random.default_rng(3)
    source, mappings = naive.random_source(rng, 40), MappingSet.all(2, 3, 3, 2)
    transitions = [naive.random_transition(rng, 3, 2) for _ in range(5)]
    bandwidths = Bandwidths(0.1, 0.1, 1.0)
    tables = tables_of(transitions, [source], [mappings], bandwidths)
    table = stacked_table([mappings])
    scratch = ComplianceScratch.for_mappings(table, stacked_instances([source]), bandwidths.start)
    for i in reversed(range(5)):
        t, one = transitions[i], np.full(tables[0].shape, np.nan)
        effect = t.next_state - t.state
        transition_compliance(t.state, effect, t.reward, stacked_instances([source]), table, bandwidths, scratch, one)
        np.testing.assert_array_equal(one, tables[i])


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 80), st.integers(1, 3))
def test_default_bandwidths_are_what_they_are_said_to_be(seed, n, n_actions):
    source = naive.random_source(np.random.default_rng(seed), n, 2, n_actions)
    units = (source.states - source.low) / (source.high - source.low)
    effects = (source.next_states - source.states) / (source.high - source.low)
    to_the_20th = []
    for a in range(n_actions):
        of_action = units[source.actions == a]
        for state in of_action:
            apart = sorted(naive.distance(state, other) for other in of_action)
            if len(apart) > 1:
                to_the_20th.append(apart[min(20, len(apart) - 1)])
    found = default_bandwidths(stacked_instances([source]))
    if to_the_20th:
        assert found.start == pytest.approx(np.median(to_the_20th) ** 2, rel=1e-9)
    assert found.outcome == pytest.approx((effects**2).sum(axis=1).mean(), rel=1e-9)
    if source.rewards.var() > 0:
        assert found.reward == pytest.approx(source.rewards.var(), rel=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        line([[0.5]], [[0.0]]),
        line([[0.5]] * 30, [[0.0]] * 30),
        line([[0.1], [0.9]], [[0.0], [0.0]], actions=[0, 2]),
        line([[0.1], [0.9], [0.2]], [[1e-12], [0.0], [1e-12]], rewards=[-1e9, 1e9, 0.0]),
    ],
    ids=["one", "all alike", "one an action", "extremes"],
)
def test_default_bandwidths_are_usable_whatever_the_source(source):
    bandwidths = default_bandwidths(stacked_instances([source]))
    assert all(np.isfinite(b) and b > 0.0 for b in bandwidths)
    transition = naive.Transition(source.states[0], 0, float(source.rewards[0]), source.next_states[0])
    [[table]] = tables_of([transition], [source], [MappingSet.from_list([InterTaskMapping([0], [0])])], bandwidths)
    assert 0.0 < table[0] <= 1.0


def relevances(source, source_action, mapping, action, transitions, bandwidths, mu):
    """The package's relevances of all instances of one source action."""
    instances = stacked_instances([source])
    of_action = [t for t in transitions if t.action == action]
    values = np.full(int(instances.size.max()), np.nan)
    d = len(mapping.state)
    states = np.array([t.state for t in of_action]).reshape(-1, d)
    effects = np.array([t.next_state - t.state for t in of_action]).reshape(-1, d)
    target = states, effects, np.array([t.reward for t in of_action])
    of_mapping = mapping.state_index, mapping.state_sign, np.zeros(len(mapping.state_index), dtype=bool)
    relevance(target, instances, source_action, of_mapping, bandwidths, mu, np.empty(len(of_action)), values)
    return values[: instances.size[source_action]]


@settings(max_examples=60, deadline=None)
@given(seeds, sizes, some_bandwidths, st.integers(0, 30), st.floats(0.05, 1.0))
def test_relevance_is_that_of_the_equations(seed, sizes, bandwidths, n_transitions, mu):
    _, n_target, _, n_target_actions = sizes
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 15, sizes[0], sizes[2], 0.4)
    mapping = naive.random_mapping(rng, *sizes)
    transitions = [naive.random_transition(rng, n_target, n_target_actions, 0.4) for _ in range(n_transitions)]
    places = naive.places_of(source, stacked_instances([source]))
    for action in range(n_target_actions):
        numbers = np.flatnonzero(source.actions == mapping.action[action])
        found = relevances(source, mapping.action[action], mapping, action, transitions, bandwidths, mu)[places[numbers]]
        expected = [naive.relevance(source, j, mapping, action, transitions, bandwidths, mu) for j in numbers]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


def test_relevance_is_full_without_evidence_or_with_nothing_but_good_and_low_where_predictions_fail():
    source = line([[0.2], [0.8]], [[0.1], [0.1]])
    mapping, bandwidths = InterTaskMapping([0], [0]), Bandwidths(0.02, 0.01, 1.0)
    assert relevances(source, 0, mapping, 0, [], bandwidths, 0.5).tolist() == [1.0, 1.0]
    agrees = naive.Transition(np.array([0.2]), 0, -1.0, np.array([0.3]))
    differs = naive.Transition(np.array([0.21]), 0, -1.0, np.array([0.01]))
    assert relevances(source, 0, mapping, 0, [agrees], bandwidths, 0.5) == pytest.approx([1.0, 1.0])
    contradicted, far = relevances(source, 0, mapping, 0, [differs], bandwidths, 0.5)
    assert contradicted < 1e-6
    assert contradicted < far < 1.0


@pytest.mark.parametrize(("mu", "n_counted"), [(0.05, 1), (0.55, 1), (0.75, 1), (0.85, 2), (0.97, 3), (1.0, 3)])
def test_distances_are_averaged_while_the_weights_stay_below_mu_of_their_sum(mu, n_counted):
    """The transition with which the sum would reach mu is not counted (Eq. 4); the nearest always is."""
    fractions, bandwidth = np.array([0.5, 0.3, 0.15, 0.05]), 0.02
    apart = np.sqrt(-bandwidth * np.log(fractions))
    transitions = [naive.Transition(np.array([0.2 + x]), 0, -1.0, np.array([0.2 + x])) for x in apart]
    [found] = relevances(
        line([[0.2]], [[0.1]]), 0, InterTaskMapping([0], [0]), 0, transitions, Bandwidths(bandwidth, 0.01, 1.0), mu
    )
    expected = np.exp(-(((np.exp(-1.0) - 1.0) / apart[:n_counted].mean()) ** 2))
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("state", [(0, 0, None), (0, 1, 0), (0, 0, 1), (1, None, None), (0, 1, None)], ids=str)
@pytest.mark.parametrize("given", [0.02, None])
def test_an_instance_as_far_along_each_variable_weighs_the_same_whatever_their_number(state, given):
    rng = np.random.default_rng(0)
    source, n_mapped = naive.random_source(rng, 100, 2, 2), len(state) - state.count(None)
    candidates = Candidates(source, [InterTaskMapping(state, [0])], naive.target_task(np.zeros((1, 3)), 1))
    usual = default_bandwidths(candidates.instances).start if given is None else given
    [found] = start_bandwidths(candidates, usual)
    for along in (0.01, 0.1):
        two, all_mapped = (naive.distance([along] * n, [0.0] * n) for n in (2, n_mapped))
        assert naive.phi(all_mapped, found) == pytest.approx(naive.phi(two, usual), rel=1e-12)
    assert n_mapped != 2 or found == usual, "to the last bit"


def test_start_bandwidths_are_those_of_each_source():
    rng = np.random.default_rng(1)
    sources, task = [naive.random_source(rng, 30, n, 2) for n in (1, 3)], naive.target_task(np.zeros((1, 3)), 1)
    candidates = Candidates(sources, "all", task)
    n_mapped, [first, second] = (candidates.table.variable >= 0).sum(axis=1), candidates.sets
    expected = 0.3 * n_mapped / np.repeat([1.0, 3.0], [first.n_state_mappings, second.n_state_mappings])
    np.testing.assert_allclose(start_bandwidths(candidates, 0.3), expected, rtol=1e-12)


def test_min_evidence_is_the_sum_of_kernels_below_which_nothing_counts():
    source, transition = line([[0.3], [0.3]], [[0.1], [0.1]]), naive.Transition(np.array([0.4]), 0, -1.0, np.array([0.5]))
    evidence = 2 * np.exp(-0.01 / 0.005)
    task = naive.target_task(np.array([[0.4]]), 1)
    for least, expected in ((0.0, 1.0), (0.99 * evidence, 1.0), (1.01 * evidence, np.nan)):
        arguments = dict(bandwidths=(0.005, 0.01, 1.0), min_evidence=least, min_compliance=0.0)
        method = bound(COMBREL(source, InterTaskMapping([0], [0]), **arguments), task)
        show(method, transition)
        choices_of(method)
        np.testing.assert_allclose(method.chosen_compliance(np.zeros(1, dtype=int)), [expected], rtol=1e-9)
