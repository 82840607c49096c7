"""COMBREL's selection, of actions' and of whole mappings, against naive versions; it finds what corresponds, and learns."""

import copy
from collections import Counter

import numpy as np
import pytest
from helpers import asking
from helpers import naive_transfer as naive

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from combrel_envs.mountain_car_dynamics import PUSHES, step_axis
from sb3_combrel import COMBREL, SourceInstances
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.transfer.equations import Bandwidths

BANDWIDTHS = Bandwidths(0.05, 0.05, 1.0)
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("n_neighbors", [1, 3])
def test_at_a_state_of_the_sample_the_choice_and_the_instances_are_those_of_the_exact_state(n_neighbors):
    """That these are the equations' is tested with Algorithm 1."""
    rng, task = np.random.default_rng(5), naive.target_task(POINTS, 2)
    sources = [naive.random_source(rng, 200, 2, 2), naive.random_source(rng, 40, 1, 3)]
    method = asking.bound(COMBREL(sources, n_neighbors=n_neighbors, breadth=0.2, bandwidths=BANDWIDTHS), task)
    for _ in range(30):
        asking.show(method, naive.random_transition(rng, 3, 2))
    method.end_episode(False)
    asking.changed_pairs(method)
    on_grid, n_transferred = method.choices(), 0
    for point in range(len(POINTS)):
        own, pairs = rng.uniform(0.0, 1.2, 2), point + len(POINTS) * np.arange(2)
        np.testing.assert_array_equal(method.selected(np.tile(POINTS[point], (2, 1)), np.arange(2)), on_grid[pairs])
        at = copy.deepcopy(asking.transferred_at(method, POINTS[point], own))
        found = asking.transferred_to_pairs(method, pairs, own)
        np.testing.assert_array_equal(at.length, found.length[:2])
        for action, n in enumerate(at.length):
            np.testing.assert_array_equal(at.effect[action, :n], found.effect[action, :n])
            n_transferred += n > 0
        method.note_use(asking.transferred_at(method, POINTS[point], own))
    assert n_transferred > 20
    counts, figures = method.mapping_counts(), method.statistics()
    in_order = sorted(method.uses().items(), key=lambda use: (-use[1], use[0]))
    assert counts == [(method.describe(candidate), n) for candidate, n in in_order], "whatever was used first"
    assert figures["transfer/uses"] == sum(n for _, n in counts) == n_transferred
    assert 0.0 <= figures["transfer/choice_entropy"] <= np.log(figures["transfer/distinct_mappings"]) + 1e-9


def test_changed_marks_exactly_the_pairs_whose_choice_changed():
    rng = np.random.default_rng(1)
    source, task = naive.random_source(rng, 100, 2, 2), naive.target_task(POINTS, 2)
    method = asking.bound(COMBREL(source, bandwidths=BANDWIDTHS), task)
    assert len(asking.changed_pairs(method)) == 0
    choice, before, n_renewed, n_waited = method.choices(), asking.transferred_to_all(method, task), 0, 0
    for n in range(60):
        asking.show(method, naive.random_transition(rng, 3, 2))
        renewed = asking.changed_pairs(method)
        assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist()
        if n > 10 and len(renewed) == 0:
            n_waited += 1  # the more it has seen, the longer changes wait for each other
            continue
        now = asking.transferred_to_all(method, task)
        assert all(now[pair] == before[pair] for pair in np.setdiff1d(asking.pairs_of(task), renewed))
        choice, before, n_renewed = method.choices(), now, n_renewed + len(renewed)
    assert n_renewed > 40 and n_waited > 20
    asking.show(method, naive.random_transition(rng, 3, 2))
    method.end_episode(False)
    renewed = asking.changed_pairs(method)
    assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist() != [], "an episode's end waits for nothing"
    assert len(asking.changed_pairs(method)) == 0


