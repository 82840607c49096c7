"""An environment of several oscillators, whose source is one of them, and learning in it."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from helpers import factored as f
from sb3_combrel import FittedRMax


class Oscillators(gym.Env):
    """So many copies of the source at once; an episode ends where all of them end."""

    def __init__(self, n_copies):
        self.mapping = f.copies_mapping(n_copies)
        self.observation_space = gym.spaces.Box(0.0, 1.0, (2 * n_copies,), dtype=np.float64)
        self.action_space = gym.spaces.Discrete(2 * n_copies + 1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = 0.5 + 0.02 * self.np_random.normal(size=2 * len(self.mapping.copies))
        self.steps = 0
        return self.state.copy(), {}

    def step(self, action):
        effect = f.target_effects(self.mapping, self.state[None], np.array([action]))[0]
        self.state = np.clip(self.state + effect, 0.0, 1.0)
        self.steps += 1
        ended = bool(f.ends(self.state.reshape(-1, 2)).all())
        return self.state.copy(), -1.0, ended, not ended and self.steps >= 400, {}


def episodes(transfer, n_copies=1, n=4, seed=0):
    """Learn for ``n`` episodes; return the model and their lengths."""
    model = FittedRMax(Oscillators(n_copies), degree=1, model_breadth=0.2, resolution=3, seed=seed, transfer=transfer)
    model.learn(10**6, callback=StopTrainingOnMaxEpisodes(n))
    return model, [int(episode["l"]) for episode in model.ep_info_buffer]
