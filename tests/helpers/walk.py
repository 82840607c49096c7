"""A small task, a source for it, and what the tests of this folder look at."""

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances

STRIDE = 0.15
GOAL = 0.9


class Walk(gym.Env):
    """A walk on a line to its right end; ``first``: number of the first action; ``start``: None for anywhere at the left."""

    def __init__(self, first=0, limit=30, start=None):
        self.observation_space = gym.spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 2.0]))
        self.action_space = gym.spaces.Discrete(2, start=first)
        self.first, self.limit, self.start = first, limit, start

    def observe(self):
        return np.array([self.at, 1.0], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = self.np_random.uniform(-0.6, 0.0) if self.start is None else self.start, 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.at = float(np.clip(self.at + (STRIDE if action == self.first + 1 else -STRIDE), -1.0, 1.0))
        done = self.at > GOAL
        return self.observe(), -1.0, done, self.steps >= self.limit and not done, {}


def walk_source(n=60):
    """Instances of the walk itself, evenly spread."""
    at, action = np.linspace(-1.0, 0.89, n), np.arange(n) % 2
    after = np.clip(at + STRIDE * (2 * action - 1), -1.0, 1.0)
    states, next_states = np.column_stack([at, np.ones(n)]), np.column_stack([after, np.ones(n)])
    return SourceInstances(states, action, np.full(n, -1.0), next_states, after > GOAL, [-1.0, 0.0], [1.0, 2.0], 2)


METHODS = {
    "none": lambda: None,
    "TIMBREL": lambda: TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1])),
    "COMBREL": lambda: COMBREL(walk_source(), use="instances"),
}


def small(env=None, **kwargs):
    return FittedRMax(Walk() if env is None else env, **dict(model_breadth=0.15, resolution=3, seed=0) | kwargs)


OBSERVATIONS = np.column_stack([np.linspace(-1.0, 1.0, 21), np.ones(21)]).astype(np.float32)


def same_parameters(one, other):
    one, other = one.get_parameters()["policy"], other.get_parameters()["policy"]
    return one.keys() == other.keys() and all(th.equal(one[k], other[k]) for k in one)


def learnt_on(model, folder, n_steps):
    """A model that is saved, and the one loaded from its file, both after so many steps more."""
    model.save(folder / "model")
    loaded = FittedRMax.load(folder / "model", env=Walk())
    model.set_env(Walk())
    # Loading has seeded the environment again.
    model.get_env().seed(model.seed)
    for goes_on in (model, loaded):
        goes_on.learn(n_steps, reset_num_timesteps=False)
    return model, loaded


def stored(model):
    """(state, next state, reward, terminated) of all instances, raw units, by action."""
    instances, rows = model.agent.model.instances, []
    for action in range(2):
        n = instances.size[action]
        state, end = instances.state[action, :n], instances.state[action, :n] + instances.effect[action, :n]
        raw = model.policy.scales.scaling.to_raw(state), model.policy.scales.scaling.to_raw(end)
        rows.append(np.column_stack([*raw, instances.reward[action, :n], instances.terminated[action, :n]]))
    return np.vstack(rows)


class Recorder(BaseCallback):
    """Keeps what the callback is shown; stops or interrupts at a given call."""

    def __init__(self, stop_at=None, interrupt_at=None):
        super().__init__()
        self.stop_at, self.interrupt_at = stop_at, interrupt_at
        self.started = self.ended = 0
        self.shown = []

    def _on_training_start(self):
        self.started += 1

    def _on_step(self):
        self.shown.append({k: self.locals[k] for k in ("new_obs", "actions", "rewards", "dones", "infos")})
        if self.n_calls == self.interrupt_at:
            raise KeyboardInterrupt
        return self.n_calls != self.stop_at

    def _on_training_end(self):
        self.ended += 1
