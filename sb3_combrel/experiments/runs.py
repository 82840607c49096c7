"""One learning run: an agent that learns a task for a number of episodes, and writes its results to files meanwhile."""

from __future__ import annotations

import contextlib
import csv
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.transfer.base import Transfer

COLUMNS = ("episode", "steps", "reached_goal", "seconds")


@dataclass(frozen=True)
class Run:
    """
    An agent that learns the target task from nothing, with or without transfer.

    :param folder: where the results go
    :param method: name of the method in tables and figures
    :param seed: seed of the agent and its environment
    :param env_id: id of the target task
    :param n_episodes: episodes to learn
    :param max_episode_steps: steps after which an episode is cut off
    :param transfer: transfer method, or None
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`
    """

    folder: Path
    method: str
    seed: int
    env_id: str
    n_episodes: int
    max_episode_steps: int
    transfer: Transfer | None = None
    learner: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the run in file names and in TensorBoard."""
        return f"{self.method.lower().replace(' ', '_')}_seed{self.seed}"

    @property
    def episodes_file(self) -> Path:
        """One row an episode, written as the episode ends."""
        return self.folder / "runs" / f"{self.name}.csv"

    @property
    def mappings_file(self) -> Path:
        """How often the transfer method used each mapping."""
        return self.folder / "runs" / f"{self.name}_mappings.csv"

    @property
    def model_file(self) -> Path:
        """The trained model; it is written last, so a run that has one is complete."""
        return self.folder / "runs" / f"{self.name}.zip"

    @property
    def tensorboard_folder(self) -> Path:
        """TensorBoard logs of all runs."""
        return self.folder / "tensorboard"

    def is_complete(self) -> bool:
        """Whether all its episodes have been learned before."""
        return self.model_file.exists() and len(self.episodes()) >= self.n_episodes

    def episodes(self) -> list[dict[str, str]]:
        """The episodes so far, as rows of text by :data:`COLUMNS`."""
        if not self.episodes_file.exists():
            return []
        with self.episodes_file.open(newline="") as file:
            # A row that is being written may still lack its end.
            return [row for row in csv.DictReader(file) if row.get(COLUMNS[-1])]

    def steps(self) -> np.ndarray:
        """Steps of each episode, shape (n_episodes,); an episode that was cut off counts with the steps it had."""
        return np.array([int(row["steps"]) for row in self.episodes()[: self.n_episodes]])

    def mapping_counts(self) -> dict[str, int]:
        """How often each mapping was used, by name; empty without transfer."""
        if not self.mappings_file.exists():
            return {}
        with self.mappings_file.open(newline="") as file:
            return {row["mapping"]: int(row["count"]) for row in csv.DictReader(file)}


class EpisodeLog(BaseCallback):
    """
    Writes a row for every episode and stops the learning after the last.

    :param path: file to write
    :param n_episodes: episodes to learn
    """

    def __init__(self, path: Path, n_episodes: int):
        super().__init__()
        self.path = path
        self.n_episodes = n_episodes
        self._n_done = 0
        self._file: TextIO | None = None

    def _on_training_start(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("w", newline="")
        csv.writer(self._file).writerow(COLUMNS)

    def _on_step(self) -> bool:
        # One step later: the algorithm plans and logs at the end of an episode only after it has asked the callbacks.
        if self._n_done >= self.n_episodes:
            return False
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                self._end_episode(info)
        return True

    def _end_episode(self, info: dict[str, Any]) -> None:
        assert self._file is not None
        self._n_done += 1
        steps, seconds = info["episode"]["l"], info["episode"]["t"]
        reached_goal = not info.get("TimeLimit.truncated", False)
        csv.writer(self._file).writerow((self._n_done, steps, int(reached_goal), f"{seconds:.2f}"))
        self._file.flush()
        self.logger.record("rollout/ep_len", steps)
        self.logger.record("rollout/episode", self._n_done)

    def _on_training_end(self) -> None:
        if self._file is not None:
            self._file.close()


def carry_out(run: Run) -> Run:
    """
    Learn, unless that was done before, and write episodes, mappings used, model and TensorBoard logs to the run's folder.

    A run that was stopped is repeated from the start, so that its results are those of a run without a stop.

    :return: the run
    """
    if run.is_complete():
        return run
    th.set_num_threads(1)
    _remove_leftovers(run)
    env = make_task(run.env_id, max_episode_steps=run.max_episode_steps)
    try:
        with coarse_on_purpose():
            model = FittedRMax(
                env, transfer=run.transfer, seed=run.seed, tensorboard_log=str(run.tensorboard_folder), **run.learner
            )
        max_steps = run.n_episodes * run.max_episode_steps
        model.learn(max_steps, EpisodeLog(run.episodes_file, run.n_episodes), log_interval=1, tb_log_name=run.name)
    finally:
        env.close()
    if model.agent.transfer is not None:
        _write_mappings(run.mappings_file, model.agent.transfer)
    unfinished = run.model_file.with_suffix(".part")
    model.save(unfinished)
    os.replace(unfinished, run.model_file)
    return run


@contextlib.contextmanager
def coarse_on_purpose() -> Iterator[None]:
    """Suppress the warning of a coarse grid, which an experiment has chosen and which would come once for every run."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="resolution=.* is coarse")
        yield


@contextlib.contextmanager
def outside_bounds_on_purpose() -> Iterator[None]:
    """Suppress the warning of an observation outside the bounds that a task gives, which would come once for every run."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="(?s)the observation .* is outside the bounds")
        yield


@contextlib.contextmanager
def chosen_on_purpose() -> Iterator[None]:
    """
    Suppress the warnings of what an experiment has chosen, which would come once for every run.

    These are a grid of many or few points, a source that misleads, and observations outside the bounds that a task gives.
    """
    with warnings.catch_warnings(), outside_bounds_on_purpose():
        warnings.filterwarnings("ignore", message="resolution=.* (is coarse|means)")
        warnings.filterwarnings("ignore", message="what was transferred from")
        yield


def make_task(env_id: str, **kwargs: Any) -> Any:
    """
    Make one of the package's environments.

    :param env_id: id of an environment
    :param kwargs: arguments of ``gymnasium.make``
    """
    import gymnasium as gym

    if env_id.startswith("combrel/"):
        import combrel_envs  # noqa: F401 - registers them
    return gym.make(env_id, **kwargs)


def _remove_leftovers(run: Run) -> None:
    for path in (run.episodes_file, run.mappings_file, run.model_file, run.model_file.with_suffix(".part")):
        path.unlink(missing_ok=True)
    for path in run.tensorboard_folder.glob(f"{run.name}_[0-9]*"):
        with contextlib.suppress(OSError):
            shutil.rmtree(path)


def _write_mappings(path: Path, transfer: Any) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("mapping", "count"))
        writer.writerows((str(mapping), count) for mapping, count in transfer.mapping_counts())
