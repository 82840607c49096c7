"""The episodes of a run: recorded while an agent learns, and played without exploration."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

#: Evaluation episodes begin with this seed plus the run's: no run has learnt with it.
EVALUATION_SEED = 1_000_000


class Episodes(NamedTuple):
    """Episodes that have ended, one entry each."""

    steps: np.ndarray  # environment steps, int64, shape (n_episodes,)
    returns: np.ndarray  # undiscounted sums of rewards, shape (n_episodes,)
    terminated: np.ndarray  # bool, whether a terminal state ended it; False for a time limit, shape (n_episodes,)

    @classmethod
    def from_rows(cls, rows: list[tuple[int, float, bool]]) -> Episodes:
        """Make them from (steps, return, terminated) of each episode."""
        steps, returns, terminated = zip(*rows, strict=True) if rows else ((), (), ())
        return cls(np.array(steps, dtype=np.int64), np.array(returns, dtype=np.float64), np.array(terminated, dtype=bool))

    def last(self, n: int) -> Episodes:
        """The last ``n`` of them, or all if there are fewer."""
        start = max(len(self.steps) - n, 0)
        return Episodes(*(column[start:] for column in self))


class EpisodeRecorder(BaseCallback):
    """Keeps steps, return and end of every episode, and stops the learning after ``n_episodes``, or never."""

    def __init__(self, n_episodes: int | None = None):
        super().__init__()
        self.n_episodes = n_episodes
        self._rows: list[tuple[int, float, bool]] = []

    @property
    def episodes(self) -> Episodes:
        """The episodes that have ended."""
        return Episodes.from_rows(self._rows)

    def _on_step(self) -> bool:
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                terminated = not info.get("TimeLimit.truncated", False)
                self._rows.append((int(info["episode"]["l"]), float(info["episode"]["r"]), terminated))
        return self.n_episodes is None or len(self._rows) < self.n_episodes


def play(model: Any, env: gym.Env, n_episodes: int, seed: int) -> Episodes:
    """Play episodes without exploration."""
    rows = []
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=seed if episode == 0 else None)
        steps, total, terminated, truncated = 0, 0.0, False, False
        while not (terminated or truncated):
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(int(action) if np.ndim(action) == 0 else action)
            steps, total = steps + 1, total + float(reward)
        rows.append((steps, total, bool(terminated)))
    return Episodes.from_rows(rows)
