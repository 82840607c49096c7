"""Fitted R-Max as the learner of a source task: its experience makes source instances, as in Section 5.2 of the paper."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from sb3_combrel.sources.recording import SourceRecorder, make_env
from sb3_combrel.sources.source_instances import SourceInstances


def learn_source(
    env: str | gym.Env[Any, Any],
    n_instances: int = 1000,
    seed: int | None = None,
    *,
    n_episodes: int = 100,
    method: str = "covering",
    **learner: Any,
) -> SourceInstances:
    """Learn a source task and keep a choice of all experience; see :meth:`SourceInstances.from_fitted_rmax`."""
    from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

    from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax

    if n_instances < 1 or n_episodes < 1:
        raise ValueError(f"n_instances and n_episodes must be at least 1, got {n_instances} and {n_episodes}")
    task = make_env(env)
    try:
        model = FittedRMax(task, seed=seed, **learner)
        recorder = SourceRecorder(bounds=learner.get("bounds"), seed=seed)
        # Episodes end the learning, not steps: the task may end them at any length.
        model.learn(10**9, callback=[recorder, StopTrainingOnMaxEpisodes(n_episodes)])
        return recorder.source_instances().subset(n_instances, method, seed)
    finally:
        if isinstance(env, str):
            task.close()
