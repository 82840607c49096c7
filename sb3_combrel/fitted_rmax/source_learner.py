"""Fitted R-Max as a learner of source tasks, and its saved models as sources."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.sources.experience import READERS
from sb3_combrel.sources.source_recorder import SourceRecorder
from sb3_combrel.sources.transitions import LEARNERS, Transitions, as_transition_count, make_env


def learn_fitted_rmax(env: str | gym.Env[Any, Any], seed: int | None, n_episodes: int, learner: dict[str, Any]) -> Transitions:
    """All transitions while Fitted R-Max learns a task; for the parameters see :meth:`SourceInstances.from_fitted_rmax`."""
    n_episodes = as_transition_count("n_episodes", n_episodes)
    task = make_env(env)
    try:
        model = FittedRMax(task, seed=seed, **learner)
        recorder = SourceRecorder(bounds=learner.get("bounds"), seed=seed)
        # Episodes end the learning, not steps: the task may end them at any length.
        model.learn(10**9, callback=[recorder, StopTrainingOnMaxEpisodes(n_episodes)])
        # The learner's, which need not be the environment's.
        return recorder.transitions()._replace(periodic=model.policy.agent.periodic)
    finally:
        if isinstance(env, str):
            task.close()


LEARNERS["fitted_rmax"] = learn_fitted_rmax
READERS["fitted_rmax"] = lambda file: FittedRMax.load(file).source_instances()
