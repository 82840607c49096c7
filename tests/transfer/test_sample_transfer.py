"""Transfer of samples: compliance of every virtual source task, what is drawn, and what is transferred, by plain loops."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, pairs_of, show, transferred_to_all, transferred_to_pairs
from helpers.walk import Walk, same_parameters, small, walk_source
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env

import sb3_combrel
from sb3_combrel import FactoredMapping, FittedRMax, InterTaskMapping, MappingSet, SampleTransfer
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.equations import Bandwidths, Transitions
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
IDENTITY = InterTaskMapping([0, 1], [0, 1])


def source_of(seed=0, n_variables=2, n_actions=2, n=60):
    return naive.random_source(np.random.default_rng(seed), n, n_variables, n_actions)


def transitions_of(n, n_variables=3, n_actions=2, seed=1):
    rng = np.random.default_rng(seed)
    return [naive.random_transition(rng, n_variables, n_actions) for _ in range(n)]


def observed(method, transitions, task):
    bound(method, task)
    for transition in transitions:
        show(method, transition)
    return method


def as_transitions(source):
    states = source.scaling.to_unit(source.states)
    effects = source.scaling.to_unit(source.next_states) - states
    return Transitions(states, source.actions, effects, source.rewards, source.terminated)


def as_sample(transitions):
    states, actions, rewards, after = map(np.array, zip(*transitions, strict=True))
    return Transitions(states, actions, after - states, rewards, np.zeros(len(actions), dtype=bool))


def eq_6(transitions, source, mapping, starts):
    """The compliance of one virtual source task by the equations; ``starts``: bandwidth by number of mapped variables."""
    bandwidths = Bandwidths(starts(mapping), *BANDWIDTHS[1:])
    return equations.task_compliance(
        equations.sample_compliance(as_sample(transitions), as_transitions(source), mapping, bandwidths, DEFAULT_MIN_EVIDENCE)
    )


def naive_candidate_compliances(sources, sets, transitions):
    """Of each (source, target action, state mapping, signs, source action) by going through all tasks."""
    found = Counter()
    for number, (source, mappings) in enumerate(zip(sources, sets, strict=True)):
        for mapping in mappings:
            own = eq_6(transitions, source, mapping, lambda _: BANDWIDTHS[0]) / len(mappings) / len(sources)
            for action, source_action in enumerate(mapping.action):
                found[number, action, mapping.state, mapping.sign, source_action] += own
    return found


def key_of(method, candidate):
    number, action, state_index, source_action = method.candidates.origins[candidate]
    of = method.candidates.sets[number]
    signs = tuple(int(s) for s in of.state_signs[state_index])
    return number, action, tuple(None if k < 0 else int(k) for k in of.state_mappings[state_index]), signs, source_action


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", SETS)
def test_compliances_are_those_of_all_tasks_that_have_a_candidate_added_up(name, seed):
    source, transitions = source_of(seed), transitions_of(15, seed=seed + 10)
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
    for number, mappings in enumerate(sets):
        for mapping in list(mappings)[::7]:
            expected = eq_6(transitions, sources[number], mapping, lambda _: BANDWIDTHS[0])
            assert method.task_compliance(mapping, number) == pytest.approx(expected, rel=1e-9)
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
    exists = np.arange(size.max()) < size[:, None]
    possible = exists & (compliances[:, None] * relevances > 0.0)
    assert possible[drawn[:, 0], drawn[:, 1]].all()
    for begin, end in itertools.pairwise(candidates.arrays.first):
        n = int(((begin <= drawn[:, 0]) & (drawn[:, 0] < end)).sum())
        assert n == min(30, int(possible[begin:end].sum()))


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
    expected = []
    for action in range(2):
        drawn_from = []
        for candidate in np.unique(method.drawn[:, 0]).tolist():
            number, target_action, state, signs, source_action = key_of(method, candidate)
            if target_action == action:
                source = sources[number]
                # Instances are held by source action in an order of their own.
                places = places_within(method, number, candidate)
                chosen = method.drawn[method.drawn[:, 0] == candidate, 1]
                rows = [j for j, place in places.items() if place in chosen]
                drawn_from.append((rows_of(source, rows), InterTaskMapping(state, [source_action] * 2, signs), action))
        expected += [naive.transferred(point, 0.0, drawn_from, task, 0.3) for point in POINTS]
    found = transferred_to_all(method, task)
    assert any(weights for weights, *_ in found)
    for (weights, effects, rewards), naively in zip(found, expected, strict=True):
        assert weights == pytest.approx([each[0] for each in naively])
        np.testing.assert_allclose(effects, np.reshape([each[1] for each in naively], np.shape(effects)), atol=1e-12)
        assert rewards == [each[2] for each in naively]


def places_within(method, number, candidate):
    """Where each instance of a candidate's source and source action is held."""
    source, action = method.sources[number], method.candidates.arrays.action[candidate]
    held = method.candidates.instances.state[action, :, : source.n_variables]
    units, own = source.scaling.to_unit(source.states), method.candidates.origins[candidate].source_action
    return {j: int(np.flatnonzero((held == units[j]).all(axis=1))[0]) for j in np.flatnonzero(source.actions == own).tolist()}


