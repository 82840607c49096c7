"""Source instances for tests, and a task whose transitions can be checked one by one."""

import gymnasium as gym
import numpy as np

from sb3_combrel import SourceInstances


class Corridor(gym.Env):
    """A cart that is pushed along [0, 1]: ends at 1, and is cut off after ``limit`` steps. The second variable counts."""

    observation_space = gym.spaces.Box(np.float32([0, 0]), np.float32([1, 100]), dtype=np.float32)
    action_space = gym.spaces.Discrete(2, start=-1)
    state_names = ("place", "time")
    action_names = ("back", "forth")

    def __init__(self, limit=6, step_size=0.25):
        self.limit = limit
        self.step_size = step_size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.integers(2) * 0.25, 0.0], dtype=np.float32)
        return self.state.copy(), {}

    def step(self, action):
        push = 1 if action == 0 else -1
        self.state = np.array([np.clip(self.state[0] + push * self.step_size, 0, 1), self.state[1] + 1], dtype=np.float32)
        goal = bool(self.state[0] >= 1)
        return self.state.copy(), -0.5 if push > 0 else -1.0, goal, not goal and self.state[1] >= self.limit, {}


def check_corridor(source, step_size=0.25):
    """Every transition, terminal and cut-off ones too, is one of the corridor's."""
    push = np.where(source.actions == 1, 1, -1)
    np.testing.assert_allclose(source.next_states[:, 0], np.clip(source.states[:, 0] + push * step_size, 0, 1), atol=1e-6)
    np.testing.assert_allclose(source.next_states[:, 1], source.states[:, 1] + 1)
    np.testing.assert_array_equal(source.rewards, np.where(push > 0, -0.5, -1.0))
    # VecNormalize gives the last state of an episode normalised only; undoing that is exact up to rounding.
    np.testing.assert_array_equal(source.terminated, source.next_states[:, 0] > 1 - 1e-6)


def some_source(n=40, seed=0):
    rng = np.random.default_rng(seed)
    states, actions, next_states = rng.random((n, 2)), rng.integers(3, size=n), rng.random((n, 2))
    about = 3, ("x", "v"), ("Neutral", "Left", "Right"), {"env": "Some-v0", "seed": seed}
    ends = np.arange(n) % 10 == 9
    return SourceInstances(states, actions, -np.ones(n), next_states, ends, np.zeros(2), np.ones(2), *about)


def assert_same(one, other):
    for name in ("states", "actions", "rewards", "next_states", "terminated", "low", "high"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(one, name).dtype == getattr(other, name).dtype
    assert (one.n_actions, one.state_names, one.action_names) == (other.n_actions, other.state_names, other.action_names)
    assert one.origin == other.origin
