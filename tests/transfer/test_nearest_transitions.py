"""Drawn choices: each candidate in proportion to its mean compliance, the same however often one asks."""

import numpy as np
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, show
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.instances.nearest_transitions import ComplianceCache, add_to_sample, choose, select

N_DRAWS = 4000
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
NOT_PERIODIC = np.zeros(2, dtype=bool)


def random_cache(rng, n_transitions, n_candidates, least=0.4):
    cache = ComplianceCache.empty(n_candidates + 2, n_transitions)
    cache.compliance[:] = rng.random(cache.compliance.shape)
    cache.required[:] = least
    cache.measured[:] = True
    return cache


def shares(near, cache, n_candidates, n_before=5):
    """The fraction of evenly spread draws that chooses each candidate of the second of two actions; the last entry: none."""
    draws = (np.arange(N_DRAWS) + 0.5) / N_DRAWS
    choice = np.full(2 * N_DRAWS, -7)
    first = np.array([0, n_before, n_before + n_candidates])
    actions = np.ones(N_DRAWS, dtype=np.int64)
    rows, each_near = np.arange(N_DRAWS, 2 * N_DRAWS), np.tile(near, (2 * N_DRAWS, 1))
    choose(rows, actions, each_near, tuple(cache), first, draws, choice)
    assert (choice[:N_DRAWS] == -7).all()
    chosen = np.where(choice[N_DRAWS:] < 0, n_candidates, choice[N_DRAWS:] - n_before)
    return np.bincount(chosen, minlength=n_candidates + 1) / N_DRAWS


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.4, 0.6, 2.0]))
def test_each_candidate_is_drawn_in_proportion_to_its_mean_compliance(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    cache = random_cache(rng, 6, n_candidates, least)
    near = rng.permutation(6)[:3]
    near[rng.integers(1, 4) :] = -1
    means = cache.compliance[near[near >= 0], :n_candidates].mean(axis=0)
    enough = np.where(means > least, means, 0.0)
    expected = np.append(enough / enough.sum(), 0.0) if enough.any() else np.eye(n_candidates + 1)[-1]
    np.testing.assert_allclose(shares(near, cache, n_candidates), expected, atol=1.5 / N_DRAWS)


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from([(False, False), (True, False), (True, True)]))
def test_at_a_sample_state_the_choice_is_the_same_as_on_the_grid(seed, drawn, periodic):
    rng = np.random.default_rng(seed)
    n_actions, n_candidates, n, first = 2, 4, 20, np.array([0, 4, 8])
    cache, states, actions = random_cache(rng, n, n_candidates), rng.random((n, 2)), rng.integers(n_actions, size=n)
    draws = rng.random(n_actions) if drawn else np.empty(0)
    limit = 0.3**2
    near, distance = np.full((n_actions, len(POINTS), 3), -1), np.full((n_actions, len(POINTS), 3), limit)
    due = np.zeros((n_actions, len(POINTS)), dtype=bool)
    sample = np.ascontiguousarray(POINTS.T), np.array(periodic)
    for i, action in enumerate(actions):
        add_to_sample(i, states[i], sample, near[action], distance[action], due[action], np.empty(len(POINTS)))
    np.testing.assert_array_equal(due, near[:, :, 0] >= 0)
    on_grid, each = np.full(n_actions * len(POINTS), -1), np.repeat(np.arange(n_actions), len(POINTS))
    of_pairs = draws[each] if drawn else draws
    choose(np.arange(len(on_grid)), each, near.reshape(-1, 3), tuple(cache), first, of_pairs, on_grid)
    recorded = states, *by_action(actions, n_actions), np.array(periodic)
    for p, state in enumerate(POINTS):
        asked = np.tile(state, (n_actions, 1)), np.arange(n_actions), np.zeros(n_actions)
        found = room_for(n_actions)
        assert select(asked, recorded, (1.0, limit), tuple(cache), first, draws, found)
        np.testing.assert_array_equal(found[0], near[:, p])
        np.testing.assert_array_equal(np.sort(found[0], axis=1), nearest(state, states, actions, periodic, limit))
        np.testing.assert_array_equal(candidates_of(found), on_grid.reshape(n_actions, -1)[:, p])


