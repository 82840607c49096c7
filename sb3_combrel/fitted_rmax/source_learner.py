"""Fitted R-Max as a learner of source tasks, and its saved models as sources."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.sources.experience import READERS
from sb3_combrel.sources.source_recorder import SourceRecorder
from sb3_combrel.sources.transitions import LEARNERS, Transitions, as_transition_count, make_env

# Steps; nobody waits longer for a source.
LONGEST_EPISODE = 50_000


def learn_fitted_rmax(env: str | gym.Env[Any, Any], seed: int | None, n_episodes: int, learner: dict[str, Any]) -> Transitions:
    """All transitions while Fitted R-Max learns a task; for the parameters see :meth:`SourceInstances.from_fitted_rmax`."""
    n_episodes = as_transition_count("n_episodes", n_episodes)
    task = make_env(env)
    try:
        model = FittedRMax(task, seed=seed, **learner)
        recorder = SourceRecorder(bounds=learner.get("bounds"), seed=seed)
        # Episodes end the learning, not steps: the task may end them at any length.
        model.learn(10**9, callback=[recorder, StopTrainingOnMaxEpisodes(n_episodes), _RefuseEndless()])
        # The learner's, which need not be the environment's.
        return recorder.transitions()._replace(periodic=model.policy.agent.periodic)
    finally:
        if isinstance(env, str):
            task.close()


class _RefuseEndless(BaseCallback):
    """Ends learning, with an error, if no episode ends."""

    def _on_training_start(self) -> None:
        self._last_end = 0

    def _on_rollout_end(self) -> None:
        self._last_end = self.num_timesteps

    def _on_step(self) -> bool:
        if self.num_timesteps - self._last_end > LONGEST_EPISODE:
            raise ValueError(
                f"the source's environment must end its episodes, none has ended for {LONGEST_EPISODE} steps: wrap it in "
                "gymnasium.wrappers.TimeLimit(env, max_episode_steps=...)"
            )
        return True


LEARNERS["fitted_rmax"] = learn_fitted_rmax
READERS["fitted_rmax"] = lambda file: FittedRMax.load(file, verbose=0).source_instances()