def test_choices_depend_on_what_was_seen_and_those_of_known_pairs_are_renewed_when_they_are_unknown_again():
    """A choice that changed and changed back is not marked; a removed instance can make a pair unknown."""
    rng, task = np.random.default_rng(1), naive.target_task(POINTS, 2)
    often, once, lazy = (
        asking.bound(COMBREL(naive.random_source(np.random.default_rng(9), 60, 2, 2)), task) for _ in range(3)
    )
    known, each = np.tile(POINTS[:, 0] < 0.9, 2), []
    for _ in range(40):
        transition = naive.random_transition(rng, 3, 2)
        for method in (often, once, lazy):
            asking.show(method, transition)
        often.end_episode(False)
        each.append(asking.changed_pairs(often))
    at_once = asking.changed_pairs(once)
    assert sorted(at_once) == np.flatnonzero(once.choices() >= 0).tolist() and set(at_once) <= set(np.concatenate(each))
    np.testing.assert_array_equal(often.choices(), once.choices())
    assert sorted(asking.changed_pairs(lazy, known)) == sorted(set(at_once) - set(np.flatnonzero(known)))
    assert (lazy.choices()[known] == -1).all()
    lazy.end_episode(False)
    np.testing.assert_array_equal(asking.choices_of(lazy), once.choices())


def test_where_the_sample_moves_choices_are_those_of_its_new_states():
    rng = np.random.default_rng(1)
    source = naive.random_source(np.random.default_rng(9), 60, 2, 2)
    transitions = [naive.random_transition(rng, 3, 2) for _ in range(40)]
    there, task = naive.target_task(0.6 * POINTS, 2), naive.target_task(POINTS, 2)
    methods = [asking.bound(COMBREL(source), each) for each in (there, task, task)]
    before, moved, anew = methods
    for method in (before, anew):
        for transition in transitions:
            asking.show(method, transition)
        asking.changed_pairs(method)
    moved.set_state(before.get_state())
    np.testing.assert_array_equal(moved.choices(), before.choices())
    moved.sample_moved()
    np.testing.assert_array_equal(moved.choices(), anew.choices())
    assert moved.statistics()["transfer/switches"] == before.statistics()["transfer/switches"]
    assert (moved.choices() != before.choices()).sum() > 10


def test_measured_in_the_first_episode_nothing_is_transferred_before_it_ends_and_nothing_changes_after():
    rng = np.random.default_rng(2)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    paper, online = (
        asking.bound(COMBREL(source, measured=when, bandwidths=BANDWIDTHS), task) for when in ("first_episode", "online")
    )

    def show_both():
        for _ in range(20):
            transition = naive.random_transition(rng, 3, 2)
            asking.show(paper, transition)
            asking.show(online, transition)
        return transition

    last = show_both()
    assert len(asking.changed_pairs(paper)) == 0 < len(asking.changed_pairs(online))
    assert not asking.transferred_at(paper, last.state, np.zeros(2)).length.any()
    assert not any(weights for weights, _, _ in asking.transferred_to_all(paper, task))
    paper.end_episode(False)
    assert len(asking.changed_pairs(paper)) > 0
    at_its_end = asking.transferred_to_all(paper, task)
    assert any(weights for weights, _, _ in at_its_end) and at_its_end == asking.transferred_to_all(online, task)
    np.testing.assert_array_equal(paper.choices(), online.choices())
    show_both()
    assert len(asking.changed_pairs(paper)) == 0 < len(asking.changed_pairs(online))
    assert asking.transferred_to_all(paper, task) == at_its_end != asking.transferred_to_all(online, task)


def test_without_transitions_nothing_is_transferred_and_no_more_are_recorded_than_allowed():
    rng, task = np.random.default_rng(2), naive.target_task(POINTS, 2)
    method = asking.bound(COMBREL(naive.random_source(rng, 50), max_transitions=7, breadth=1.0), task)
    assert not any(weights for weights, _, _ in asking.transferred_to_all(method, task))
    assert not asking.transferred_at(method, POINTS[0], np.zeros(2)).length.any()
    for _ in range(20):
        asking.show(method, naive.random_transition(rng, 3, 2))
    assert method.statistics()["transfer/target_transitions"] == 7