def test_relevance_is_that_of_the_equations():
    source, transitions = source_of(), transitions_of(40)
    for relevance in (True, "near"):
        method = SampleTransfer(source, LISTED, min_transitions=40, relevance=relevance, bandwidths=BANDWIDTHS)
        observed(method, transitions, naive.target_task(POINTS, 2))
        values = np.full((len(method.candidates), int(method.candidates.instances.size.max())), np.nan)
        method._instances.measure_relevance(n_used=40, values=values)
        for candidate, (_, action, state, signs, source_action) in ((c, key_of(method, c)) for c in range(len(values))):
            mapping, given = InterTaskMapping(state, [source_action] * 2, signs), Bandwidths(*BANDWIDTHS)
            if relevance == "near":
                expected = naive.near_relevances(source, mapping, action, transitions, given)
            else:
                rows = np.flatnonzero(source.actions == source_action).tolist()
                expected = {j: naive.relevance(source, j, mapping, action, transitions, given, 0.5) for j in rows}
            for j, place in places_within(method, 0, candidate).items():
                assert values[candidate, place] == pytest.approx(expected[j], rel=1e-7, abs=1e-9)


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
    assert drawn_at == [20, 24, 29]
    assert method.mapping_steps() == 20
    figures = method.statistics()
    assert figures["transfer/draws"] == 3 and figures["transfer/instances_drawn"] == len(method.drawn) > 0
    assert sum(n for _, n in method.drawn_counts()) == len(method.drawn)
    assert len(method.drawn_counts()) == figures["transfer/candidates_drawn"]


def test_most_of_what_is_drawn_by_compliance_alone_stays_when_there_are_a_few_more_transitions():
    method = SampleTransfer(source_of(n=200), n_instances=100, min_transitions=100, relevance=False)
    observed(method, transitions_of(100), naive.target_task(POINTS, 2))
    before = {tuple(row) for row in method.drawn.tolist()}
    for transition in transitions_of(20, seed=9):
        show(method, transition)
    after = {tuple(row) for row in method.drawn.tolist()}
    assert method.statistics()["transfer/draws"] == 2
    assert len(before & after) > 0.8 * len(after)


def test_more_is_drawn_from_the_source_that_complies_and_through_the_mapping_that_does():
    """The first source is the target itself; in the second everything moves at random."""
    rng = np.random.default_rng(0)
    states, actions = rng.random((300, 2)), rng.integers(2, size=300)
    effects = 0.1 * np.column_stack([2 * actions - 1, 0.5 - states[:, 0]])
    good = sb3_combrel.SourceInstances(
        states, actions, -np.ones(300), states + effects, np.zeros(300, dtype=bool), [0.0, 0.0], [1.0, 1.0], 2
    )
    bad = replace(good, next_states=states + 0.2 * rng.normal(size=(300, 2)))
    method = bound(SampleTransfer([good, bad], min_transitions=100, n_instances=400), naive.target_task(rng.random((9, 2)), 2))
    for state, action in zip(rng.random((100, 2)), rng.integers(2, size=100), strict=True):
        after = state + 0.1 * np.array([2 * action - 1, 0.5 - state[0]])
        show(method, naive.Transition(state, int(action), -1.0, after))
    drawn = Counter(method.candidates.origins[c].source for c in method.drawn[:, 0])
    assert drawn[0] > 2 * drawn[1]
    exchanged = InterTaskMapping([1, 0], [1, 0])
    compliances = [method.task_compliance(mapping, k) for mapping in (IDENTITY, exchanged) for k in (0, 1)]
    assert compliances[0] == max(compliances) > 1.5 * max(compliances[1:])


