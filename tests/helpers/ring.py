"""A task with an angle, whose origin can be anywhere: what is learned must not depend on where."""

import gymnasium as gym
import numpy as np

PERIODIC = [True, False]


class Ring(gym.Env):
    """A mass on a ring, pushed either way; the goal is on the other side of the ring, at angle pi.

    :param origin: added to the angle that is observed, in periods
    """

    state_names = ("angle", "speed")
    action_names = ("back", "forth")

    def __init__(self, origin=0.0):
        self.observation_space = gym.spaces.Box(np.array([-np.pi, -1.0]), np.array([np.pi, 1.0]), dtype=np.float64)
        self.action_space = gym.spaces.Discrete(2)
        self.origin = origin

    def observe(self):
        return np.array([2.0 * np.pi * (((self.at + self.origin + 0.5) % 1.0) - 0.5), self.speed])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.speed, self.steps = 0.03, 0.0, 0
        return self.observe(), {}

    def step(self, action):
        self.speed = float(np.clip(self.speed + (0.15 if action == 1 else -0.15), -1.0, 1.0))
        self.at = (self.at + 0.05 * self.speed) % 1.0
        self.steps += 1
        done = abs(self.at - 0.5) < 0.04
        return self.observe(), -1.0, done, self.steps >= 200 and not done, {}


def ring_transitions(seed, n):
    """Random transitions of a periodic and another variable, unit coordinates, many of them across the origin."""
    rng, transitions = np.random.default_rng(seed), []
    for _ in range(n):
        state, action = rng.random(2), int(rng.integers(2))
        effect = rng.normal([0.08 if action else -0.08, 0.0], 0.04)
        after = np.array([(state[0] + effect[0]) % 1.0, np.clip(state[1] + effect[1], 0.0, 1.0)])
        transitions.append((state, action, -1.0, after, bool(abs(after[0] - 0.5) < 0.05)))
    return transitions


def shifted(states, cells, n_cells):
    """States whose periodic variable is moved by some cells of a grid."""
    moved = np.array(states, dtype=float)
    moved[..., 0] = (moved[..., 0] + cells / n_cells) % 1.0
    return moved
