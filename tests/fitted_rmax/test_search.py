"""A search in which all is known and nothing has been found goes on with a kernel of half the volume."""

import copy

import gymnasium as gym
import numpy as np
import pytest

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.search import Search

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
    return FittedRMax(Haystack(needle), seed=0, model_breadth=0.6, resolution=4, **arguments)


def halvings_and_ends(model, steps=2_000):
    learned = model.learn(steps)
    return learned.agent.search.n_halvings, learned.agent.rewards.n_ended


def test_what_a_broad_kernel_misses_is_found_by_a_narrower_one_which_is_broad_again_then(monkeypatch):
    halvings, ends = halvings_and_ends(searcher())
    assert halvings == 0 and ends > 50
    monkeypatch.setattr(Search, "end_episode", lambda *_: False)
    assert halvings_and_ends(searcher()) == (0, 0), "without it this search finds nothing, and the test tests nothing"


def test_where_there_is_nothing_the_kernel_goes_on_narrowing_and_with_one_of_its_own_it_does_not():
    model = searcher(needle=np.array([5.0, 5.0])).learn(600)
    halvings = model.agent.search.n_halvings
    assert halvings >= 2
    assert model.agent.model.settings.model_breadth == pytest.approx(0.6 * 0.5 ** (halvings / 2))
    average = searcher(needle=np.array([5.0, 5.0]), degree=0).learn(300)
    assert average.agent.search.n_halvings == 0, "the paper's kernel average is what it is"


def test_a_search_that_is_saved_goes_on_as_the_one_that_was_not(tmp_path):
    model = searcher(needle=np.array([5.0, 5.0]))
    while model.agent.search.n_halvings == 0:
        model.learn(17, reset_num_timesteps=False)
    assert not model._last_episode_starts[0]
    model.save(tmp_path / "search")
    loaded = FittedRMax.load(tmp_path / "search", env=copy.deepcopy(model.get_env()), force_reset=False)
    for each in (model, loaded):
        each.learn(200, reset_num_timesteps=False)
    one, other = (each.agent.get_state() for each in (model, loaded))
    assert one.keys() == other.keys() and one["n_halvings"] > 1
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def test_an_episode_that_met_something_unknown_or_began_under_a_broader_kernel_halves_nothing():
    search = Search()
    search.met_unknown = {0, 1}
    assert not search.end_episode(0, goes_on=False) and search.met_unknown == {1}
    assert not search.end_episode(0, goes_on=True) and search.n_halvings == 0
    assert search.end_episode(0, goes_on=False) and search.breadth(0.4, 4) == pytest.approx(0.4 * 0.5**0.25)
    again = Search()
    again.met_unknown = {0, 3}
    again.set_state(search.get_state())
    assert again.n_halvings == 1 and again.met_unknown == set()
