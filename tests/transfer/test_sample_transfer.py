"""Transfer of samples: compliance of every virtual source task, what is drawn, and what is transferred, by plain loops."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, pairs_of, show, transferred_to_all, transferred_to_pairs
from helpers.naive_transfer import source_of, transitions_of
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import InterTaskMapping, MappingSet, SampleTransfer
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.candidates import Candidates, stacked_instances
from sb3_combrel.transfer.equations import Bandwidths
from sb3_combrel.transfer.instances.compliance import DEFAULT_MIN_EVIDENCE
from sb3_combrel.transfer.methods.sample_transfer import candidate_compliances, draw_instances

POINTS = np.random.default_rng(5).random((12, 3))
BANDWIDTHS = (0.05, 0.02, 1.0)
LISTED = [
    InterTaskMapping([0, None, 1], [1, 0]),
    InterTaskMapping([1, 0, None], [0, 0], [1, -1, 1]),
    InterTaskMapping([0, None, 1], [1, 1]),
]
SETS = {
    "injective": MappingSet.injective(2, 3, 2, 2),
    "signed_surjective": MappingSet.surjective(2, 3, 2, 2, signs=True),
    "balanced": MappingSet.balanced(2, 3, 2, 2),
    "listed": LISTED,
    "repeated": MappingSet([[0, 1, -1], [1, -1, 0], [0, 1, -1]], MappingSet.injective(2, 3, 2, 2).actions),
}


def observed(method, transitions, task):
    bound(method, task)
    for transition in transitions:
        show(method, transition)
    return method


def eq_6(transitions, source, mapping):
    """The compliance of one virtual source task by the equations."""
    given = naive.as_sample(transitions, 3), naive.as_transitions(source), mapping, Bandwidths(*BANDWIDTHS)
    return equations.task_compliance(equations.sample_compliance(*given, DEFAULT_MIN_EVIDENCE))


def naive_candidate_compliances(sources, sets, transitions):
    """Of each (source, target action, state mapping, signs, source action) by going through all tasks."""
    found = Counter()
    for number, (source, mappings) in enumerate(zip(sources, sets, strict=True)):
        for mapping in mappings:
            own = eq_6(transitions, source, mapping) / len(mappings) / len(sources)
            for action, source_action in enumerate(mapping.action):
                found[number, action, mapping.state, mapping.sign, source_action] += own
    return found


def key_of(method, candidate):
    number, action, state_index, source_action = method.candidates.origins[candidate]
    of = method.candidates.sets[number]
    signs = tuple(int(s) for s in of.state_signs[state_index])
    return number, action, tuple(None if k < 0 else int(k) for k in of.state_mappings[state_index]), signs, source_action


@pytest.mark.parametrize("name", SETS)
def test_compliances_are_those_of_all_tasks_that_have_a_candidate_added_up(name):
    source, transitions = source_of(), transitions_of(15, seed=10)
    method = observed(SampleTransfer(source, SETS[name], bandwidths=BANDWIDTHS), transitions, naive.target_task(POINTS, 2))
    found = candidate_compliances(method.candidates, method._tasks.sums, 15)
    expected = naive_candidate_compliances([source], [list(SETS[name])], transitions)
    assert len(found) == len(expected) and max(found) > 0.0
    for candidate, value in enumerate(found):
        assert value == pytest.approx(expected[key_of(method, candidate)], rel=1e-9, abs=1e-15)


def test_every_mapping_to_every_source_is_a_task():
    sources, transitions = [source_of(3), source_of(4, 1, 3)], transitions_of(20)
    method = SampleTransfer(sources, "surjective", bandwidths=BANDWIDTHS)
    observed(method, transitions, naive.target_task(POINTS, 2))
    sets = [MappingSet.surjective(each.n_variables, 3, each.n_actions, 2) for each in sources]
    expected = naive_candidate_compliances(sources, sets, transitions)
    found = candidate_compliances(method.candidates, method._tasks.sums, 20)
    assert {key_of(method, candidate): pytest.approx(each, rel=1e-9) for candidate, each in enumerate(found)} == expected
    # What all candidates of an action have together is the mean compliance of all tasks.
    first = method.candidates.arrays.first
    totals = [found[begin:end].sum() for begin, end in itertools.pairwise(first)]
    assert totals == pytest.approx([totals[0]] * 2)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_drawn_are_as_many_of_each_action_as_can_be_and_none_twice_nor_of_those_that_cannot(seed):
    rng = np.random.default_rng(seed)
    candidates = Candidates(source_of(seed, n=20), SETS["injective"], naive.target_task(POINTS, 2))
    size = candidates.instances.size[candidates.arrays.action]
    compliances = rng.random(len(candidates)) * (rng.random(len(candidates)) < 0.5)
    relevances = rng.random((len(candidates), size.max())) * (rng.random((len(candidates), size.max())) < 0.7)
    drawn = draw_instances(candidates, compliances, relevances, 30, rng)
    assert len({tuple(row) for row in drawn.tolist()}) == len(drawn)
    possible = (np.arange(size.max()) < size[:, None]) & (compliances[:, None] * relevances > 0.0)
    assert possible[drawn[:, 0], drawn[:, 1]].all()
    for begin, end in itertools.pairwise(candidates.arrays.first):
        assert int(((begin <= drawn[:, 0]) & (drawn[:, 0] < end)).sum()) == min(30, int(possible[begin:end].sum()))


def test_one_is_drawn_in_proportion_to_compliance_and_of_a_candidate_to_relevance():
    rng = np.random.default_rng(0)
    candidates = Candidates(source_of(n=8), LISTED, naive.target_task(POINTS, 2))
    size = candidates.instances.size[candidates.arrays.action]
    compliances, relevances = rng.random(len(candidates)), rng.random((len(candidates), size.max()))
    n, counts = 4000, Counter()
    for seed in range(n):
        drawn = draw_instances(candidates, compliances, relevances, 1, np.random.default_rng(seed))
        counts.update(map(tuple, drawn.tolist()))
    for begin, end in itertools.pairwise(candidates.arrays.first):
        for candidate in range(begin, end):
            of_candidate = compliances[candidate] / compliances[begin:end].sum()
            for j in range(size[candidate]):
                expected = of_candidate * relevances[candidate, j] / relevances[candidate, : size[candidate]].sum()
                # Five standard deviations.
                assert abs(counts[candidate, j] / n - expected) < 5.0 * np.sqrt(expected * (1.0 - expected) / n)


def rows_of(source, rows):
    names = ("states", "actions", "rewards", "next_states", "terminated")
    return replace(source, **{name: getattr(source, name)[rows] for name in names})


@pytest.mark.parametrize("relevance", [True, False, "near"])
def test_the_nearest_of_those_drawn_are_transferred(relevance):
    sources, task = [source_of(0), source_of(1, 1, 3)], naive.target_task(POINTS, 2)
    method = SampleTransfer(
        sources, "injective", n_instances=80, min_transitions=30, breadth=0.3, relevance=relevance, bandwidths=BANDWIDTHS
    )
    observed(method, transitions_of(30), task)
    assert Counter(method.candidates.origins[c].target_action for c in method.drawn[:, 0]) == {0: 40, 1: 40}
    drawn_from, expected = ([], []), []
    for candidate in np.unique(method.drawn[:, 0]).tolist():
        number, action, state, signs, source_action = key_of(method, candidate)
        # Instances are held by source action in an order of their own.
        source = sources[number]
        places = naive.places_of(source, stacked_instances([source]))
        rows = (source.actions == source_action) & np.isin(places, method.drawn[method.drawn[:, 0] == candidate, 1])
        drawn_from[action].append((rows_of(source, rows), InterTaskMapping(state, [source_action] * 2, signs), action))
    for action in range(2):
        expected += [naive.transferred(point, 0.0, drawn_from[action], task, 0.3) for point in POINTS]
    found = transferred_to_all(method, task)
    assert any(weights for weights, *_ in found)
    for (weights, effects, rewards), naively in zip(found, expected, strict=True):
        assert weights == pytest.approx([each[0] for each in naively])
        np.testing.assert_allclose(effects, np.reshape([each[1] for each in naively], np.shape(effects)), atol=1e-12)
        assert rewards == [each[2] for each in naively]


def test_nothing_is_transferred_before_the_first_draw_and_draws_follow_growth():
    task = naive.target_task(POINTS, 2)
    method = bound(SampleTransfer(source_of(), min_transitions=20, max_transitions=30), task)
    pairs, drawn_at = pairs_of(task), []
    for i, transition in enumerate(transitions_of(60), start=1):
        show(method, transition)
        if i < 20:
            assert not transferred_to_pairs(method, pairs, np.zeros(len(pairs))).length[: len(pairs)].any()
        if len(changed_pairs(method)):
            drawn_at.append(i)
    assert drawn_at == [20, 24, 29] and method.mapping_steps() == 20
    figures = method.statistics()
    assert figures["transfer/draws"] == 3 and figures["transfer/instances_drawn"] == len(method.drawn) > 0
    assert len(np.unique(method.drawn[:, 0])) == figures["transfer/candidates_drawn"]


def test_most_of_what_is_drawn_by_compliance_alone_stays_when_there_are_a_few_more_transitions():
    method = SampleTransfer(source_of(n=200), n_instances=100, min_transitions=100, relevance=False)
    observed(method, transitions_of(100), naive.target_task(POINTS, 2))
    before = {tuple(row) for row in method.drawn.tolist()}
    for transition in transitions_of(20, seed=9):
        show(method, transition)
    after = {tuple(row) for row in method.drawn.tolist()}
    assert method.statistics()["transfer/draws"] == 2 and len(before & after) > 0.8 * len(after)


# The sums by which copies are judged, and the division that is chosen by them, against the equations and a full search.
