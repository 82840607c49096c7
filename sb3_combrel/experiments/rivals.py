"""Steps and seconds until a task is solved: Fitted R-Max by default, beside DQN, PPO and SBX's CrossQ as RL-Zoo tunes them.

Run as ``taskset -c 0 python -m sb3_combrel.experiments.rivals``, which gives all of them one core; a later call does what is
missing.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from rich.console import Console
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_combrel import FittedRMax
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.experiments.suite.tasks import TASKS as SUITE
from sb3_combrel.experiments.tasks.swing_ups import make_car, make_torques
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder
from sb3_combrel.runs.job import Job, Result, Task, chosen_on_purpose
from sb3_combrel.runs.runner import Backend, check_all_succeeded, run_missing

#: Gymnasium states no threshold for Pendulum.
THRESHOLDS: dict[str, float] = {
    name: gym.spec(name).reward_threshold or -200.0
    for name in ("CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1", "MountainCarContinuous-v0")
}
FITTED_RMAX, CROSSQ = "FittedRMax", "CrossQ"
#: Environment steps between two evaluations of the greedy policy: fewer where few steps take long.
EVERY = {FITTED_RMAX: 500, "DQN": 2000, "PPO": 2000, CROSSQ: 500}
#: Gives DQN the continuous tasks with the few actions that Fitted R-Max has there, and the hyperparameters of the task that is
#: most alike among those that RL-Zoo has for DQN.
DISCRETISED = {"Pendulum-v1": make_torques, "MountainCarContinuous-v0": make_car}
ALIKE = {"Pendulum-v1": "Acrobot-v1", "MountainCarContinuous-v0": "MountainCar-v0"}
#: The rivals learn as long as RL-Zoo lets them, but not longer than the first number.
MAX_STEPS, MAX_STEPS_OF_FITTED_RMAX = 300_000, 20_000
SEEDS = (20000, 20001, 20002)
N_EPISODES = 10
#: What compiles has learnt this many steps before the time is taken, with episodes of so many.
COMPILED_STEPS, COMPILED_EPISODE = 130, 30
OUTPUT, TABLE = Path("rivals"), Path("docs/results/rivals.csv")


class Evaluation(EvalCallback):
    """Evaluates as its base does, ends the learning at a threshold or after a number of steps, and knows its own time."""

    def __init__(self, env: VecEnv, threshold: float, n_steps: int, every: int):
        super().__init__(env, n_eval_episodes=N_EPISODES, eval_freq=every, verbose=0)
        self.threshold, self.n_steps, self.spent = threshold, n_steps, np.zeros(2)

    @property
    def reached(self) -> bool:
        """Whether an evaluation had at least the threshold as its mean return."""
        return bool(self.best_mean_reward >= self.threshold)

    def _on_step(self) -> bool:
        start = clocks()
        super()._on_step()
        self.spent += clocks() - start
        return not self.reached and self.num_timesteps < self.n_steps


@dataclass(frozen=True, kw_only=True)
class RivalJob(Job):
    """An algorithm, ``method``, that learns a task, ``group``, until it is solved or ``n_steps`` are over.

    :param learner: hyperparameters as RL-Zoo writes them; none for Fitted R-Max
    :param threshold: mean return of an evaluation at which the task is solved
    :param every: steps between two evaluations
    """

    threshold: float
    every: int

    def make_envs(self, seed: int, max_episode_steps: int | None = None, evaluation: bool = False) -> VecEnv:
        """Make the environments, one an episode for evaluations, with normalisation if the hyperparameters ask for it."""

        def make() -> gym.Env:
            env = self.make_env()
            return env if max_episode_steps is None else gym.wrappers.TimeLimit(env, max_episode_steps)

        envs = make_vec_env(make, N_EPISODES if evaluation else self.n_envs, seed)
        if not self.learner.get("normalize", False):
            return envs
        gamma = self.learner["gamma"]
        return VecNormalize(envs, training=not evaluation, norm_reward=not evaluation, gamma=gamma)

    @property
    def n_envs(self) -> int:
        """The number of environments that learning takes steps in at the same time."""
        return int(self.learner.get("n_envs", 1))

    def make_learner(self, envs: VecEnv) -> Any:
        """Make the model."""
        return learner_of(self.method, envs, self.seed, self.learner)

    def carry_out(self) -> Result:
        """Learn, and take the time without that of the evaluations."""
        assert self.n_steps is not None
        with chosen_on_purpose():
            first_use = self.first_use()
            with (
                closing(self.make_envs(self.seed)) as envs,
                closing(self.make_envs(EVALUATION_SEED + self.seed, evaluation=True)) as evaluation_envs,
            ):
                model, recorder = self.make_learner(envs), EpisodeRecorder()
                evaluation = Evaluation(evaluation_envs, self.threshold, self.n_steps, self.every // self.n_envs)
                start = clocks()
                # Schedules depend on the number of steps that RL-Zoo gives.
                n_timesteps = int(self.learner.get("n_timesteps", self.n_steps))
                model.learn(n_timesteps, [recorder, evaluation], log_interval=None)
                seconds, wall_seconds = (clocks() - start - evaluation.spent).tolist()
        more = {"reached": evaluation.reached, "wall_seconds": wall_seconds, "first_use_seconds": first_use}
        more |= {"best_return": float(evaluation.best_mean_reward)}
        episodes = (column.tolist() for column in recorder.episodes)
        return self.result(*episodes, int(model.num_timesteps), more, seconds)

    def first_use(self) -> float:
        """Let a twin learn some steps, if it compiles, and return the processor time; nothing is learnt from it."""
        if self.method not in (FITTED_RMAX, CROSSQ):
            return 0.0
        with closing(self.make_envs(self.seed, COMPILED_EPISODE)) as envs:
            start = time.process_time()
            self.make_learner(envs).learn(COMPILED_STEPS, log_interval=None)
            return time.process_time() - start


def clocks() -> np.ndarray:
    """Processor time and wall-clock time, in seconds."""
    return np.array([time.process_time(), time.perf_counter()])


def learner_of(algorithm: str, env: Any, seed: int, hyperparameters: Mapping[str, Any]) -> Any:
    """Make a model, of Stable-Baselines3's kind, which has learnt nothing yet.

    :param hyperparameters: as RL-Zoo writes them; Fitted R-Max has none
    """
    if algorithm == FITTED_RMAX:
        return FittedRMax(env, seed=seed)
    return class_of(algorithm)(env=env, seed=seed, **arguments_of(hyperparameters))


def class_of(name: str) -> Any:
    """Return the class of a rival."""
    if name == CROSSQ:
        import sbx

        keep_compiled()
        return sbx.CrossQ
    if name == "QRDQN":
        import sb3_contrib

        return sb3_contrib.QRDQN
    return {"DQN": DQN, "PPO": PPO}[name]


@functools.cache
def keep_compiled() -> tempfile.TemporaryDirectory[str]:
    """Let JAX, which compiles anew for each model, keep what it has compiled on disk as Numba does, until the process ends."""
    import jax

    folder = tempfile.TemporaryDirectory()
    jax.config.update("jax_compilation_cache_dir", folder.name)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def arguments_of(published: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as an algorithm's constructor takes them."""
    arguments = {key: value for key, value in published.items() if key not in ("n_timesteps", "n_envs", "normalize")}
    for key in ("learning_rate", "clip_range"):
        kind, _, start = str(arguments.get(key, "")).partition("_")
        if kind == "lin":
            arguments[key] = LinearSchedule(float(start), 0.0, 1.0)
    if "policy_kwargs" in arguments:
        # RL-Zoo writes them as Python.
        arguments["policy_kwargs"] = eval(arguments["policy_kwargs"])
    return arguments


