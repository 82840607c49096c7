"""Fitted R-Max as the learner of a source task: its experience makes source instances, as in Section 5.2 of the paper.

The learner is defined above this package, which transfer to it needs; it is handed in by :func:`register_fitted_rmax`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel.common.checks import as_count
from sb3_combrel.sources.recording import TransitionRecorder
from sb3_combrel.sources.tasks import make_env
from sb3_combrel.sources.transitions import MAX_STEPS, WHY_MAX_STEPS, Transitions

_registered: list[Callable[..., BaseAlgorithm]] = []


def register_fitted_rmax(fitted_rmax: Callable[..., BaseAlgorithm]) -> None:
    """
    Hand in the learner that :meth:`SourceInstances.from_fitted_rmax` uses; ``import sb3_combrel`` does.

    :param fitted_rmax: makes a learner of an environment, ``seed`` and further keyword arguments
    """
    _registered[:] = [fitted_rmax]


def learn_transitions(env: str | gym.Env[Any, Any], seed: int | None, n_episodes: int, learner: dict[str, Any]) -> Transitions:
    """
    All transitions of a task while Fitted R-Max learns it.

    :param env: a task, or its id
    :param seed: seed of the learner and its environment
    :param n_episodes: episodes of learning
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`
    :raises ValueError: if the spaces do not fit, if ``n_episodes`` is not a whole number of at least 1, or if the
        environment returns something that is not finite
    :raises RuntimeError: if no learner has been handed in
    """
    n_episodes = as_count("n_episodes", n_episodes, max=MAX_STEPS, why_max=WHY_MAX_STEPS)
    if not _registered:
        raise RuntimeError("Fitted R-Max is not registered as a learner of source tasks: import sb3_combrel first")
    task = make_env(env)
    try:
        model: Any = _registered[0](task, seed=seed, **learner)
        recorder = TransitionRecorder(bounds=learner.get("bounds"), seed=seed)
        # Episodes end the learning, not steps: the task may end them at any length.
        model.learn(10**9, callback=[recorder, StopTrainingOnMaxEpisodes(n_episodes)])
        # The learner's, which need not be the environment's.
        return recorder.transitions()._replace(periodic=model.policy.agent.periodic)
    finally:
        if isinstance(env, str):
            task.close()
