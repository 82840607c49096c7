"""MASTER: random actions first, then the mapping of least mean squared error, as plain loops find it."""

import functools

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.agents import make_agent
from helpers.asking import bound, changed_pairs, pairs_of, transferred_to_all, transferred_to_pairs
from helpers.walk import Walk, small, walk_source
from stable_baselines3.common.env_util import make_vec_env

from sb3_combrel import MASTER, TIMBREL, InterTaskMapping, MappingSet
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import SourceModel

USES = ["instances", "prior"]
POINTS = np.random.default_rng(5).random((12, 3))


def source_of(seed=0, n_variables=2, n_actions=2):
    return naive.random_source(np.random.default_rng(seed), 120, n_variables, n_actions)


def transitions_of(n, n_variables, n_actions, seed=1):
    rng = np.random.default_rng(seed)
    return [naive.random_transition(rng, n_variables, n_actions) for _ in range(n)]


def show(method, transitions):
    for each in transitions:
        method.observe(each.state, each.action, each.reward, each.next_state, False)
    return method


def naive_error(source, mapping, transitions, predict):
    """Mean squared error of the effects that the source predicts through a mapping that uses all its variables."""
    errors = []
    for state, action, _, next_state in transitions:
        seen = mapping.target_to_source(state, source.n_variables)
        predicted = predict(tuple(seen), mapping.action[action])
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


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", SETS)
def test_the_mapping_of_least_mean_squared_error_is_chosen(name, seed, use):
    source, task, mappings = source_of(seed), naive.target_task(POINTS, 2), SETS[name]
    transitions = transitions_of(14, 3, 2, seed + 10)
    method = show(bound(MASTER(source, mappings, n_random_steps=14, use=use), task), transitions)
    errors = naive_errors(source, mappings, transitions)
    assert parts(method.chosen) == parts(list(mappings)[int(np.argmin(errors))])
    assert sorted(errors)[1] > 1.0001 * min(errors), "no other is as good"


@pytest.mark.parametrize("use", USES)
def test_of_several_sources_the_best_mapping_to_one_is_chosen(use):
    sources, transitions = [source_of(3, 2, 2), source_of(4, 1, 3)], transitions_of(20, 3, 2)
    method = bound(MASTER(sources, "surjective", n_random_steps=20, use=use), naive.target_task(POINTS, 2))
    show(method, transitions)
    found = []
    for source in sources:
        mappings = MappingSet.surjective(source.n_variables, 3, source.n_actions, 2)
        errors = naive_errors(source, mappings, transitions)
        found.append((min(errors), parts(mappings[int(np.argmin(errors))])))
    assert parts(method.chosen) == min(found)[1]


@pytest.mark.parametrize("use", USES)
def test_a_set_in_which_state_mappings_are_repeated(use):
    """Those of the paper come in pairs of equal ones."""
    source, transitions = source_of(0, 2, 3), transitions_of(8, 4, 5)
    points = np.random.default_rng(0).random((5, 4))
    method = bound(MASTER(source, "paper_mountain_car", n_random_steps=8, use=use), naive.target_task(points, 5))
    show(method, transitions)
    different = MappingSet.balanced(2, 4, 3, 5)
    errors = naive_errors(source, different, transitions)
    assert parts(method.chosen) == parts(different[int(np.argmin(errors))])


def test_nothing_is_transferred_before_and_then_what_timbrel_transfers_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12, 3, 2)
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


def test_of_several_sources_the_instances_of_the_chosen_one_are_transferred():
    # The second is the target itself, seen through a mapping.
    mapping, rng = InterTaskMapping([1, None, 0], [1, 0]), np.random.default_rng(2)
    sources, task = [source_of(3), source_of(4)], naive.target_task(POINTS, 2)
    method = bound(MASTER(sources, n_random_steps=20, use="instances", breadth=0.4), task)
    model = SourceModel(stacked_instances([sources[1]]), 0.2)
    for state in rng.random((20, 3)):
        action = int(rng.integers(2))
        seen = mapping.target_to_source(state, 2)[None]
        effect = model.predict(seen, np.array([mapping.action[action]])).effect[0]
        method.observe(state, action, -1.0, state + mapping.displacement_to_target(effect), False)
    assert parts(method.chosen) == parts(mapping)
    expected = transferred_to_all(bound(TIMBREL(sources[1], mapping, breadth=0.4), task), task)
    assert transferred_to_all(method, task) == expected
    assert any(weights for weights, *_ in expected)


def test_as_prior_it_predicts_the_effects_that_timbrel_predicts_through_that_mapping():
    source, task, transitions = source_of(), naive.target_task(POINTS, 2), transitions_of(12, 3, 2)
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


def test_all_random_transitions_count_however_many():
    """A prior whose mapping may change later measures one in five of them from some time on."""
    method = bound(MASTER(source_of(), n_random_steps=520, use="prior"), naive.target_task(POINTS, 2))
    show(method, transitions_of(519, 3, 2))
    assert method.chosen is None and method.source_prior.sums.n.sum() == 519
    show(method, transitions_of(1, 3, 2))
    assert method.chosen is not None


def test_the_first_actions_are_those_of_the_seeded_generator():
    agent = make_agent(3, 2, MASTER(source_of(), n_random_steps=15), rng=3, resolution=3)
    rng, taken = np.random.default_rng(3), []
    for each in transitions_of(15, 3, 2):
        taken.append(agent.act(each.state))
        agent.update(each.state, taken[-1], -1.0, np.clip(each.next_state, 0.0, 1.0), False)
    assert taken == [int(rng.integers(2)) for _ in range(15)]
    assert agent.transfer.action(np.full(3, 0.5)) is None


def test_several_environments_act_at_random_together():
    model = small(make_vec_env(Walk, n_envs=3, seed=0), transfer=MASTER(walk_source(), n_random_steps=20)).learn(120)
    assert parts(model.transfer.chosen)[:2] == ((0, 1), (0, 1))
    assert model.transfer.describe_prior() == "a0: a0 on (s0, s1); a1: a1 on (s0, s1)"
    figures = model.transfer.report().statistics
    assert (figures["transfer/steps_to_find_mapping"], figures["transfer/mapping_found"]) == (20, 1.0)


def test_the_targets_model_decides_for_a_prior_unless_an_argument_is_one_of_instances():
    assert small(transfer=MASTER(walk_source(), breadth=0.2)).policy.transfer.use == "instances"
    undecided = MASTER(walk_source())
    assert undecided.arguments()["use"] is None
    assert small(transfer=undecided).policy.transfer.use == "prior"
    assert small(transfer=undecided, degree=0).policy.transfer.use == "instances"
