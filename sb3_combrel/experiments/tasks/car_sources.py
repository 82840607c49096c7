"""Recordings of the car in two dimensions, made by different means: what is transferred must not depend on who recorded it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_combrel.experiments.tasks.mountain_car import N_INSTANCES, SOURCE_ID
from sb3_combrel.runs.job import make_env
from sb3_combrel.sources.source_instances import SourceInstances

CAP = 2000
# What the sensors of a noisy recording are wrong by, in parts of each variable's range: half of a typical effect.
SENSOR_NOISE = 0.007
NEUTRAL, LEFT, RIGHT = 0, 1, 2


class UniformStates(gym.Wrapper[np.ndarray, int, np.ndarray, int]):
    """Begins each episode in a state drawn uniformly from the bounds, and ends it after one step."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a state; see ``gymnasium.Env.reset``."""
        self.env.reset(seed=seed)
        space = self.env.observation_space
        assert isinstance(space, gym.spaces.Box)
        state = self.unwrapped.np_random.uniform(space.low, space.high)
        return self.env.reset(options={"state": state})

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take the only step of the episode."""
        state, reward, terminated, _, info = self.env.step(action)
        return state, float(reward), terminated, not terminated, info


def _car() -> gym.Env[np.ndarray, int]:
    return make_env(SOURCE_ID, max_episode_steps=CAP)


def controller(seed: int, random_share: float, never_neutral: bool = False) -> Callable[[np.ndarray], int]:
    """Push the way the car moves, as a person would; now and then at random, from all actions or from those to the sides."""
    rng = np.random.default_rng(seed)

    def act(state: np.ndarray) -> int:
        if rng.random() < random_share:
            return int(rng.integers(1 if never_neutral else 0, 3))
        return RIGHT if state[1] >= 0.0 else LEFT

    return act


def q_learning(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """The package's recipe: a sample of all that Q-learning has met."""
    return SourceInstances.from_q_learning(SOURCE_ID, n_instances=n, seed=seed)


def uniform(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """Exact transitions of states and actions drawn uniformly."""
    return SourceInstances.record(None, UniformStates(_car()), n, seed)


def scripted(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """A controller that three times in ten acts at random."""
    return SourceInstances.record(controller(seed, 0.3), _car(), n, seed)


def random_actions(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """Random actions."""
    return SourceInstances.record(None, _car(), n, seed)


def last_policy(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """What Fitted R-Max's policy does after 50 episodes."""
    from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

    from sb3_combrel import FittedRMax

    model = FittedRMax(_car(), seed=seed).learn(10**6, callback=StopTrainingOnMaxEpisodes(50))
    return SourceInstances.record(model, _car(), n, seed, deterministic=True)


def never_neutral(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """A controller that always pushes to one side or the other: the source lacks an action."""
    return SourceInstances.record(controller(seed, 0.3, never_neutral=True), _car(), n, seed)


def noisy(seed: int, n: int = N_INSTANCES) -> SourceInstances:
    """Q-learning's, by sensors that are noisy: every state and successor is."""
    source, rng = q_learning(seed, n), np.random.default_rng(seed)
    low, high = source.scaling.low, source.scaling.high
    size = SENSOR_NOISE * (high - low)
    states, after = (np.clip(x + size * rng.standard_normal(x.shape), low, high) for x in (source.states, source.next_states))
    return replace(source, states=states, next_states=after)


#: By name. Of the first five the best are expected to save most; the last two are flawed.
RECORDINGS: dict[str, Callable[..., SourceInstances]] = {
    "q-learning": q_learning,
    "uniform": uniform,
    "scripted": scripted,
    "random": random_actions,
    "last-policy": last_policy,
    "never-neutral": never_neutral,
    "noisy": noisy,
}