def test_it_helps_on_the_walk():
    steps = {}
    for name, transfer in (("none", None), ("drawn", SampleTransfer(walk_source(), "all", min_transitions=10))):
        model = small(Walk(start=-0.5), transfer=transfer, degree=0)
        model.learn(10_000, StopTrainingOnMaxEpisodes(6))
        steps[name] = model.num_timesteps
    assert steps["drawn"] < steps["none"]
    assert model.policy.transfer.statistics()["transfer/instances_used"] > 0


@pytest.mark.parametrize("arguments", [{}, {"relevance": "near"}, {"relevance": False}, {"min_transitions": 70}], ids=repr)
def test_saved_and_loaded_it_goes_on_as_it_would(arguments, tmp_path):
    given = {"min_transitions": 15, "n_instances": 40} | arguments
    model = small(Walk(start=-0.5), transfer=SampleTransfer(walk_source(), **given), degree=0)
    model.learn(10_000, StopTrainingOnMaxEpisodes(2))
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(start=-0.5))
    method, again = model.policy.transfer, loaded.policy.transfer
    assert same_parameters(model, loaded)
    assert {name: again.arguments()[name] for name in given} == given
    draws = method.statistics()["transfer/draws"]
    assert (draws == 0) == (given["min_transitions"] == 70)
    np.testing.assert_array_equal(again._tasks.sums, method._tasks.sums)
    # Shown the same: learning on, planners may differ by backups below the tolerance, which a file does not hold.
    for transition in transitions_of(80, 2):
        show(method, transition)
        show(again, transition)
        np.testing.assert_array_equal(changed_pairs(again), changed_pairs(method))
    assert method.statistics()["transfer/draws"] > draws
    np.testing.assert_array_equal(again.drawn, method.drawn)
    np.testing.assert_equal(again.statistics(), method.statistics())


def test_several_environments_are_observed_together():
    model = small(make_vec_env(Walk, n_envs=3, seed=0), transfer=SampleTransfer(walk_source(), min_transitions=20)).learn(120)
    assert model.policy.transfer.mapping_steps() == 20
    assert "SampleTransfer" in str(model.policy.transfer.report())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_instances": 0}, "n_instances must be a whole number of at least 1, got 0"),
        ({"min_transitions": 2.5}, "min_transitions must be a whole number of at least 1, got 2.5"),
        ({"max_transitions": None}, "max_transitions must be a whole number of at least 1, got None"),
        ({"min_transitions": 60, "max_transitions": 59}, "max_transitions must be at least min_transitions=60, got 59"),
        ({"relevance": "far"}, "relevance must be True, False or \"near\", got 'far'"),
        ({"relevance_fraction": 0.0}, "relevance_fraction must be a number above 0 and at most 1, got 0.0"),
        ({"breadth": -1.0}, "breadth must be a number above 0, got -1.0"),
        ({"bandwidths": (1.0, 2.0)}, "bandwidths must be three numbers"),
        ({"mappings": "factored"}, "mappings must be a set whose members are tasks to draw from, no factored ones, got 'fact"),
        ({"mappings": FactoredMapping((IDENTITY,))}, "mappings must be a set whose members are tasks to draw from"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        SampleTransfer(walk_source(), **arguments)


def test_what_does_not_fit_the_target_is_refused():
    with pytest.raises(ValueError, match="state must have 2 entries"):
        small(transfer=SampleTransfer(walk_source(), InterTaskMapping([0, None, 1], [0, 1])))
    # 12 target actions on 4 source actions, equally often: 369,600 ways.
    task, many = naive.target_task(POINTS[:, :2].copy(), 12), MappingSet.balanced(2, 2, 4, 12)
    with pytest.raises(ValueError, match=r"mappings must have at most 100,000 action mappings, .* got 369,600"):
        bound(SampleTransfer(source_of(0, 2, 4), many), task)
    # All ways, many more, are no problem.
    method = observed(SampleTransfer(source_of(0, 2, 4), min_transitions=20), transitions_of(20, 2, 12), task)
    assert len(method.drawn)
    with pytest.raises(ValueError, match="mapping must have a state mapping of the set of source 0, got"):
        method.task_compliance(InterTaskMapping([0, None], [0] * 12))
