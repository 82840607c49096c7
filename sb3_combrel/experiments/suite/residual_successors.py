"""Does it pay to plan with several successors, made from the residuals of a local linear fit, where outcomes are random?

Two models in plain NumPy that differ in nothing else: one successor a state-action pair, the mean; or one for each of the
nearest instances, the mean plus what the fit leaves unexplained of it. Run as ``python -m
sb3_combrel.experiments.suite.residual_successors --seeds 4``; each run takes half a minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from typing import ClassVar

import numpy as np
import torch as th

from sb3_combrel.experiments.suite.measures import LAST
from sb3_combrel.experiments.suite.tasks import TASKS
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.models.base import Model, Predictions
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder, play

#: The tasks with two state variables and random outcomes, and how many steps of each are learnt.
STEPS = {"ICubTorso-noisy": 1500, "MountainCar-v0-noisy": 3000}
RESOLUTION = 4
EVALUATION_EPISODES = 100
RIDGE = 0.001
# The last of the nearest instances weighs exp(-3), about 0.05.
LAST_EXPONENT = 3.0


class MeanSuccessor(Model):
    """
    Weighted linear regression on the nearest instances, computed anew at each transition; the mean is the only successor.

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    n_successors: ClassVar[int] = 1

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        """
        Predict from the target's own instances.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        """
        n, d = states.shape
        found = Predictions(np.zeros(n), np.zeros(n), np.zeros((n, self.n_successors)), np.zeros((n, self.n_successors, d)))
        for action in np.unique(actions):
            asked = np.flatnonzero(actions == action)
            if self.instances.size[action]:
                for array, part in zip(found, self._predict_action(states[asked], int(action)), strict=True):
                    array[asked] = part
        return found

    def _predict_action(self, states: np.ndarray, action: int) -> Predictions:
        m, settings = int(self.instances.size[action]), self.settings
        effects = self.instances.effect[action, :m]
        squared = ((states[:, None] - self.instances.state[action, :m]) ** 2).sum(axis=2)
        near = np.argsort(squared, axis=1, kind="stable")[:, : settings.n_neighbors]
        squared = np.take_along_axis(squared, near, axis=1)
        breadth = np.full(len(states), settings.model_breadth**2)
        if near.shape[1] == settings.n_neighbors:
            breadth = np.minimum(breadth, np.maximum(squared[:, -1], 1e-12) / LAST_EXPONENT)
        weight = np.exp(-squared / breadth[:, None])
        mean, residual = _fit(states, self.instances.state[action, near], effects[near], weight, RIDGE * breadth)
        outcome = np.exp(-(squared - squared[:, :1]) / min(settings.model_breadth, settings.outcome_breadth) ** 2)
        outcome /= outcome.sum(axis=1, keepdims=True)
        goes_on = 1.0 - (outcome * self.instances.terminated[action, near]).sum(axis=1)
        probability, effect = self._successors(mean, residual, weight)
        return Predictions(
            weight=np.exp(-squared / settings.model_breadth**2).sum(axis=1),
            reward=(outcome * self.instances.reward[action, near]).sum(axis=1),
            probability=probability * goes_on[:, None],
            effect=np.clip(effect, effects.min(axis=0), effects.max(axis=0)),
        )

    def _successors(self, mean: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities, shape (n, n_successors), and effects, from the mean and the residuals of the nearest instances."""
        return np.ones((len(mean), 1)), mean[:, None]


class ResidualSuccessors(MeanSuccessor):
    """
    The same, with a successor for each of the five nearest instances: the mean, plus its residual less their mean residual.

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    n_successors = 5

    def _successors(self, mean: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n, k = len(mean), min(self.n_successors, weight.shape[1])
        probability, effect = np.zeros((n, self.n_successors)), np.zeros((n, self.n_successors, mean.shape[1]))
        probability[:, :k] = weight[:, :k] / weight[:, :k].sum(axis=1, keepdims=True)
        nearest = residual[:, :k] - (probability[:, :k, None] * residual[:, :k]).sum(axis=1, keepdims=True)
        effect[:, :k] = mean[:, None] + nearest
        return probability, effect


def _fit(
    at: np.ndarray, states: np.ndarray, effects: np.ndarray, weight: np.ndarray, ridge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Fit effects as linear functions of the state, once for each of n states.

    :param at: shape (n, d)
    :param states: of k instances for each, shape (n, k, d); ``effects``: the same
    :param weight: shape (n, k); ``ridge``: shape (n,)
    :return: effects at ``at``, shape (n, d), and residuals of the instances, shape (n, k, d)
    """
    share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
    mean_state, mean_effect = (share * states).sum(axis=1), (share * effects).sum(axis=1)
    away, differences = states - mean_state[:, None], effects - mean_effect[:, None]
    squares = np.einsum("nk,nki,nkj->nij", weight, away, away) + ridge[:, None, None] * np.eye(at.shape[1])
    slopes = np.linalg.solve(squares, np.einsum("nk,nki,nkj->nij", weight, away, differences))
    return mean_effect + np.einsum("ni,nij->nj", at - mean_state, slopes), differences - away @ slopes


def run(task_name: str, model_class: type[Model], seed: int) -> tuple[float, float]:
    """
    Learn a task and play it without exploration.

    :param task_name: one of :data:`STEPS`
    :return: mean return of the last ten episodes of learning, and of the evaluation
    """
    task, recorder = TASKS[task_name], EpisodeRecorder()
    with closing(task.make()) as env:
        model = FittedRMax(env, seed=seed, resolution=RESOLUTION, policy_kwargs=dict(model_class=model_class), **task.learner)
        model.learn(STEPS[task_name], recorder, log_interval=None)
    with closing(task.make()) as env:
        played = play(model, env, EVALUATION_EPISODES, EVALUATION_SEED + seed, keeps_state=True)
    return float(recorder.episodes.returns[-LAST:].mean()), float(played.returns.mean())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the comparison and print a table row for each run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=4, help="runs of each, from seed 0 on")
    seeds = parser.parse_args(arguments).seeds
    if seeds < 1:
        parser.error(f"--seeds must be at least 1, got {seeds}")
    th.set_num_threads(1)
    print("| task | model | seed | last 10 of learning | greedy |\n| --- | --- | ---: | ---: | ---: |")
    for task_name in STEPS:
        for model_class in (MeanSuccessor, ResidualSuccessors):
            for seed in range(seeds):
                learning, greedy = run(task_name, model_class, seed)
                print(f"| {task_name} | {model_class.__name__} | {seed} | {learning:.1f} | {greedy:.1f} |", flush=True)


if __name__ == "__main__":
    main()
