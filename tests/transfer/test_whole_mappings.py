"""COMBREL with neighbors="state_action": whole mappings against a naive version of that reading of the paper."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, choices_of, pairs_of, show, transferred_to_pairs

from sb3_combrel import COMBREL
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.transfer.equations import Bandwidths

BANDWIDTHS = Bandwidths(0.05, 0.05, 1.0)
POINTS = np.random.default_rng(7).random((30, 3))


def mean_compliance(seen, sources, sets, state, n_neighbors):
    """Mean compliance of each (source, whole mapping) with the nearest transitions, whatever their action."""
    near = sorted(seen, key=lambda t: naive.distance(t.state, state))[:n_neighbors]
    return [
        (np.mean([naive.compliance(t, source, mapping, BANDWIDTHS) for t in near]), number, mapping)
        for number, (source, mappings) in enumerate(zip(sources, sets, strict=True))
        for mapping in (mappings[k] for k in range(len(mappings)))
    ]


@pytest.mark.parametrize("n_neighbors", [1, 3])
def test_every_state_gets_the_whole_mapping_with_the_highest_mean_compliance(n_neighbors):
    rng = np.random.default_rng(n_neighbors)
    sources = [naive.random_source(rng, 40, 2, 2), naive.random_source(rng, 40, 1, 3)]
    sets = [MappingSet.injective(s.n_variables, 3, s.n_actions, 2) for s in sources]
    task = naive.target_task(POINTS, 2)
    arguments = dict(n_neighbors=n_neighbors, min_compliance=0.0, bandwidths=BANDWIDTHS)
    method = bound(COMBREL(sources, neighbors="state_action", **arguments), task)
    seen = [naive.random_transition(rng, 3, 2) for _ in range(12)]
    for transition in seen:
        show(method, transition)
    choices, n_chosen = choices_of(method).reshape(2, -1), 0
    exact = method._instances.selector.select(np.repeat(POINTS, 2, axis=0), np.tile(np.arange(2), len(POINTS)), np.zeros(60))
    for point, state in enumerate(POINTS):
        expected = mean_compliance(seen, sources, sets, state, n_neighbors)
        best = max(mean for mean, _, _ in expected)
        first = choices[:, point] - method.candidates.arrays.first[:-1]
        if best == 0.0:
            assert (choices[:, point] == -1).all()
            continue
        n_chosen += 1
        assert first[0] == first[1], "one whole mapping for all actions of a state"
        assert expected[first[0]][0] == pytest.approx(best, rel=1e-9)
        assert exact[0][2 * point : 2 * point + 2].tolist() == choices[:, point].tolist()
        for action in range(2):
            origin, (_, number, mapping) = method.candidates.origins[choices[action, point]], expected[first[0]]
            assert (origin.source, origin.target_action, origin.source_action) == (number, action, mapping.action[action])
    assert n_chosen > 20


def test_the_action_of_a_neighbor_decides_between_mappings_with_the_same_source_action():
    """Both mappings have source action 0 for target action 0; a transition with action 1 next to it tells them apart."""
    rng = np.random.default_rng(0)
    states = rng.random((200, 1))
    actions = np.arange(200) % 2
    effects = np.where(actions == 0, 0.1, -0.1)[:, None]
    source = naive.SourceInstances(
        states, actions, -np.ones(200), states + effects, np.zeros(200, bool), np.zeros(1), np.ones(1), 2
    )
    mappings = [InterTaskMapping([0], [0, 0]), InterTaskMapping([0], [0, 1])]
    task = naive.target_task(np.array([[0.5]]), 2)
    chosen = {}
    for neighbors in ("action", "state_action"):
        method = bound(COMBREL(source, mappings, neighbors=neighbors), task)
        show(method, naive.Transition(np.array([0.5]), 1, -1.0, np.array([0.4])))
        chosen[neighbors] = [method.describe(c) if c >= 0 else None for c in choices_of(method)]
    assert chosen["action"] == [None, "a1<-a1 with s0<-s0"]
    assert chosen["state_action"] == [
        "a0<-a0 with s0<-s0, of the actions a0, a1",
        "a1<-a1 with s0<-s0, of the actions a0, a1",
    ]


def test_what_is_transferred_is_that_of_the_mapping_chosen():
    rng = np.random.default_rng(3)
    source, task = naive.random_source(rng, 200, 2, 2), naive.target_task(POINTS, 2)
    method = bound(COMBREL(source, neighbors="state_action", breadth=0.2, bandwidths=BANDWIDTHS), task)
    for _ in range(30):
        show(method, naive.random_transition(rng, 3, 2))
    choices, n_transferred = choices_of(method), 0
    found = transferred_to_pairs(method, pairs_of(task), np.zeros(60))
    for pair, chosen in enumerate(choices):
        expected = []
        if chosen >= 0:
            action = pair // len(POINTS)
            mapping = method.candidates.sets[0][int(chosen - method.candidates.arrays.first[action])]
            expected = naive.transferred(POINTS[pair % len(POINTS)], 0.0, [(source, mapping, action)], task, 0.2)
        assert found.length[pair] == len(expected)
        np.testing.assert_allclose(found.weight[pair, : len(expected)], [e[0] for e in expected], rtol=1e-9)
        n_transferred += len(expected)
    assert n_transferred > 20
