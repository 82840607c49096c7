"""As long as nothing has been found, each visit to a place makes it less worth going there."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_combrel import FittedRMax
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.fitted_rmax import agent as agents
from sb3_combrel.fitted_rmax.optimism import worth_after_visits
from tests.helpers.own_method import Mine

LIMIT, NEEDLE, RADIUS = 60, np.array([0.5, 0.55]), 0.03


class Haystack(gym.Env):
    """Moves of about a twentieth in a square, each at a cost of 1, until a small place is met; or, without one, for ever."""

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), dtype=np.float64)
    action_space = gym.spaces.Discrete(4)

    def __init__(self, needle=NEEDLE):
        self.needle = needle

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.n = np.array([0.1, 0.1]), 0
        return self.state, {}

    def step(self, action):
        move = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]][action]) * 0.05 + self.np_random.normal(0.0, 0.005, 2)
        self.state, self.n = np.clip(self.state + move, 0.0, 1.0), self.n + 1
        found = bool(np.linalg.norm(self.state - self.needle) < RADIUS)
        return self.state, -1.0, found, self.n >= LIMIT and not found, {}


def searcher(needle=NEEDLE, **arguments):
    return FittedRMax(Haystack(needle), **dict(seed=0) | arguments)


NOWHERE = np.array([5.0, 5.0])


@given(
    st.lists(st.tuples(st.floats(-50.0, 50.0), st.integers(0, 40)), min_size=1, max_size=5),
    st.sampled_from([-1.0, -0.3, 0.0, 2.0]),
    st.sampled_from([1.0, 0.99, 0.5]),
)
def test_worth_is_that_of_a_place_so_many_steps_further_away(places, reward, gamma):
    expected = []
    for worth, visits in places:
        for _ in range(visits):
            worth = reward + gamma * worth
        expected.append(worth)
    worth, visits = np.array(places, dtype=float).T
    np.testing.assert_allclose(worth_after_visits(worth, visits, reward, gamma), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_what_is_smaller_than_the_kernel_is_found(seed, monkeypatch):
    found = searcher(seed=seed).learn(2_000).agent
    assert found.rewards.n_ended > 10
    assert found.planner.worth is found.planner.upper, "once something is found, R-Max's optimism is as it was"
    monkeypatch.setattr(agents, "worth_after_visits", lambda worth, *_: worth)
    assert searcher(seed=seed).learn(2_000).agent.rewards.n_ended == 0, "found without it too: the test tests nothing"


def test_all_places_are_visited_again_and_again_where_there_is_nothing():
    model = searcher(needle=NOWHERE).learn(1_500)
    visits = model.agent.model.own_weight.reshape(4, -1).sum(axis=0)
    assert visits.min() > 0.2 * visits.mean()
    expected = np.maximum(worth_after_visits(model.agent.planner.upper, visits, -1.0, 0.99), model.agent.planner.bounds[0])
    np.testing.assert_array_equal(model.agent.planner.worth, expected)
    assert (model.agent.planner.values >= expected - 1e-6).all()


def test_the_papers_kernel_average_is_what_it_is():
    average = searcher(needle=NOWHERE, degree=0).learn(300).agent
    assert average.planner.worth is average.planner.upper


class Later(Mine):
    """Transfers nothing before it has observed so many transitions, as a method does that first has to find a mapping."""

    def __init__(self, first=10**6):
        super().__init__()
        self.first, self.n = first, 0

    def observe(self, *transition):
        super().observe(*transition)
        self.n += 1

    def transferred(self, states, actions, own_weight):
        if self.n < self.first:
            return TransferredInstances.empty(len(actions), states.shape[1])
        return super().transferred(states, actions, own_weight)


class SilentPrior(Later):
    """A prior that says nothing."""

    use = "prior"

    def prior(self, states, actions):
        return PriorPredictions.nothing(*states.shape)


@pytest.mark.parametrize(("degree", "nothing"), [(0, Later), (1, Later), (1, SilentPrior)])
def test_a_method_that_transfers_nothing_changes_nothing(degree, nothing):
    alone, beside = (searcher(NOWHERE, degree=degree, transfer=each).learn(300).agent for each in (None, nothing()))
    assert (alone.planner.worth is alone.planner.upper) == (degree == 0)
    for one, other in zip(alone.model.transitions(), beside.model.transitions(), strict=True):
        np.testing.assert_array_equal(np.hstack(one), np.hstack(other))
    np.testing.assert_allclose(alone.planner.values, beside.planner.values, rtol=1e-9)


def test_the_search_ends_where_instances_are_transferred():
    model = searcher(NOWHERE, transfer=Later(100)).learn(99)
    assert model.agent.planner.worth is not model.agent.planner.upper
    agent = model.learn(2, reset_num_timesteps=False).agent
    assert agent.planner.worth is agent.planner.upper and not agent.rewards.differ


def test_a_search_that_is_saved_goes_on_as_the_one_that_was_not(tmp_path):
    model = searcher(needle=NOWHERE).learn(217)
    assert not model._last_episode_starts[0]
    model.save(tmp_path / "search")
    loaded = FittedRMax.load(tmp_path / "search", env=copy.deepcopy(model.get_env()), force_reset=False)
    np.testing.assert_array_equal(loaded.agent.planner.worth, model.agent.planner.worth)
    for each in (model, loaded):
        each.learn(200, reset_num_timesteps=False)
    one, other = (each.agent.get_state() for each in (model, loaded))
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)
