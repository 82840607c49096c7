"""COMBREL's selection against a naive version of Algorithm 1, and that it finds which variables and actions correspond."""

import copy

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import (
    bound,
    changed_pairs,
    choices_of,
    named_candidates,
    pairs_of,
    show,
    transferred_at,
    transferred_to_all,
    transferred_to_pairs,
)

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import COMBREL
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.transfer.equations import Bandwidths

BANDWIDTHS = Bandwidths(0.05, 0.05, 1.0)
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


class NaiveSelection:
    """Lines 17 to 20 of Algorithm 1, mapping by mapping."""

    def __init__(self, sources, mappings, n_neighbors):
        self.sources, self.mappings, self.k = sources, mappings, n_neighbors
        self.seen = []
        self.known = {}

    def means(self, state, action):
        """Mean compliance of each (source, mapping) with the nearest transitions of ``action``."""
        near = sorted((t for t in self.seen if t.action == action), key=lambda t: naive.distance(t.state, state))[: self.k]
        if not near:
            return {}
        return {
            (number, mapping.state, mapping.sign, mapping.action[action]): np.mean(
                [self.compliance(t, number, mapping) for t in near]
            )
            for number, of_source in enumerate(self.mappings)
            for mapping in of_source
        }

    def compliance(self, transition, number, mapping):
        """Naive, but computed once only."""
        key = (id(transition), number, mapping)
        if key not in self.known:
            self.known[key] = naive.compliance(transition, self.sources[number], mapping, BANDWIDTHS)
        return self.known[key]


