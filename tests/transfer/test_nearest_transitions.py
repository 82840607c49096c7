"""Drawn choices: each candidate in proportion to its mean compliance, the same however often one asks."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import changed_pairs
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.transfer.nearest_transitions import ComplianceCache, add_to_sample, choose, find_nearest

N_DRAWS = 4000
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def random_cache(rng, n_transitions, n_candidates, least=0.4):
    cache = ComplianceCache.empty(n_candidates + 2, n_transitions)
    cache.compliance[:] = rng.random(cache.compliance.shape)
    cache.required[:] = least
    return cache


def shares(near, cache, n_candidates, n_before=5):
    """The fraction of evenly spread draws that chooses each candidate of the second of two actions; the last entry: none."""
    draws = (np.arange(N_DRAWS) + 0.5) / N_DRAWS
    choice = np.full(2 * N_DRAWS, -7)
    first = np.array([0, n_before, n_before + n_candidates])
    actions = np.ones(N_DRAWS, dtype=np.int64)
    choose(np.arange(N_DRAWS, 2 * N_DRAWS), actions, np.tile(near, (2 * N_DRAWS, 1)), cache, first, draws, choice)
    assert (choice[:N_DRAWS] == -7).all()
    chosen = np.where(choice[N_DRAWS:] < 0, n_candidates, choice[N_DRAWS:] - n_before)
    return np.bincount(chosen, minlength=n_candidates + 1) / N_DRAWS


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.4, 0.6, 2.0]))
def test_each_candidate_is_drawn_in_proportion_to_its_mean_compliance(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    cache = random_cache(rng, 6, n_candidates, least)
    near = rng.permutation(6)[:3]
    near[rng.integers(1, 4) :] = -1
    neighbors = near[near >= 0]
    means = cache.compliance[neighbors, :n_candidates].mean(axis=0)
    enough = np.where(means > least, means, 0.0)
    expected = np.append(enough / enough.sum(), 0.0) if enough.any() else np.eye(n_candidates + 1)[-1]
    np.testing.assert_allclose(shares(near, cache, n_candidates), expected, atol=1.5 / N_DRAWS)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10**6), st.booleans())
def test_at_a_sample_state_the_choice_is_the_same_as_on_the_grid(seed, drawn):
    rng = np.random.default_rng(seed)
    n_actions, n_candidates, n, first = 2, 4, 20, np.array([0, 4, 8])
    cache, states, actions = random_cache(rng, n, n_candidates), rng.random((n, 2)), rng.integers(n_actions, size=n)
    draws = rng.random(n_actions) if drawn else np.empty(0)
    limit = 0.3**2
    near, distance = np.full((n_actions, len(POINTS), 3), -1), np.full((n_actions, len(POINTS), 3), limit)
    due = np.zeros((n_actions, len(POINTS)), dtype=bool)
    for i, action in enumerate(actions):
        add_to_sample(i, states[i], POINTS, near[action], distance[action], due[action])
    np.testing.assert_array_equal(due, near[:, :, 0] >= 0)
    on_grid, each = np.full(n_actions * len(POINTS), -1), np.repeat(np.arange(n_actions), len(POINTS))
    of_pairs = draws[each] if drawn else draws
    choose(np.arange(len(on_grid)), each, near.reshape(-1, 3), cache, first, of_pairs, on_grid)
    listed, n_listed = by_action(actions, n_actions)
    near, distance, choice = np.empty((n_actions, 3), dtype=np.int64), np.empty((n_actions, 3)), np.full(n_actions, -1)
    for p, state in enumerate(POINTS):
        asked = np.tile(state, (n_actions, 1)), np.arange(n_actions), np.zeros(n_actions)
        find_nearest(*asked, 1.0, states, listed, n_listed, limit, near, distance)
        choose(np.arange(n_actions), np.arange(n_actions), near, cache, first, draws, choice)
        np.testing.assert_array_equal(choice, on_grid.reshape(n_actions, -1)[:, p])


def by_action(actions, n_actions):
    """The transitions of each action, as the selector lists them."""
    listed = np.zeros((n_actions, len(actions)), dtype=np.int64)
    for action in range(n_actions):
        rows = np.flatnonzero(actions == action)
        listed[action, : len(rows)] = rows
    return listed, np.bincount(actions, minlength=n_actions)


def test_an_action_that_needs_nothing_has_no_neighbors():
    near, distance = np.empty((2, 3), dtype=np.int64), np.empty((2, 3))
    own_weight, asked = np.array([0.9, 1.0]), np.arange(2)
    listed = by_action(np.array([0, 1, 1]), 2)
    find_nearest(np.zeros((2, 2)), asked, own_weight, 1.0, np.zeros((3, 2)), *listed, 1.0, near, distance)
    assert near.tolist() == [[0, -1, -1], [-1, -1, -1]]
    choice, cache = np.full(2, 7), random_cache(np.random.default_rng(0), 3, 2, least=0.0)
    choose(np.arange(2), asked, near, cache, np.array([0, 2, 4]), np.empty(0), choice)
    assert choice[0] in (0, 1) and choice[1] == -1


class TestMethod:
    def bound(self, seed=0, choice="drawn", **kwargs):
        rng = np.random.default_rng(1)
        task = naive.target_task(POINTS, 2)
        method = COMBREL(naive.random_source(rng, 100, 2, 2), choice=choice, min_compliance=0.0, **kwargs)
        method.bind(task, np.random.default_rng(seed))
        for _ in range(15):
            t = naive.random_transition(rng, 2, 2)
            method.observe(t.state, t.action, t.reward, t.next_state, False)
        changed_pairs(method)
        return method

    def test_the_seed_decides(self):
        one, same, other = self.bound(0), self.bound(0), self.bound(1)
        np.testing.assert_array_equal(one.choices(), same.choices())
        assert (one.choices() != other.choices()).mean() > 0.2

    def test_the_choices_are_more_even_than_the_best_ones(self):
        drawn, best = (self.bound(choice=choice).statistics()["transfer/choice_entropy"] for choice in ("drawn", "best"))
        assert drawn > best + 0.1

    def selected(self, method, state):
        """The first candidates of the range selected for each action."""
        return method._selector.select(np.tile(state, (2, 1)), np.arange(2), np.zeros(2))[0].tolist()

    def test_to_ask_leaves_no_trace(self):
        method = self.bound()
        before = method.rng.bit_generator.state, {name: array.copy() for name, array in method.get_state().items()}
        for state in np.random.default_rng(3).random((10, 2)):
            assert self.selected(method, state) == self.selected(method, state)
        assert method.rng.bit_generator.state == before[0]
        for name, array in method.get_state().items():
            np.testing.assert_array_equal(array, before[1][name])

    def test_each_transition_draws_again(self):
        method, seen = self.bound(max_transitions=15), set()
        for _ in range(30):
            seen.add(tuple(self.selected(method, np.full(2, 0.4))))
            method.observe(np.full(2, 0.5), 0, -1.0, np.full(2, 0.6), False)
        assert len(seen) > 5

    def test_it_is_drawn_or_the_best(self):
        with pytest.raises(ValueError, match='choice must be "best" or "drawn", got \'worst\''):
            COMBREL(naive.random_source(np.random.default_rng(0), 10), choice="worst")
