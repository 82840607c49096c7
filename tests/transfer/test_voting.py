"""Drawn choices: each candidate in proportion to its mean compliance, the same however often one asks."""

import naive_transfer as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.transfer.voting import Ballots, choose_at, note_neighbor, vote

N_DRAWS = 4000
POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def ballots_of(rng, n_transitions, n_candidates, least=0.4):
    ballots = Ballots.empty(n_candidates + 2, n_transitions)
    ballots.compliance[:] = rng.random(ballots.compliance.shape)
    ballots.least[:] = least
    return ballots


def shares(near, ballots, n_candidates, first=5):
    """The part of evenly spread draws that chooses each candidate; the last entry: none."""
    draws = (np.arange(N_DRAWS) + 0.5) / N_DRAWS
    choice = np.full(N_DRAWS, -7)
    vote(np.arange(N_DRAWS), np.tile(near, (N_DRAWS, 1)), ballots, first, first + n_candidates, draws, choice)
    chosen = np.where(choice < 0, n_candidates, choice - first)
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
    on_grid = np.full((n_actions, len(POINTS)), -1)
    for action in range(n_actions):
        near, distance = np.full((len(POINTS), 3), -1), np.full((len(POINTS), 3), limit)
        for i in np.flatnonzero(actions == action):
            note_neighbor(i, states[i], POINTS, near, distance, np.empty(len(POINTS), dtype=np.int64))
        of_points = np.repeat(draws[action], len(POINTS)) if drawn else draws
        points = np.arange(len(POINTS))
        vote(points, near, ballots, first[action], first[action + 1], of_points, on_grid[action])
    near, distance, choice = np.empty(3, dtype=np.int64), np.empty(3), np.empty(n_actions, dtype=np.int64)
    for p, state in enumerate(POINTS):
        missing = np.ones(n_actions, dtype=bool)
        choose_at(state, missing, states, actions, n, ballots, first, limit, near, distance, draws, choice)
        np.testing.assert_array_equal(choice, on_grid[:, p])


def test_an_action_that_needs_nothing_gets_nothing():
    ballots, choice = ballots_of(np.random.default_rng(0), 3, 2, least=0.0), np.empty(2, dtype=np.int64)
    scratch = np.empty(3, dtype=np.int64), np.empty(3)
    states, actions, first = np.zeros((3, 2)), np.array([0, 1, 1]), np.array([0, 2, 4])
    choose_at(np.zeros(2), np.array([True, False]), states, actions, 3, ballots, first, 1.0, *scratch, np.empty(0), choice)
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