@pytest.mark.parametrize("n_neighbors", [1, 3, 5])
def test_every_pair_gets_the_mapping_with_the_highest_mean_compliance_of_its_neighbors(n_neighbors):
    rng = np.random.default_rng(n_neighbors)
    sources = [naive.random_source(rng, 40, 2, 2), naive.random_source(rng, 40, 1, 3)]
    task = naive.target_task(POINTS[::5], 2)
    method = bound(COMBREL(sources, n_neighbors=n_neighbors, bandwidths=BANDWIDTHS), task)
    selection = NaiveSelection(sources, [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources], n_neighbors)
    named, n_points = named_candidates(method), len(task.sample_states)
    for _ in range(12):
        transition = naive.random_transition(rng, 3, 2)
        show(method, transition)
        selection.seen.append(transition)
    n_chosen, choices = 0, choices_of(method)
    for pair in pairs_of(task):
        means = selection.means(task.sample_states[pair % n_points], pair // n_points)
        chosen = choices[pair]
        if chosen < 0:
            assert max(means.values(), default=0.0) == 0.0
        else:
            n_chosen += 1
            assert means[named[chosen]] == pytest.approx(max(means.values()), rel=1e-9)
    assert n_chosen > 0
    for state in rng.random((20, 3)):
        for action, chosen in enumerate(method.selected(np.tile(state, (2, 1)), np.arange(2))):
            means = selection.means(state, action)
            assert (chosen < 0) == (max(means.values()) == 0.0)
            assert chosen < 0 or means[named[chosen]] == pytest.approx(max(means.values()), rel=1e-9)


def test_the_chosen_mapping_translates_at_grid_points_and_at_exact_states():
    rng = np.random.default_rng(5)
    source = naive.random_source(rng, 200, 2, 2)
    task = naive.target_task(POINTS, 2)
    method = bound(COMBREL(source, breadth=0.2, bandwidths=BANDWIDTHS), task)
    for _ in range(30):
        show(method, naive.random_transition(rng, 3, 2))
    named, pairs, n_transferred = named_candidates(method), pairs_of(task), 0
    own = rng.uniform(0.0, 1.2, len(pairs))
    changed_pairs(method, own >= 1.0)
    found = transferred_to_pairs(method, pairs, own)
    for pair in pairs:
        chosen, expected = method.choices()[pair], []
        if chosen >= 0 and own[pair] < 1.0:
            _, index, sign, source_action = named[chosen]
            state = task.sample_states[pair % len(POINTS)]
            drawn_from = [(source, InterTaskMapping(index, [source_action], sign), 0)]
            expected = naive.transferred(state, own[pair], drawn_from, task, 0.2)
        n = found.length[pair]
        assert n == len(expected)
        np.testing.assert_allclose(found.weight[pair, :n], [e[0] for e in expected], rtol=1e-9)
        np.testing.assert_allclose(found.effect[pair, :n], np.array([e[1] for e in expected]).reshape(n, 3), atol=1e-12)
        n_transferred += n > 0
    assert n_transferred > 20
    # At a sample state itself, the choice and the instances are those of the grid point.
    method.end_episode(False)
    changed_pairs(method)
    for point in range(len(POINTS)):
        at = copy.deepcopy(transferred_at(method, POINTS[point], np.zeros(2)))
        on_grid = transferred_to_pairs(method, point + len(POINTS) * np.arange(2), np.zeros(2))
        for action in range(2):
            n = at.length[action]
            assert n == on_grid.length[action]
            np.testing.assert_array_equal(at.effect[action, :n], on_grid.effect[action, :n])


def test_changed_marks_exactly_the_pairs_whose_choice_changed():
    rng = np.random.default_rng(1)
    source, task = naive.random_source(rng, 100, 2, 2), naive.target_task(POINTS, 2)
    method = bound(COMBREL(source, bandwidths=BANDWIDTHS), task)
    assert len(changed_pairs(method)) == 0
    choice, before, n_renewed, n_waited = method.choices(), transferred_to_all(method, task), 0, 0
    for n in range(60):
        show(method, naive.random_transition(rng, 3, 2))
        renewed = changed_pairs(method)
        assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist()
        if n > 10 and len(renewed) == 0:
            n_waited += 1  # the more it has seen, the longer changes wait for each other
            continue
        now = transferred_to_all(method, task)
        assert all(now[pair] == before[pair] for pair in np.setdiff1d(pairs_of(task), renewed))
        choice, before, n_renewed = method.choices(), now, n_renewed + len(renewed)
    assert n_renewed > 40 and n_waited > 20
    show(method, naive.random_transition(rng, 3, 2))
    method.end_episode(False)
    renewed = changed_pairs(method)
    assert sorted(renewed) == np.flatnonzero(method.choices() != choice).tolist() != [], "an episode's end waits for nothing"
    assert len(changed_pairs(method)) == 0


def test_a_choice_that_changed_and_changed_back_is_not_marked():
    rng = np.random.default_rng(1)
    task = naive.target_task(POINTS, 2)
    one, other = (bound(COMBREL(naive.random_source(np.random.default_rng(9), 60, 2, 2)), task) for _ in range(2))
    each = []
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(one, transition)
        show(other, transition)
        one.end_episode(False)
        each.append(changed_pairs(one))
    at_once = changed_pairs(other)
    assert sorted(at_once) == np.flatnonzero(other.choices() >= 0).tolist()
    assert set(at_once) <= set(np.concatenate(each))
    np.testing.assert_array_equal(one.choices(), other.choices())


def test_choices_of_known_pairs_are_not_renewed_until_they_are_unknown_again():
    """And transitions that are near to known pairs only are not measured. A removed instance can make a pair unknown."""
    rng = np.random.default_rng(3)
    task = naive.target_task(POINTS, 2)
    lazy, eager = (bound(COMBREL(naive.random_source(np.random.default_rng(9), 60, 2, 2)), task) for _ in range(2))
    known = np.tile(POINTS[:, 0] < 0.9, 2)
    for _ in range(60):
        transition = naive.random_transition(rng, 3, 2)
        show(lazy, transition)
        show(eager, transition)
    assert sorted(changed_pairs(lazy, known)) == sorted(set(changed_pairs(eager)) - set(np.flatnonzero(known)))
    assert (lazy.choices()[known] == -1).all()
    assert 0 < lazy._instances.selector._cache.measured.sum() < eager._instances.selector._cache.measured.sum()
    lazy.end_episode(False)
    np.testing.assert_array_equal(choices_of(lazy), eager.choices())


def test_without_transitions_nothing_is_transferred():
    task = naive.target_task(POINTS, 2)
    method = bound(COMBREL(naive.random_source(np.random.default_rng(0), 100, 2, 2), breadth=1.0), task)
    assert not any(weights for weights, _, _ in transferred_to_all(method, task))
    assert not transferred_at(method, POINTS[0], np.zeros(2)).length.any()


def test_measured_in_the_first_episode_nothing_is_transferred_before_it_ends_and_nothing_changes_after():
    rng = np.random.default_rng(2)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    paper = bound(COMBREL(source, measured="first_episode", bandwidths=BANDWIDTHS), task)
    online = bound(COMBREL(source, measured="online", bandwidths=BANDWIDTHS), task)
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(paper, transition)
        show(online, transition)
        assert len(changed_pairs(paper)) == 0
        assert not transferred_at(paper, transition.state, np.zeros(2)).length.any()
    assert not any(weights for weights, _, _ in transferred_to_all(paper, task))
    assert len(changed_pairs(online)) > 0
    assert any(weights for weights, _, _ in transferred_to_all(online, task))
    paper.end_episode(False)
    assert len(changed_pairs(paper)) > 0
    at_its_end = transferred_to_all(paper, task)
    assert at_its_end == transferred_to_all(online, task)
    np.testing.assert_array_equal(paper.choices(), online.choices())
    for _ in range(20):
        transition = naive.random_transition(rng, 3, 2)
        show(paper, transition)
        show(online, transition)
    assert len(changed_pairs(paper)) == 0 < len(changed_pairs(online))
    assert transferred_to_all(paper, task) == at_its_end != transferred_to_all(online, task)


def test_no_more_transitions_are_recorded_than_allowed():
    rng = np.random.default_rng(2)
    method = bound(COMBREL(naive.random_source(rng, 50), max_transitions=7), naive.target_task(POINTS, 2))
    for _ in range(20):
        show(method, naive.random_transition(rng, 3, 2))
    assert method.statistics()["transfer/target_transitions"] == 7


def test_episodes_that_reach_their_limit_narrow_the_kernel_of_contradicted_instances():
    rng = np.random.default_rng(2)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    decaying, steady = (bound(COMBREL(source, breadth_decay=f, bandwidths=BANDWIDTHS), task) for f in (0.5, 1.0))
    narrow = bound(COMBREL(source, breadth=0.15, bandwidths=BANDWIDTHS), task)
    for _ in range(60):
        transition = naive.random_transition(rng, 3, 2)
        for method in (decaying, steady, narrow):
            method.note_use(transferred_at(method, transition.state, np.zeros(2)))
            show(method, transition)
    assert decaying.statistics()["transfer/prediction_error"] > 1.0
    for method in (decaying, steady, narrow):
        changed_pairs(method)
    before = transferred_to_all(decaying, task)
    decaying.end_episode(False)
    assert transferred_to_all(decaying, task) == before and len(changed_pairs(decaying)) == 0
    for method in (decaying, steady):
        method.end_episode(True)
    assert transferred_to_all(steady, task) == before
    assert transferred_to_all(decaying, task) == transferred_to_all(narrow, task) != before
    assert changed_pairs(decaying).tolist() == pairs_of(task).tolist()