def published(algorithm: str, task: str) -> dict[str, Any]:
    """Return the hyperparameters that RL-Zoo has for an algorithm and a task, as written in its files."""
    import yaml

    file = folder_of("rl_zoo3", "the comparison") / "hyperparams" / f"{algorithm.lower()}.yml"
    return dict(yaml.safe_load(file.read_text())[task])


def folder_of(package: str, user: str) -> Path:
    """Return the folder of an installed package, which is not imported.

    :raises ModuleNotFoundError: if it is not installed; names the extra
    """
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        message = f"{user} needs {package}, which is not installed: pip install 'sb3-combrel[benchmarks]'"
        raise ModuleNotFoundError(message, name=package)
    return Path(spec.origin).parent


def check_names(argument: str, names: Sequence[str], known: Collection[str]) -> None:
    """:raises ValueError: if a name is none of the known ones"""
    for name in names:
        if name not in known:
            close = did_you_mean(name, known)
            raise ValueError(f"{argument} must be some of {', '.join(known)}, got {name!r}{close}")


def rival_jobs(tasks: Sequence[str], algorithms: Sequence[str], seeds: Sequence[int], max_steps: int) -> list[RivalJob]:
    """Make the jobs, seed by seed; CrossQ has none where actions are discrete.

    :raises ValueError: if a name is unknown
    :raises ModuleNotFoundError: if a package is not installed
    """
    check_names("tasks", tasks, THRESHOLDS)
    check_names("algorithms", algorithms, EVERY)
    if CROSSQ in algorithms:
        folder_of("sbx", CROSSQ)
    runs = [run for run in product(tasks, algorithms) if run[1] != CROSSQ or run[0] in DISCRETISED]
    return [rival_job(*run, seed, max_steps) for seed in seeds for run in runs]


