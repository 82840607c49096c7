"""Does it pay to plan with several successors, made from the residuals of a local linear fit, where outcomes are random?

Two models in plain NumPy that differ in nothing else: one successor a state-action pair, the mean; or one for each of the
nearest instances, the mean plus what the fit leaves unexplained of it. Run as ``python -m
sb3_combrel.experiments.suite.residual_successors --seeds 4``; each run takes half a minute.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.common.checks import check_count
from sb3_combrel.comparison.tables import markdown_table
from sb3_combrel.experiments.suite.measures import LAST
from sb3_combrel.experiments.suite.tasks import TASKS
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.models.base import Model, Predictions
from sb3_combrel.runs.episodes import EVALUATION_SEED, play
from sb3_combrel.runs.job import Job, Result
from sb3_combrel.runs.runner import Backend, check_all_succeeded, run_missing

#: The tasks with two state variables and random outcomes, and how many steps of each are learnt.
STEPS = {"ICubTorso-noisy": 1500, "MountainCar-v0-noisy": 3000}
RESOLUTION = 4
EVALUATION_EPISODES = 100
RIDGE = 0.001
# The last of the nearest instances weighs exp(-3), about 0.05.
LAST_EXPONENT = 3.0


class MeanSuccessor(Model):
    """Weighted linear regression on the nearest instances, computed anew at each transition; the only successor: the mean."""

    n_successors: ClassVar[int] = 1

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        """Predict from the target's own instances; see :class:`~sb3_combrel.models.base.Model`."""
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
        probability, effect = _successors(self.n_successors, mean, residual, weight)
        return Predictions(
            weight=np.exp(-squared / settings.model_breadth**2).sum(axis=1),
            reward=(outcome * self.instances.reward[action, near]).sum(axis=1),
            probability=probability * goes_on[:, None],
            effect=np.clip(effect, effects.min(axis=0), effects.max(axis=0)),
        )


class ResidualSuccessors(MeanSuccessor):
    """The same, with a successor for each of the five nearest instances: the mean, plus its residual less their mean one."""

    n_successors = 5


def _successors(
    n_successors: int, mean: np.ndarray, residual: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities, shape (n, n_successors), and effects; of a single one the residual less the mean residual is 0."""
    n, k = len(mean), min(n_successors, weight.shape[1])
    probability, effect = np.zeros((n, n_successors)), np.zeros((n, n_successors, mean.shape[1]))
    probability[:, :k] = weight[:, :k] / weight[:, :k].sum(axis=1, keepdims=True)
    nearest = residual[:, :k] - (probability[:, :k, None] * residual[:, :k]).sum(axis=1, keepdims=True)
    effect[:, :k] = mean[:, None] + nearest
    return probability, effect


def _fit(
    at: np.ndarray, states: np.ndarray, effects: np.ndarray, weight: np.ndarray, ridge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit effects at n states from k instances of shape (n, k, d) each: effects, (n, d), and residuals, (n, k, d)."""
    share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
    mean_state, mean_effect = (share * states).sum(axis=1), (share * effects).sum(axis=1)
    away, differences = states - mean_state[:, None], effects - mean_effect[:, None]
    squares = np.einsum("nk,nki,nkj->nij", weight, away, away) + ridge[:, None, None] * np.eye(at.shape[1])
    slopes = np.linalg.solve(squares, np.einsum("nk,nki,nkj->nij", weight, away, differences))
    return mean_effect + np.einsum("ni,nij->nj", at - mean_state, slopes), differences - away @ slopes


@dataclass(frozen=True, kw_only=True)
class ModelRun(Job):
    """A run whose result has the mean returns of the last episodes of learning and of playing without exploration."""

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        """Play the task without exploration."""
        with closing(self.make_env()) as env:
            played = play(model, env, EVALUATION_EPISODES, EVALUATION_SEED + self.seed)
        return {"learning": float(np.mean(result.returns[-LAST:])), "greedy": float(played.returns.mean())}


def jobs_of(n_seeds: int) -> list[ModelRun]:
    """Make the runs of both models on each of the tasks, with the seeds from 0 on."""
    return [
        ModelRun(
            group=name,
            method=model.__name__,
            seed=seed,
            env=TASKS[name].make,
            n_steps=n_steps,
            learner={"resolution": RESOLUTION, "policy_kwargs": {"model_class": model}, **TASKS[name].learner},
        )
        for name, n_steps in STEPS.items()
        for model in (MeanSuccessor, ResidualSuccessors)
        for seed in range(n_seeds)
    ]


def residual_successors(seeds: int = 4, jobs: int | None = 1) -> None:
    """Compare the two models with ``seeds`` runs of each, ``jobs`` at a time, and print a table with a row for each run."""
    check_count("seeds", seeds)
    results = run_missing(jobs_of(seeds), backend=Backend(n_jobs=jobs), console=Console(stderr=True))
    check_all_succeeded(results)
    rows = [
        (each.group, each.method, str(each.seed), f"{each.more['learning']:.1f}", f"{each.more['greedy']:.1f}")
        for each in results
    ]
    print(markdown_table(("task", "model", "seed", "last 10 of learning", "greedy"), rows, n_names=2))


if __name__ == "__main__":
    import tyro

    tyro.cli(residual_successors)
