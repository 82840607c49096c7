"""Which source instances are transferred to a pair, and as what, against a naive implementation of the rules."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sb3_combrel import TIMBREL
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.transferred import Supply
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.mapping_transfer import stacked_instances, stacked_table
from sb3_combrel.transfer.translation import BestInstances, CandidateArrays, TransferRules, translate

seeds = st.integers(0, 2**32 - 1)


def supplied(states, own, mappings, source, task, breadth, believe_terminal=True, merit=None, most=200):
    """What ``translate`` gives each state from all of ``mappings``, for target action 0."""
    listed = MappingSet.from_list(mappings)
    rows, actions = listed.candidates(0)
    ways = CandidateArrays(np.array([0, len(rows)]), rows, actions)
    instances = stacked_instances([source])
    n, d = states.shape
    supply = Supply(
        np.full(n, -1, dtype=np.int64),
        np.full((n, most), np.nan),
        np.full((n, most, d), np.nan),
        np.full((n, most), np.nan),
        np.zeros((n, most), dtype=np.bool_),
    )
    translate(
        states,
        own,
        np.zeros(n, dtype=np.int64),
        np.full(n, len(rows)),
        instances,
        ways,
        stacked_table([listed]),
        TransferRules(
            task.exploration_threshold, breadth, task.min_weight, task.min_fraction, believe_terminal, merit is not None
        ),
        np.empty((1, 0)) if merit is None else merit,
        BestInstances.empty(most, d),
        supply,
    )
    drawn_from = []
    for row, action in zip(rows, actions, strict=True):
        of_row = [None if k < 0 else int(k) for k in listed.state_mappings[row]]
        drawn_from.append((source, InterTaskMapping(of_row, [int(action)], listed.state_signs[row]), 0))
    return supply, drawn_from


def assert_same(supply, row, expected, believe_terminal=True):
    assert supply.count[row] == len(expected)
    for k, (weight, effect, reward, terminated) in enumerate(expected):
        assert supply.weight[row, k] == pytest.approx(weight, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(supply.effect[row, k], effect, atol=1e-12)
        assert supply.reward[row, k] == reward
        assert supply.terminated[row, k] == (terminated and believe_terminal)


@settings(max_examples=60, deadline=None)
@example(2, (1, 2, 1, 1), 1, 0.5, 2.5, 0.5, False)
@given(
    seeds,
    st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.just(1)),
    st.integers(1, 3),
    st.floats(0.05, 0.6),
    st.floats(0.3, 4.0),
    st.sampled_from([0.01, 0.1, 0.5]),
    st.booleans(),
)
def test_nearest_first_until_the_threshold_is_met(seed, sizes, n_mappings, breadth, threshold, min_fraction, believe):
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 60, sizes[0], sizes[2])
    mappings = [naive.random_mapping(rng, *sizes) for _ in range(n_mappings)]
    states, own = rng.random((5, sizes[1])), np.append(0.0, rng.uniform(0.0, 1.2 * threshold, 4))
    task = naive.target_task(states, 1, threshold, float(rng.choice([0.001, 0.01, 0.3])), min_fraction)
    supply, drawn_from = supplied(states, own, mappings, source, task, breadth, believe)
    for row in range(5):
        assert_same(supply, row, naive.transferred(states[row], own[row], drawn_from, task, breadth), believe)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.05, 0.6), st.floats(0.3, 4.0))
def test_with_relevance_the_most_relevant_come_first_and_light_ones_count_too(seed, breadth, threshold):
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 60, 2, 2)
    mappings = [naive.random_mapping(rng, 2, 3, 2, 1) for _ in range(2)]
    states, own = rng.random((4, 3)), rng.uniform(0.0, threshold, 4)
    task = naive.target_task(states, 1, threshold)
    merit = rng.random((2, 60))
    within = naive.places_of(source, stacked_instances([source]))
    supply, drawn_from = supplied(states, own, mappings, source, task, breadth, merit=merit)
    for row in range(4):
        expected = naive.transferred(
            states[row], own[row], drawn_from, task, breadth, lambda place, j: merit[place, within[j]]
        )
        assert_same(supply, row, expected)


def row_of_instances(at, effect=0.1, terminated=False):
    """Instances of the only action of a one-dimensional task."""
    at = np.array(at, dtype=float)[:, None]
    n = len(at)
    return SourceInstances(
        at, np.zeros(n, int), -np.arange(n, dtype=float), at + effect, np.full(n, terminated), np.zeros(1), np.ones(1), 1
    )


ONTO_X = InterTaskMapping([0, None], [0])


def given_to(state, own, source, mapping=ONTO_X, breadth=0.1, **rules):
    task = naive.target_task(np.array([state]), 1, **rules)
    return supplied(np.array([state]), np.array([own]), [mapping], source, task, breadth)[0]


def test_nothing_is_transferred_where_it_would_not_settle_the_pair():
    source = row_of_instances([0.55, 0.45])
    assert given_to([0.5, 0.2], 0.0, source).count[0] == 2
    assert given_to([0.5, 0.2], 0.0, source, threshold=1.6).count[0] == 0
    assert given_to([0.5, 0.2], 0.1, source, threshold=1.6).count[0] == 2, "the own weight counts"
    assert given_to([0.0, 0.2], 0.99, source).count[0] == 0


def test_no_more_is_transferred_than_needed():
    source = row_of_instances([0.5] * 9)
    for own, count in ((0.0, 3), (0.5, 2), (1.0, 2), (2.0, 1), (2.1, 0), (7.0, 0)):
        assert given_to([0.5, 0.2], own, source, threshold=2.1).count[0] == count


def test_the_nearest_comes_first():
    supply = given_to([0.5, 0.2], 0.0, row_of_instances([0.6, 0.52, 0.44, 0.5]), threshold=2.5)
    assert supply.reward[0, : supply.count[0]].tolist() == [-3.0, -1.0, -2.0]


def test_an_instance_that_adds_too_small_a_fraction_ends_the_list():
    source = row_of_instances([0.5] * 4 + [0.7])
    assert given_to([0.5, 0.2], 0.0, source, threshold=4.01, min_fraction=0.001).count[0] == 5
    assert given_to([0.5, 0.2], 0.0, source, threshold=4.01, min_fraction=0.01).count[0] == 0
    assert given_to([0.5, 0.2], 0.0, source, threshold=4.01, min_fraction=0.001, min_weight=0.02).count[0] == 0


def test_unmapped_variables_neither_matter_nor_move_and_mirrored_ones_move_back():
    source = row_of_instances([0.3])
    for y in (0.0, 0.4, 1.0):
        supply = given_to([0.3, y], 0.0, source, threshold=0.99)
        np.testing.assert_allclose(supply.effect[0, 0], [0.1, 0.0], atol=1e-12)
        assert supply.weight[0, 0] == 1.0
        mirrored = given_to([y, 0.7], 0.0, source, InterTaskMapping([None, 0], [0], [1, -1]), threshold=0.99)
        np.testing.assert_allclose(mirrored.effect[0, 0], [0.0, -0.1], atol=1e-12)


@pytest.mark.parametrize("believe", [True, False])
def test_a_terminal_instance_ends_the_target_only_if_believed(believe):
    source = row_of_instances([0.5, 0.5], terminated=True)
    task = naive.target_task(np.array([[0.5, 0.5]]), 1)
    supply, _ = supplied(task.sample_states, np.zeros(1), [ONTO_X], source, task, 0.1, believe)
    assert supply.terminated[0, 0] == believe


@pytest.mark.parametrize("min_fraction", [0.01, 0.1, 0.5])
def test_a_method_has_room_for_all_that_a_pair_may_need(min_fraction):
    """Nearest first, ``min_fraction`` bounds the useful instances; nothing may be lost for lack of room below that."""
    reachable = min(list_room(min_fraction) - 3, 30)
    points = np.array([[0.5]])
    task = naive.target_task(points, 1, threshold=reachable - 0.5, min_fraction=min_fraction)
    method = TIMBREL(row_of_instances([0.5] * 100), InterTaskMapping([0], [0]), breadth=0.1)
    method.bind(task, np.random.default_rng(0))
    supply = method.supply(np.zeros(1, dtype=int), np.zeros(1), np.zeros(1, dtype=bool))
    assert supply.count[0] == reachable