def test_episodes_that_reach_their_limit_narrow_the_kernel_of_contradicted_instances():
    rng, task = np.random.default_rng(2), naive.target_task(POINTS, 2)
    source = naive.random_source(rng, 200, 2, 2)
    decaying = asking.bound(COMBREL(source, breadth_decay=0.5, bandwidths=BANDWIDTHS), task)
    narrow = asking.bound(COMBREL(source, breadth=0.15, bandwidths=BANDWIDTHS), task)
    for _ in range(60):
        transition = naive.random_transition(rng, 3, 2)
        for method in (decaying, narrow):
            method.note_use(asking.transferred_at(method, transition.state, np.zeros(2)))
            asking.show(method, transition)
    assert decaying.statistics()["transfer/prediction_error"] > 1.0
    asking.changed_pairs(decaying), asking.changed_pairs(narrow)
    before = asking.transferred_to_all(decaying, task)
    decaying.end_episode(False)
    assert asking.transferred_to_all(decaying, task) == before and len(asking.changed_pairs(decaying)) == 0
    decaying.end_episode(True)
    assert asking.transferred_to_all(decaying, task) == asking.transferred_to_all(narrow, task) != before
    assert asking.changed_pairs(decaying).tolist() == asking.pairs_of(task).tolist()


def mountain_car(n, seed, n_axes=1):
    """Single steps of Mountain Car from states all over its space."""
    rng = np.random.default_rng(seed)
    low, high = np.repeat([-1.2, -0.07], n_axes), np.repeat([0.6, 0.07], n_axes)
    states, actions = rng.uniform(low, high, (n, 2 * n_axes)), rng.integers(len(PUSHES[n_axes]), size=n)
    after = np.empty_like(states)
    for i, axis in np.ndindex(n, n_axes):
        push = PUSHES[n_axes][actions[i]][axis]
        after[i, [axis, n_axes + axis]] = step_axis(states[i, axis], states[i, n_axes + axis], push)
    ends = (after[:, :n_axes] >= 0.5).all(axis=1)
    return SourceInstances(states, actions, -np.ones(n), after, ends, low, high, len(PUSHES[n_axes]))


def choices_after(method, target, resolution=8):
    """What the method has chosen after it has seen the target: for each action (source, state, sign, source action)s."""
    d = target.n_variables
    axes = [np.linspace(0.05, 0.95, resolution)] * d
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    asking.bound(method, naive.target_task(points, target.n_actions))
    starts, ends = ((x - target.low) / (target.high - target.low) for x in (target.states, target.next_states))
    for i in range(len(target)):
        asking.show(method, naive.Transition(starts[i], int(target.actions[i]), float(target.rewards[i]), ends[i]))
    named = asking.named_candidates(method)
    return [[named[c] for c in row if c >= 0] for row in asking.choices_of(method).reshape(target.n_actions, -1)]


def test_each_action_of_the_larger_car_gets_the_axis_that_it_drives():
    """East and West act like Right and Left on x; from y's point of view they do nothing. North and South: vice versa."""
    chosen = choices_after(COMBREL(mountain_car(1000, 0)), mountain_car(1500, 2, 2), resolution=4)
    along_x, along_y = (0, None, 1, None), (None, 0, None, 1)
    fitting = [{(along_x, 0), (along_y, 0)}]
    fitting += [{(along_x, 1), (along_y, 0)}, {(along_x, 2), (along_y, 0)}]
    fitting += [{(along_y, 1), (along_x, 0)}, {(along_y, 2), (along_x, 0)}]
    for action, row in enumerate(chosen):
        by_number = Counter((choice[1], choice[3]) for choice in row).most_common(2)
        assert {way for way, _ in by_number} == fitting[action] and sum(n for _, n in by_number) > 0.6 * len(row)