def rival_job(task: str, algorithm: str, seed: int, max_steps: int) -> RivalJob:
    """Make the job of one run."""
    env: Task = task
    learner: dict[str, Any] = {}
    if algorithm == FITTED_RMAX:
        env = SUITE[task].make
    elif algorithm == "DQN":
        env, learner = DISCRETISED.get(task, task), published(algorithm, ALIKE.get(task, task))
    else:
        learner = published(algorithm, task)
    return RivalJob(
        group=task,
        method=algorithm,
        seed=seed,
        env=env,
        n_steps=min(max_steps, int(learner.get("n_timesteps", MAX_STEPS_OF_FITTED_RMAX))),
        learner=learner,
        threshold=THRESHOLDS[task],
        every=EVERY[algorithm],
    )


def table_of(results: Sequence[Result]) -> pd.DataFrame:
    """Return the table, one row a run."""
    return pd.DataFrame(
        [
            {"task": each.group, "algorithm": each.method, "seed": each.seed, "steps": each.n_steps, "seconds": each.seconds}
            | each.more
            for each in results
        ]
    ).round(2)


def rivals(
    tasks: list[str] = list(THRESHOLDS),  # noqa: B006 - tyro shows it, nobody changes it
    algorithms: list[str] = list(EVERY),  # noqa: B006
    seeds: list[int] = list(SEEDS),  # noqa: B006
    max_steps: int = MAX_STEPS,
    output: Path = OUTPUT,
    table: Path = TABLE,
) -> None:
    """Learn tasks until they are solved, by Fitted R-Max and its rivals, and write steps and seconds of each run.

    :param tasks: names of Gymnasium
    :param algorithms: FittedRMax, DQN, PPO, CrossQ
    :param seeds: one run each
    :param max_steps: after which a run ends
    :param output: folder for the results; a later call goes on from there
    :param table: the CSV file
    """
    jobs = rival_jobs(tasks, algorithms, seeds, max_steps)
    # One at a time: runs that are timed must not fight for a core.
    results = run_missing(jobs, output, Backend(n_jobs=1), Console())
    check_all_succeeded(results)
    rows = table_of(results)
    rows.to_csv(table, index=False)
    figures = rows.groupby(["task", "algorithm"], sort=False)
    print(figures.agg({"reached": "sum", "steps": "median", "seconds": "median", "wall_seconds": "median"}))


def main() -> None:
    """Run the command line."""
    import tyro

    try:
        tyro.cli(rivals)
    except (ValueError, ModuleNotFoundError) as error:
        sys.exit(f"rivals: {error}")


if __name__ == "__main__":
    main()
