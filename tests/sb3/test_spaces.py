"""Spaces that work; those that do not are refused in tests/fitted_rmax/test_bad_input.py."""

import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from helpers.walk import OBSERVATIONS, Walk, small

from sb3_combrel import FittedRMax


class Anywhere(gym.Env):
    """Every step leads somewhere in the space."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), -1.0, False, bool(self.np_random.random() < 0.1), {}


SPACES = {
    "float32": spaces.Box(-2.0, 1.0, (2,), dtype=np.float32),
    "float64": spaces.Box(-2.0, 1.0, (2,), dtype=np.float64),
    "one variable": spaces.Box(0.0, 5.0, (1,)),
    "three variables of other sizes": spaces.Box(np.float32([0, -1, 5]), np.float32([1, 1, 500])),
}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("actions", [spaces.Discrete(1), spaces.Discrete(3), spaces.Discrete(4, start=-2)], ids=str)
def test_learning_predicting_and_saving_with_every_space(space, actions, tmp_path):
    model = FittedRMax(Anywhere(space, actions), resolution=2, model_breadth=0.3, seed=0).learn(40)
    assert model.agent.model.n_instances == 40
    states = np.stack([space.sample() for _ in range(10)])
    chosen, _ = model.predict(states, deterministic=True)
    assert all(actions.contains(np.int64(action)) for action in chosen)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Anywhere(space, actions))
    assert (loaded.observation_space, loaded.action_space) == (space, actions)
    np.testing.assert_array_equal(loaded.predict(states, deterministic=True)[0], chosen)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_observations_that_are_whole_numbers_are_refused(dtype):
    with pytest.raises(ValueError, match=f"floating-point numbers, got dtype {dtype.__name__}"):
        FittedRMax(Anywhere(spaces.Box(0, 9, (2,), dtype=dtype), spaces.Discrete(2)))


@pytest.mark.parametrize(
    ("actions", "n_discrete"),
    [(spaces.Box(-2.0, 2.0, (1,)), 5), (spaces.Box(-2.0, 2.0, (2,)), 9)],
    ids=str,
)
def test_continuous_actions_are_refused_with_the_line_that_makes_them_discrete(actions, n_discrete):
    env = Anywhere(SPACES["float32"], actions)
    with pytest.raises(ValueError, match="needs Discrete actions, the environment has Box") as caught:
        FittedRMax(env)
    [line] = re.findall(r"env = (gymnasium\.wrappers\..*)$", str(caught.value))
    env = eval(line, {"gymnasium": gym, "env": env})
    model = FittedRMax(env, resolution=2, model_breadth=0.3, seed=0).learn(30)
    assert model.action_space == spaces.Discrete(n_discrete)


@pytest.mark.parametrize(
    "actions", [spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2), spaces.Box(0.0, 1.0, (2, 2))], ids=str
)
def test_other_actions_are_refused(actions):
    with pytest.raises(ValueError, match="needs Discrete actions, the environment has") as caught:
        FittedRMax(Anywhere(SPACES["float32"], actions))
    assert "DiscretizeAction" not in str(caught.value)


def test_actions_may_start_anywhere(make):
    model = make(Walk(first=5)).learn(60)
    for observation in OBSERVATIONS:
        action, _ = model.predict(observation, deterministic=True)
        assert model.action_space.contains(int(action))
    assert model.agent.model.instances.size.sum() == 60


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        (([-1.0], [1.0]), "2"),
        (([-1.0, 0.0, 0.0], [1.0, 2.0, 1.0]), "2"),
        (([-1.0, 0.0], [1.0]), "2"),
        (([-1.0, 0.0],), "low, high"),
        (([-1.0, 0.0], [1.0, 2.0], [3.0, 4.0]), "low, high"),
    ],
)
def test_bounds_of_the_wrong_length_are_refused_with_the_right_one(bounds, expected):
    with pytest.raises(ValueError, match="bounds") as error:
        small(bounds=bounds)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