@pytest.mark.parametrize("relevance", [False, True, "near"])
def test_with_relevance_the_instances_that_the_target_contradicts_come_last(relevance):
    """Half of the source's instances are from the target, the other half say that nothing ever moves."""
    good, target = mountain_car(400, 0), mountain_car(300, 1)
    states, after = np.vstack([good.states, good.states + 1e-6]), np.vstack([good.next_states, good.states + 1e-6])
    rows = np.tile(good.actions, 2), np.tile(good.rewards, 2)
    source = SourceInstances(states, *rows, after, np.zeros(800, dtype=bool), good.low, good.high, 3)
    task = naive.target_task(np.random.default_rng(0).uniform(0.1, 0.9, (100, 2)), 3)
    method = asking.bound(COMBREL(source, InterTaskMapping([0, 1], [0, 1, 2]), relevance=relevance), task)
    starts, ends = ((x - target.low) / (target.high - target.low) for x in (target.states, target.next_states))
    for i in range(len(target)):
        asking.show(method, naive.Transition(starts[i], int(target.actions[i]), -1.0, ends[i]))
    asking.changed_pairs(method)
    effects = np.array([effect for _, of_pair, _ in asking.transferred_to_all(method, task) for effect in of_pair])
    still = np.mean(np.abs(effects).max(axis=1) == 0.0)
    assert still < 0.1 if relevance else still > 0.4


STATES = np.random.default_rng(7).random((30, 3))


@pytest.mark.parametrize("n_neighbors", [1, 3])
def test_every_state_gets_the_whole_mapping_with_the_highest_mean_compliance(n_neighbors):
    rng = np.random.default_rng(n_neighbors)
    sources = [naive.random_source(rng, 40, 2, 2), naive.random_source(rng, 40, 1, 3)]
    sets = [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources]
    task = naive.target_task(STATES, 2)
    arguments = dict(n_neighbors=n_neighbors, min_compliance=0.0, bandwidths=BANDWIDTHS)
    method = asking.bound(COMBREL(sources, neighbors="state_action", **arguments), task)
    seen = [naive.random_transition(rng, 3, 2) for _ in range(12)]
    for transition in seen:
        asking.show(method, transition)
    choices, n_chosen = asking.choices_of(method).reshape(2, -1), 0
    exact = method._instances.selector.select(np.repeat(STATES, 2, axis=0), np.tile(np.arange(2), len(STATES)), np.zeros(60))
    wholes = [(number, mapping) for number, mappings in enumerate(sets) for mapping in mappings]
    table = np.array([[naive.compliance(t, sources[k], mapping, BANDWIDTHS) for k, mapping in wholes] for t in seen])
    for point, state in enumerate(STATES):
        # The nearest transitions, whatever their action.
        expected = table[np.argsort([np.linalg.norm(t.state - state) for t in seen])[:n_neighbors]].mean(axis=0)
        best, first = expected.max(), choices[:, point] - method.candidates.arrays.first[:-1]
        if best == 0.0:
            assert (choices[:, point] == -1).all()
            continue
        n_chosen += 1
        assert first[0] == first[1], "one whole mapping for all actions of a state"
        assert expected[first[0]] == pytest.approx(best, rel=1e-9)
        assert exact[0][2 * point : 2 * point + 2].tolist() == choices[:, point].tolist()
        for action in range(2):
            origin, (number, mapping) = method.candidates.origins[choices[action, point]], wholes[first[0]]
            assert (origin.source, origin.target_action, origin.source_action) == (number, action, mapping.action[action])
    assert n_chosen > 20


def test_the_action_of_a_neighbor_decides_between_mappings_with_the_same_source_action():
    """Both mappings have source action 0 for target action 0; a transition with action 1 next to it tells them apart."""
    states, actions = np.random.default_rng(0).random((200, 1)), np.arange(200) % 2
    effects = np.where(actions == 0, 0.1, -0.1)[:, None]
    source = naive.SourceInstances(
        states, actions, -np.ones(200), states + effects, np.zeros(200, bool), np.zeros(1), np.ones(1), 2
    )
    mappings = [InterTaskMapping([0], [0, 0]), InterTaskMapping([0], [0, 1])]
    task, chosen = naive.target_task(np.array([[0.5]]), 2), {}
    for neighbors in ("action", "state_action"):
        method = asking.bound(COMBREL(source, mappings, neighbors=neighbors), task)
        asking.show(method, naive.Transition(np.array([0.5]), 1, -1.0, np.array([0.4])))
        chosen[neighbors] = [method.describe(c) if c >= 0 else None for c in asking.choices_of(method)]
    assert chosen["action"] == [None, "a1<-a1 with s0<-s0"]
    assert chosen["state_action"] == ["a0<-a0 with s0<-s0, of the actions a0, a1", "a1<-a1 with s0<-s0, of the actions a0, a1"]
