"""Which source instances are transferred to a pair, and as what, against the equations."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, transferred_at, transferred_to_pairs
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sb3_combrel import TIMBREL
from sb3_combrel.common.kernels import list_room
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.candidates import Candidates, stacked_instances
from sb3_combrel.transfer.instances.translation import Translator

seeds = st.integers(0, 2**32 - 1)


def translated(states, own, mappings, source, task, breadth, transfer_terminals=True, relevance=None, times_weight=False):
    """What the translator gives each state from a pool of all ``mappings``, for target action 0; and what it is drawn from."""
    candidates = Candidates(source, mappings, task)
    arguments = dict(by_relevance=relevance is not None, times_weight=times_weight)
    translator = Translator(candidates, breadth=breadth, transfer_terminals=transfer_terminals, **arguments)
    if relevance is not None:
        translator.relevance[:] = relevance[: len(candidates), : translator.relevance.shape[1]]
    found = translator(states, own, (np.zeros(len(states), dtype=np.int64), np.full(len(states), len(candidates))))
    drawn_from = []
    for row, action in zip(candidates.arrays.row, candidates.arrays.action, strict=True):
        of_row = [None if k < 0 else int(k) for k in candidates.table.variable[row]]
        drawn_from.append((source, InterTaskMapping(of_row, [int(action)], candidates.table.sign[row].astype(int)), 0))
    return found, drawn_from


def assert_same(found, row, expected, transfer_terminals=True):
    assert found.length[row] == len(expected)
    for k, (weight, effect, reward, terminated) in enumerate(expected):
        assert found.weight[row, k] == pytest.approx(weight, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(found.effect[row, k], effect, atol=1e-12)
        assert found.reward[row, k] == reward and found.terminated[row, k] == (terminated and transfer_terminals)


@settings(max_examples=30, deadline=None)
@example(2, (1, 2, 1, 1), 1, 0.5, 2.5, 0.5, False)
@given(
    seeds,
    st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.just(1)),
    st.integers(1, 3),
    st.floats(0.05, 0.6),
    st.floats(0.3, 4.0),
    st.sampled_from([0.05, 0.1, 0.5]),
    st.booleans(),
)
def test_nearest_first_until_the_threshold_is_met(seed, sizes, n_mappings, breadth, threshold, min_fraction, terminals):
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 60, sizes[0], sizes[2])
    mappings = [naive.random_mapping(rng, *sizes) for _ in range(n_mappings)]
    states, own = rng.random((5, sizes[1])), np.append(0.0, rng.uniform(0.0, 1.2 * threshold, 4))
    task = naive.target_task(states, 1, threshold, float(rng.choice([0.001, 0.01, 0.3])), min_fraction)
    found, drawn_from = translated(states, own, mappings, source, task, breadth, terminals)
    for row in range(5):
        assert_same(found, row, naive.transferred(states[row], own[row], drawn_from, task, breadth), terminals)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.05, 0.6), st.floats(0.3, 4.0), st.booleans(), st.booleans())
def test_with_relevance_the_most_relevant_come_first_and_light_ones_count_too(seed, breadth, threshold, times_weight, ties):
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, 60, 2, 2)
    mappings = [naive.random_mapping(rng, 2, 3, 2, 1) for _ in range(2)]
    states, own = rng.random((4, 3)), rng.uniform(0.0, threshold, 4)
    task, relevance = naive.target_task(states, 1, threshold), rng.random((2, 60))
    if ties:
        relevance = np.round(2.0 * relevance) / 2.0
    within = naive.places_of(source, stacked_instances([source]))
    found, drawn_from = translated(
        states, own, mappings, source, task, breadth, relevance=relevance, times_weight=times_weight
    )
    for row in range(4):
        expected = naive.transferred(
            states[row], own[row], drawn_from, task, breadth, lambda place, j: relevance[place, within[j]], times_weight
        )
        if ties:
            # Which of equally relevant ones comes first depends on the order in which they are kept.
            assert (found.length[row] > 0) == (len(expected) > 0)
        else:
            assert_same(found, row, expected)


def test_of_equally_relevant_instances_the_first_comes_first():
    """Whichever is the nearest, of several candidates too."""
    source, task = row_of_instances([0.5] * 40), naive.target_task(np.array([[0.5, 0.5]]), 1, threshold=3.0)
    mappings = [ONTO_X, InterTaskMapping([None, 0], [0])]
    found, _ = translated(task.sample_states, np.zeros(1), mappings, source, task, 0.1, relevance=np.ones((2, 64)))
    assert found.reward[0, :3].tolist() == stacked_instances([source]).reward[0, :3].tolist()
    assert found.effect[0, :3].tolist() == [[pytest.approx(0.1), 0.0]] * 3


def row_of_instances(at, effect=0.1, terminated=False):
    """Instances of the only action of a one-dimensional task."""
    at = np.array(at, dtype=float)[:, None]
    n = len(at)
    return SourceInstances(
        at, np.zeros(n, int), -np.arange(n, dtype=float), at + effect, np.full(n, terminated), np.zeros(1), np.ones(1), 1
    )


ONTO_X = InterTaskMapping([0, None], [0])


@pytest.mark.parametrize("min_fraction", [0.01, 0.1, 0.5])
def test_a_method_has_room_for_all_that_a_pair_may_need(min_fraction):
    """Nearest first, ``min_fraction`` bounds the useful instances; nothing may be lost for lack of room below that."""
    reachable = min(list_room(min_fraction) - 3, 30)
    task = naive.target_task(np.array([[0.5]]), 1, threshold=reachable - 0.5, min_fraction=min_fraction)
    method = TIMBREL(row_of_instances([0.5] * 100), InterTaskMapping([0], [0]), breadth=0.1)
    method.bind(task, np.random.default_rng(0))
    assert transferred_to_pairs(method, np.zeros(1, dtype=int), np.zeros(1)).length[0] == reachable


def test_by_relevance_as_many_light_instances_are_transferred_as_it_takes():
    """Each weighs 0.0183, so 55 of them reach the threshold; by distance the smallest fraction allows no more than ten."""
    points = np.array([[0.5], [0.9]])
    task, source = naive.target_task(points, 1, min_fraction=0.1), row_of_instances([0.5 + 0.2] * 100)
    method = bound(TIMBREL(source, InterTaskMapping([0], [0]), breadth=0.1, relevance=True), task)
    for _ in range(2):
        found = transferred_to_pairs(method, np.arange(2), np.zeros(2))
        assert found.length[:2].tolist() == [55, 55] and found.weight[0, :55].sum() >= 1.0 > found.weight[0, :54].sum()
    assert transferred_at(method, points[0], np.full(1, 0.5)).length[0] == 28
