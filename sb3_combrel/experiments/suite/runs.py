"""One run of the suite: a task learnt with one variant and one seed, then played without exploration."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.suite.measures import summary_of_evaluation, summary_of_learning
from sb3_combrel.experiments.suite.tasks import Source, Task
from sb3_combrel.experiments.suite.transfers import make_transfer, source_for
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.episodes import Episodes
from sb3_combrel.runs.job import chosen_on_purpose

#: Evaluation episodes begin with this seed plus the run's: no run has learnt with it.
EVALUATION_SEED = 1_000_000
#: Where the number of episodes is given, the number of steps must not end the learning first.
UNLIMITED = 10**9
RUNS_FILE, EPISODES_FILE, RUNS, SOURCES = "runs.csv", "episodes.csv", "runs", "sources"
EPISODE_COLUMNS = ("run", "episode", "steps", "return", "terminated", "truncated")
#: With the state that ``predict`` returns handed on to the next call, and by callers that drop it.
WITH_STATE, WITHOUT_STATE = "greedy", "stateless"
COMPILED_STEPS = 60
# Tasks and variants that this process has learnt before.
_COMPILED: set[tuple[str, str]] = set()


@dataclass(frozen=True)
class Variant:
    """
    One way to set the learner.

    :param name: in tables and file names
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`; they come before the task's own
    :param transfer: a name of :data:`~sb3_combrel.experiments.suite.transfers.TRANSFERS`, or None
    """

    name: str
    learner: Mapping[str, Any] = field(default_factory=dict)
    transfer: str | None = None


@dataclass(frozen=True)
class SuiteRun:
    """
    A task learnt with one variant and one seed.

    :param folder: where the results go
    :param task: the task
    :param variant: the variant
    :param seed: seed of learner and environment
    :param evaluation_episodes: episodes to play after learning, with the state of ``predict`` and as many without
    """

    folder: Path
    task: Task
    variant: Variant
    seed: int
    evaluation_episodes: int

    @property
    def name(self) -> str:
        """Name of the run in files."""
        return f"{self.task.name}_{self.variant.name}_seed{self.seed}"

    @property
    def file(self) -> Path:
        """The run's results; it is written last and at once, so a run that has one is complete."""
        return self.folder / RUNS / f"{self.name}.json"

    @property
    def source(self) -> Source | None:
        """The source task that the variant transfers from; None without transfer."""
        return None if self.variant.transfer is None else source_for(self.variant.transfer, self.task)

    def file_of(self, source: Source) -> Path:
        """The file with the instances of a source task."""
        return self.folder / SOURCES / f"{source.name}.npz"

    def settings(self) -> dict[str, Any]:
        """What the results depend on besides the names, as JSON represents it."""
        settings = {
            "learner": {**self.task.learner, **self.variant.learner},
            "transfer": self.variant.transfer,
            "n_steps": self.task.n_steps,
            "n_episodes": self.task.n_episodes,
            "evaluation_episodes": self.evaluation_episodes,
        }
        return dict(json.loads(json.dumps(settings)))

    def is_complete(self) -> bool:
        """
        Tell whether its results are there.

        :raises ValueError: if they are there, but of other settings
        """
        if not self.file.exists():
            return False
        before, now = json.loads(self.file.read_text())["settings"], self.settings()
        other = [f"{key} was {before.get(key)!r} and is {now[key]!r}" for key in now if before.get(key) != now[key]]
        if other:
            raise ValueError(f"{self.file} has results of other settings ({', '.join(other)}); use another name or --output")
        return True

    def make_model(self, env: gym.Env) -> FittedRMax:
        """Make the learner, which has learnt nothing yet."""
        transfer = None
        if self.variant.transfer is not None and self.source is not None:
            transfer = make_transfer(self.variant.transfer, self.task, self.file_of(self.source))
        with chosen_on_purpose():
            learner = {**self.task.learner, **self.variant.learner}
            return FittedRMax(env, transfer=transfer, seed=self.seed, **learner)


class EpisodeRecorder(BaseCallback):
    """
    Keeps steps, return and end of every episode, and stops the learning after some number of them.

    :param n_episodes: after so many; None for never
    """

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


def carry_out(run: SuiteRun) -> SuiteRun:
    """
    Learn, evaluate, and write the results to the run's file, unless that was done before.

    :return: the run
    """
    if run.is_complete():
        return run
    th.set_num_threads(1)
    _compile(run)
    recorder = EpisodeRecorder(run.task.n_episodes)
    with closing(run.task.make()) as env, chosen_on_purpose():
        model = run.make_model(env)
        start = time.process_time()
        model.learn(run.task.n_steps or UNLIMITED, recorder, log_interval=None)
        seconds = time.process_time() - start
    learnt = recorder.episodes
    row: dict[str, Any] = {
        "run": run.name,
        "task": run.task.name,
        "variant": run.variant.name,
        "seed": run.seed,
        "episodes": len(learnt.steps),
        "steps": model.num_timesteps,
        "ms_per_step": 1000.0 * seconds / model.num_timesteps,
        **{measure.name: measure.of(learnt) for measure in run.task.measures},
        **summary_of_learning(learnt, run.task.failure_return),
    }
    row |= evaluate(run, model, row["last10_return"])
    write_whole(run.file, json.dumps({"settings": run.settings(), "row": row, "episodes": _rows_of(run, learnt)}).encode())
    return run


def evaluate(run: SuiteRun, model: FittedRMax, last10_return: float) -> dict[str, float]:
    """
    Play episodes without exploration, with the state of ``predict`` and without, both from the same starts.

    :param run: the run
    :param model: what it has learnt
    :param last10_return: mean return of the last episodes of learning
    """
    found: dict[str, float] = {}
    for name, keeps_state in ((WITH_STATE, True), (WITHOUT_STATE, False)):
        with closing(run.task.make()) as env, chosen_on_purpose():
            episodes = play(model, env, run.evaluation_episodes, EVALUATION_SEED + run.seed, keeps_state)
        summary = summary_of_evaluation(episodes, run.task.failure_return, last10_return)
        found |= {f"{name}_{key}": value for key, value in summary.items()}
    return found


def play(model: Any, env: gym.Env, n_episodes: int, seed: int, keeps_state: bool) -> Episodes:
    """
    Play episodes without exploration.

    :param model: anything with the ``predict`` of Stable-Baselines3
    :param env: the environment, which has a time limit
    :param n_episodes: how many
    :param seed: seed of the environment, at the first reset
    :param keeps_state: whether the state that ``predict`` returns is handed to its next call
    """
    rows, state = [], None
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=seed if episode == 0 else None)
        steps, total, terminated, truncated = 0, 0.0, False, False
        while not (terminated or truncated):
            if keeps_state:
                starts = np.array([steps == 0])
                action, state = model.predict(observation, state=state, episode_start=starts, deterministic=True)
            else:
                action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(int(action))
            steps, total = steps + 1, total + float(reward)
        rows.append((steps, total, bool(terminated)))
    return Episodes.from_rows(rows)


def records(folder: Path) -> list[dict[str, Any]]:
    """Return the results of all complete runs in a folder, by task, variant and seed."""
    found = [json.loads(file.read_text()) for file in (folder / RUNS).glob("*.json")]
    return sorted(found, key=lambda record: [record["row"][key] for key in ("task", "variant", "seed")])


def write_csv(folder: Path) -> None:
    """Write ``runs.csv``, one row a run, and ``episodes.csv``, one row an episode of learning, of all complete runs."""
    found = records(folder)
    columns = list(dict.fromkeys(key for record in found for key in record["row"]))
    settings = [json.dumps(record["settings"]) for record in found]
    rows = [[record["row"].get(column, "") for column in columns] for record in found]
    _write_rows(folder / RUNS_FILE, [*columns, "settings"], [[*row, own] for row, own in zip(rows, settings, strict=True)])
    episodes = [row for record in found for row in record["episodes"]]
    _write_rows(folder / EPISODES_FILE, EPISODE_COLUMNS, episodes)


def _rows_of(run: SuiteRun, episodes: Episodes) -> list[list[Any]]:
    """One row for each episode, by :data:`EPISODE_COLUMNS`."""
    columns = zip(episodes.steps.tolist(), episodes.returns.tolist(), episodes.terminated.tolist(), strict=True)
    return [
        [run.name, number, steps, total, int(terminated), int(not terminated)]
        for number, (steps, total, terminated) in enumerate(columns, 1)
    ]


def _compile(run: SuiteRun) -> None:
    """Learn for some steps, so that compiling, or loading what was compiled before, is not in the time of a step."""
    key = (run.task.name, run.variant.name)
    if key in _COMPILED:
        return
    with closing(run.task.make()) as env, chosen_on_purpose():
        model = run.make_model(gym.wrappers.TimeLimit(env, COMPILED_STEPS // 2)).learn(COMPILED_STEPS, log_interval=None)
        play(model, gym.wrappers.TimeLimit(env, 3), 1, run.seed, keeps_state=True)
    _COMPILED.add(key)


def _write_rows(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    text = io.StringIO(newline="")
    csv.writer(text).writerows([header, *rows])
    write_whole(path, text.getvalue().encode())
