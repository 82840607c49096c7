"""Drawn choices: each candidate in proportion to its mean compliance, the same however often one asks."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.transfer.nearest_transitions import Ballots, find_voters, note_neighbor, vote

N_DRAWS = 4000
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def ballots_of(rng, n_transitions, n_candidates, least=0.4):
    ballots = Ballots.empty(n_candidates + 2, n_transitions)
    ballots.compliance[:] = rng.random(ballots.compliance.shape)
    ballots.least[:] = least
    return ballots


def shares(near, ballots, n_candidates, n_before=5):
    """The part of evenly spread draws that chooses each candidate of the second of two actions; the last entry: none."""
    draws = (np.arange(N_DRAWS) + 0.5) / N_DRAWS
    choice = np.full(2 * N_DRAWS, -7)
    first = np.array([0, n_before, n_before + n_candidates])
    vote(np.arange(N_DRAWS, 2 * N_DRAWS), np.tile(near, (2 * N_DRAWS, 1)), ballots, first, draws, choice)
    assert (choice[:N_DRAWS] == -7).all()
    chosen = np.where(choice[N_DRAWS:] < 0, n_candidates, choice[N_DRAWS:] - n_before)
    return np.bincount(chosen, minlength=n_candidates + 1) / N_DRAWS


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.4, 0.6, 2.0]))
def test_each_candidate_is_drawn_in_proportion_to_its_mean_compliance(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    ballots = ballots_of(rng, 6, n_candidates, least)
    near = rng.permutation(6)[:3]
    near[rng.integers(1, 4) :] = -1
    voters = near[near >= 0]
    means = ballots.compliance[voters, :n_candidates].mean(axis=0)
    enough = np.where(means > least, means, 0.0)
    expected = np.append(enough / enough.sum(), 0.0) if enough.any() else np.eye(n_candidates + 1)[-1]
    np.testing.assert_allclose(shares(near, ballots, n_candidates), expected, atol=1.5 / N_DRAWS)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10**6), st.booleans())
def test_at_a_sample_state_the_vote_is_the_same_as_on_the_grid(seed, drawn):
    rng = np.random.default_rng(seed)
    n_actions, n_candidates, n, first = 2, 4, 20, np.array([0, 4, 8])
    ballots, states, actions = ballots_of(rng, n, n_candidates), rng.random((n, 2)), rng.integers(n_actions, size=n)
    draws = rng.random(n_actions) if drawn else np.empty(0)
    limit = 0.3**2
    near, distance = np.full((n_actions, len(POINTS), 3), -1), np.full((n_actions, len(POINTS), 3), limit)
    due = np.zeros((n_actions, len(POINTS)), dtype=bool)
    for i, action in enumerate(actions):
        note_neighbor(i, states[i], POINTS, near[action], distance[action], due[action])
    np.testing.assert_array_equal(due, near[:, :, 0] >= 0)
    on_grid = np.full(n_actions * len(POINTS), -1)
    of_pairs = np.repeat(draws, len(POINTS)) if drawn else draws
    vote(np.arange(len(on_grid)), near.reshape(-1, 3), ballots, first, of_pairs, on_grid)
    near, distance, choice = np.empty((n_actions, 3), dtype=np.int64), np.empty((n_actions, 3)), np.full(n_actions, -1)
    for p, state in enumerate(POINTS):
        find_voters(state, np.ones(n_actions, dtype=bool), states, actions, n, limit, near, distance)
        vote(np.arange(n_actions), near, ballots, first, draws, choice)
        np.testing.assert_array_equal(choice, on_grid.reshape(n_actions, -1)[:, p])


def test_an_action_that_needs_nothing_has_no_voters():
    near, distance = np.empty((2, 3), dtype=np.int64), np.empty((2, 3))
    states, actions, missing = np.zeros((3, 2)), np.array([0, 1, 1]), np.array([True, False])
    find_voters(np.zeros(2), missing, states, actions, 3, 1.0, near, distance)
    assert near.tolist() == [[0, -1, -1], [-1, -1, -1]]
    choice = np.full(2, 7)
    vote(np.arange(2), near, ballots_of(np.random.default_rng(0), 3, 2, least=0.0), np.array([0, 2, 4]), np.empty(0), choice)
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
        method.renewed(np.zeros(2 * len(POINTS), dtype=bool))
        return method

    def test_the_seed_decides(self):
        one, same, other = self.bound(0), self.bound(0), self.bound(1)
        np.testing.assert_array_equal(one.choices(), same.choices())
        assert (one.choices() != other.choices()).mean() > 0.2

    def test_the_choices_are_more_even_than_the_best_ones(self):
        drawn, best = (self.bound(choice=choice).statistics()["transfer/choice_entropy"] for choice in ("drawn", "best"))
        assert drawn > best + 0.1

    def test_whoever_asks_twice_hears_the_same_and_leaves_no_trace(self):
        method = self.bound()
        chance = method._rng.bit_generator.state
        for state in np.random.default_rng(3).random((10, 2)):
            asked = []
            for _ in range(2):
                method.supply_at(state, np.zeros(2))
                asked.append(method._choice_at.tolist())
            assert asked[0] == asked[1]
        assert method._rng.bit_generator.state == chance

    def test_the_next_transition_draws_anew(self):
        method, seen = self.bound(max_transitions=15), set()
        for _ in range(30):
            method.supply_at(np.full(2, 0.4), np.zeros(2))
            seen.add(tuple(method._choice_at))
            method.observe(np.full(2, 0.5), 0, -1.0, np.full(2, 0.6), False)
        assert len(seen) > 5

    def test_it_is_drawn_or_the_best(self):
        with pytest.raises(ValueError, match='choice must be "best" or "drawn", got \'worst\''):
            COMBREL(naive.random_source(np.random.default_rng(0), 10), choice="worst")