def nearest(state, states, actions, periodic, limit):
    """The three nearest transitions of each action, one by one, in the order of their numbers; -1 for none."""
    rows = []
    for action in range(2):
        near = []
        for i in np.flatnonzero(actions == action):
            apart = np.abs(states[i] - state)
            apart = [min(a, 1.0 - a) if wraps else a for a, wraps in zip(apart, periodic, strict=True)]
            near.append((sum(a * a for a in apart), i))
        kept = [i for distance, i in sorted(near)[:3] if distance < limit]
        rows.append([-1] * (3 - len(kept)) + sorted(kept))
    return rows


def room_for(n, k=3):
    """Arrays that receive what is found at exact states: nearest transitions, distances, ranges of candidates."""
    return np.empty((n, k), dtype=np.int64), np.empty((n, k)), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)


def candidates_of(found):
    """The candidate selected for each state, -1 for none."""
    _, _, first, last = found
    assert np.isin(last - first, [0, 1]).all()
    return np.where(first < last, first, -1)


def by_action(actions, n_actions):
    """The transitions of each action, as the selector lists them."""
    listed = np.zeros((n_actions, len(actions)), dtype=np.int64)
    for action in range(n_actions):
        rows = np.flatnonzero(actions == action)
        listed[action, : len(rows)] = rows
    return listed, np.bincount(actions, minlength=n_actions)


def test_nothing_is_selected_before_all_neighbors_have_been_measured():
    query = np.zeros((2, 2)), np.arange(2), np.zeros(2)
    recorded = np.zeros((3, 2)), *by_action(np.array([0, 1, 1]), 2), NOT_PERIODIC
    found, cache = room_for(2), random_cache(np.random.default_rng(0), 3, 2, least=0.0)
    found[2][:], found[3][:] = 7, 7
    for i, complete in ((2, False), (0, True)):
        cache.measured[:] = [True, True, i != 2]
        assert select(query, recorded, (1.0, 1.0), tuple(cache), np.array([0, 2, 4]), np.empty(0), found) == complete
        assert found[0].tolist() == [[0, -1, -1], [1, 2, -1]], "what is to be measured"
        assert (found[2] == 7).all() != complete


@settings(deadline=None, derandomize=True, max_examples=25)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.375, 0.625, 2.0]))
def test_the_best_candidate_is_the_best_mapping_of_algorithm_1(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    cache, sample = random_cache(rng, 20, n_candidates, least), rng.random((20, 2))
    actions, k = rng.integers(2, size=20), int(rng.integers(1, 6))
    # Some equal, some 0: of equal ones the first is chosen, and a mapping without any evidence is not. Sums are exact.
    cache.compliance[:] = np.round(8.0 * cache.compliance) / 8.0
    transitions = equations.Transitions(sample, actions, np.zeros((20, 2)), np.zeros(20), np.zeros(20, dtype=bool))
    query, first = (rng.random((8, 2)), np.tile(np.arange(2), 4), np.zeros(8)), np.array([0, n_candidates, 2 * n_candidates])
    found, recorded = room_for(8, k), (sample, *by_action(actions, 2), NOT_PERIODIC)
    assert select(query, recorded, (1.0, np.inf), tuple(cache), first, np.empty(0), found)
    for state, action, chosen in zip(query[0], query[1], candidates_of(found), strict=True):
        near = equations.nearest_transitions(state, action, transitions, k)
        best = equations.best_mapping(cache.compliance[near, :n_candidates], least)
        assert chosen == (-1 if best is None else first[action] + best)


def test_to_ask_leaves_no_trace():
    rng = np.random.default_rng(1)
    method = COMBREL(naive.random_source(rng, 100, 2, 2), choice="drawn", min_compliance=0.0)
    bound(method, naive.target_task(POINTS, 2))
    for _ in range(15):
        show(method, naive.random_transition(rng, 2, 2))
    changed_pairs(method)
    before = method.rng.bit_generator.state, {name: array.copy() for name, array in method.get_state().items()}
    for state in np.random.default_rng(3).random((10, 2)):
        asked = np.tile(state, (2, 1)), np.arange(2)
        assert method.selected(*asked).tolist() == method.selected(*asked).tolist()
    assert method.rng.bit_generator.state == before[0]
    for name, array in method.get_state().items():
        np.testing.assert_array_equal(array, before[1][name])
