"""MASTER: random actions first, then the mapping of least mean squared error, as plain loops find it."""

import functools

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.agents import make_agent
from helpers.asking import bound, changed_pairs, pairs_of, transferred_to_all, transferred_to_pairs
from helpers.naive_transfer import source_of, transitions_of
from helpers.walk import small, walk_source

from sb3_combrel import MASTER, TIMBREL, InterTaskMapping, MappingSet
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import SourceModel

USES = ["instances", "prior"]
POINTS = np.random.default_rng(5).random((12, 3))


def show(method, transitions):
    for each in transitions:
        method.observe(each.state, each.action, each.reward, each.next_state, False)
    return method


def naive_error(source, mapping, transitions, predict):
    """Mean squared error of the effects that the source predicts through a mapping that uses all its variables."""
    errors = []
    for state, action, _, next_state in transitions:
        predicted = predict(tuple(mapping.target_to_source(state, source.n_variables)), mapping.action[action])
        for moved, expected in zip(next_state - state, mapping.displacement_to_target(predicted), strict=True):
            errors.append((moved - expected) ** 2)
    return sum(errors) / len(errors)


def naive_errors(source, mappings, transitions):
    model = SourceModel(stacked_instances([source]), 0.2)

    # Hundreds of mappings see the source in the same few states.
    @functools.cache
    def predict(seen, source_action):
        return model.predict(np.array([seen]), np.array([source_action])).effect[0]

    return [naive_error(source, mapping, transitions, predict) for mapping in mappings]


def parts(mapping):
    return mapping.state, mapping.action, mapping.sign


LISTED = [
    InterTaskMapping([0, None, 1], [1, 0]),
    InterTaskMapping([1, 0, None], [0, 0], [1, -1, 1]),
    InterTaskMapping([0, 1, 1], [0, 1]),
]
SETS = {
    "injective": MappingSet.injective(2, 3, 2, 2),
    "signed_surjective": MappingSet.surjective(2, 3, 2, 2, signs=True),
    "balanced": MappingSet.balanced(2, 3, 2, 2),
    "listed": LISTED,
}


@pytest.mark.parametrize("name", SETS)
def test_the_mapping_of_least_mean_squared_error_is_chosen(name):
    source, task, mappings = source_of(), naive.target_task(POINTS, 2), SETS[name]
    transitions = transitions_of(14, seed=10)
    errors = naive_errors(source, mappings, transitions)
    for use in USES:
        method = show(bound(MASTER(source, mappings, n_random_steps=14, use=use), task), transitions)
        assert parts(method.chosen) == parts(list(mappings)[int(np.argmin(errors))])
    assert sorted(errors)[1] > 1.0001 * min(errors), "no other is as good"


@pytest.mark.parametrize("use", USES)
def test_of_several_sources_the_best_mapping_to_one_is_chosen(use):
    sources, transitions = [source_of(3), source_of(4, 1, 3)], transitions_of(20)
    method = bound(MASTER(sources, "surjective", n_random_steps=20, use=use), naive.target_task(POINTS, 2))
    show(method, transitions)
    found = []
    for source in sources:
        mappings = MappingSet.surjective(source.n_variables, 3, source.n_actions, 2)
        errors = naive_errors(source, mappings, transitions)
        found.append((min(errors), parts(mappings[int(np.argmin(errors))])))
    assert parts(method.chosen) == min(found)[1]


def test_a_set_in_which_state_mappings_are_repeated():
    """Those of the paper come in pairs of equal ones."""
    source, transitions = source_of(0, 2, 3), transitions_of(8, 4, 5)
    points = np.random.default_rng(0).random((5, 4))
    different = MappingSet.balanced(2, 4, 3, 5)
    errors = naive_errors(source, different, transitions)
    for use in USES:
        method = bound(MASTER(source, "paper_mountain_car", n_random_steps=8, use=use), naive.target_task(points, 5))
        assert parts(show(method, transitions).chosen) == parts(different[int(np.argmin(errors))])


def test_nothing_is_transferred_before_and_then_what_timbrel_transfers_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12)
    method = bound(MASTER(source, n_random_steps=12, use="instances", breadth=0.4), task)
    show(method, transitions[:11])
    assert method.chosen is None and (method.choices() == -1).all()
    assert len(changed_pairs(method)) == 0
    assert not transferred_to_pairs(method, pairs_of(task), np.zeros(len(pairs_of(task)))).length.any()
    show(method, transitions[11:])
    assert changed_pairs(method).tolist() == pairs_of(task).tolist()
    assert len(changed_pairs(method)) == 0
    given = TIMBREL(source, InterTaskMapping(*parts(method.chosen)), breadth=0.4)
    assert transferred_to_all(method, task) == transferred_to_all(bound(given, task), task)
    assert any(weights for weights, *_ in transferred_to_all(method, task))
    assert {method.candidate(c).target_action for c in set(method.choices().tolist())} == {0, 1}


def test_as_prior_it_predicts_the_effects_that_timbrel_predicts_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12)
    method = bound(MASTER(source, n_random_steps=12, use="prior"), task)
    states, actions = np.tile(POINTS, (2, 1)), np.repeat([0, 1], len(POINTS))
    show(method, transitions[:11])
    version = method.prior_version()
    assert not method.prior(states, actions).effect.any()
    show(method, transitions[11:])
    assert method.prior_version() > version
    given = show(bound(TIMBREL(source, InterTaskMapping(*parts(method.chosen)), use="prior"), task), transitions)
    np.testing.assert_allclose(method.prior(states, actions).effect, given.prior(states, actions).effect, atol=1e-12)
    assert method.prior(states, actions).effect.any()


def test_the_first_actions_are_those_of_the_seeded_generator():
    agent = make_agent(3, 2, MASTER(source_of(), n_random_steps=15), rng=3, resolution=3)
    rng, taken = np.random.default_rng(3), []
    for each in transitions_of(15):
        taken.append(agent.act(each.state))
        agent.update(each.state, taken[-1], -1.0, np.clip(each.next_state, 0.0, 1.0), False)
    assert taken == [int(rng.integers(2)) for _ in range(15)]
    assert agent.transfer.action(np.full(3, 0.5)) is None


def test_the_targets_model_decides_for_a_prior_unless_an_argument_is_one_of_instances():
    assert small(transfer=MASTER(walk_source(), breadth=0.2)).policy.transfer.use == "instances"
    undecided = MASTER(walk_source())
    assert undecided.arguments()["use"] is None
    assert small(transfer=undecided).policy.transfer.use == "prior"
    assert small(transfer=undecided, degree=0).policy.transfer.use == "instances"
