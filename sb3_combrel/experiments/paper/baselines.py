"""What a user would pick instead: DQN, QR-DQN, and DQN whose replay buffer is filled by COMBREL before it learns."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import RescaleObservation
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.experiments.paper.domains import ICUB, MOUNTAIN_CAR, Domain
from sb3_combrel.experiments.tasks import icub_arm, mountain_car
from sb3_combrel.runs.described import described
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder, Episodes, play
from sb3_combrel.runs.job import UNLIMITED, Job, Result, chosen_on_purpose
from sb3_combrel.sources.source_recorder import SourceRecorder
from sb3_combrel.sources.transitions import Transitions
from sb3_combrel.transfer.base import Transfer

PLAIN, QUANTILE, PREFILLED = "DQN", "QR-DQN", "DQN prefilled"
#: The control of "DQN prefilled": the buffer holds the target's own transitions of the same steps, nothing is translated.
OWN = "DQN prefilled with own"
OF_SOURCE = (PREFILLED, OWN)
ALGORITHMS = (PLAIN, QUANTILE, *OF_SOURCE)

#: Figures of zoo_configs/dqn.yml and zoo_configs/qrdqn.yml, which an installed package does not have; a test compares them.
#: The learning rate is the first one, it falls linearly to 0.
_CAR: dict[str, Any] = {"learning_rate": 0.002, "batch_size": 128, "buffer_size": 100_000, "learning_starts": 1000}
_CAR |= {"gamma": 0.99, "n_steps": 5, "target_update_interval": 600, "train_freq": 16, "gradient_steps": 8}
_CAR |= {"exploration_fraction": 0.3, "exploration_final_eps": 0.05}
HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    mountain_car.TARGET_ID: _CAR,
    icub_arm.TARGET_ID: {**_CAR, "learning_rate": 0.001, "buffer_size": 50_000},
}
# "fused": Adam in one pass over all weights. QR-DQN sets the arguments of its optimizer itself.
NETWORK: dict[str, Any] = {"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}}
QUANTILE_NETWORK: dict[str, Any] = {"net_arch": [64, 64], "n_quantiles": 25}

#: The greedy policy is evaluated after so many numbers of steps, from this fraction of all steps on, over so many episodes.
N_EVALUATIONS = 10
FIRST_EVALUATION = 0.01
EVALUATION_EPISODES = 5

MAX_RUNS = 5
#: Environment steps, by domain. What exploration and learning rate are at a step depends on them.
TOTAL_TIMESTEPS = {MOUNTAIN_CAR.name: 300_000, ICUB.name: 100_000}
FEWEST_TIMESTEPS = 5000


_CAR_LEARNER = {"degree": 0, "model_breadth": 0.1, "resolution": 3}
_ARM_LEARNER = {"degree": 0, "model_breadth": 0.2, **icub_arm.LEARNER}
# Of all signed injective mappings many have about the same compliance. If only the best is used, its errors determine all
# predictions and are corrected slowly; drawn mappings do not have that drawback, and may be used farther from transitions.
_ARM_COMBREL = {"choice": "drawn", "neighbor_radius": 0.7, "breadth": 0.5, "breadth_decay": 1.0, "max_transitions": 20_000}
#: How COMBREL learns before the replay buffer is filled: arguments of FittedRMax and COMBREL, and the number of episodes;
#: instances are translated for the states visited in them.
PREFILLINGS: dict[str, tuple[Mapping[str, Any], Mapping[str, Any], int]] = {
    mountain_car.TARGET_ID: (_CAR_LEARNER, {"mappings": "injective", "use": "instances"}, 2),
    icub_arm.TARGET_ID: (_ARM_LEARNER, {"mappings": "signed_injective", **_ARM_COMBREL, "use": "instances"}, 5),
}


@dataclass(frozen=True, kw_only=True)
class BaselineJob(Job):
    """One algorithm that learns one task with one seed. The same job has the same result.

    ``method`` is one of :data:`ALGORITHMS` and ``env`` a task of :data:`HYPERPARAMETERS`. ``n_steps`` count the steps of the
    prefilling; exploration ends and the learning rate falls relative to them. The result's episodes are those of the
    prefilling first. In ``more`` it has ``evaluations`` of the greedy policy: [steps, mean return of
    :data:`EVALUATION_EPISODES` episodes, fraction of these that ended in a terminal state].
    """

    source: SourceInstances | None = None

    def __post_init__(self) -> None:
        if self.method not in ALGORITHMS or (self.source is not None) != (self.method in OF_SOURCE):
            known = f"{', '.join(ALGORITHMS)}, with a source for {' and '.join(OF_SOURCE)} only"
            raise ValueError(f"method must be one of {known}, got {self.method!r} with source={self.source!r}")

    def settings(self) -> dict[str, Any]:
        networks = {"hyperparameters": HYPERPARAMETERS[str(self.env)], "prefilling": PREFILLINGS[str(self.env)]}
        return super().settings() | dict(described(networks))

    def make_env(self) -> RescaleObservation:
        """Make the environment as the networks see it, observations between -1 and 1."""
        # Of the type of the observations: with Python's floats Gymnasium warns.
        return RescaleObservation(super().make_env(), np.float32(-1.0), np.float32(1.0))

    def carry_out(self) -> Result:
        """Learn, and evaluate the greedy policy meanwhile."""
        assert self.n_steps is not None
        start = time.process_time()
        before, prefilled = prefill(self) if self.source is not None else (Episodes.from_rows([]), None)
        n_before = int(before.steps.sum())
        if n_before >= self.n_steps:
            made = f"the {n_before} steps that were made to fill the replay buffer of {self.method!r}"
            raise ValueError(f"n_steps must be more than {made}, got {self.n_steps}")
        with closing(self.make_env()) as env, closing(self.make_env()) as evaluation_env:
            model = make_model(self, env)
            if prefilled is not None:
                fill(model.replay_buffer, prefilled, env)
            recorder = EpisodeRecorder()
            evaluator = GreedyEvaluator(evaluation_steps(self.n_steps), evaluation_env, EVALUATION_SEED + self.seed, n_before)
            model.learn(self.n_steps - n_before, [recorder, evaluator], log_interval=None)
        episodes = (np.concatenate(columns).tolist() for columns in zip(before, recorder.episodes, strict=True))
        return self.result(*episodes, self.n_steps, {"evaluations": evaluator.evaluations}, time.process_time() - start)


def baseline_jobs(domain: Domain, setting: str, sources: Mapping[int, SourceInstances], n_episodes: int) -> list[BaselineJob]:
    """Make the jobs of all baselines; with fewer episodes than by default they have fewer steps too.

    :param sources: by seed; the first :data:`MAX_RUNS` count
    """
    total = round(TOTAL_TIMESTEPS[domain.name] * min(1.0, n_episodes / domain.n_episodes))
    task: dict[str, Any] = {"group": domain.name, "env": domain.target_id, "n_steps": max(total, FEWEST_TIMESTEPS)}
    task["max_episode_steps"] = domain.settings[setting].max_episode_steps
    return [
        BaselineJob(method=algorithm, seed=seed, source=source if algorithm in OF_SOURCE else None, **task)
        for seed, source in itertools.islice(sources.items(), MAX_RUNS)
        for algorithm in ALGORITHMS
    ]


def make_model(job: BaselineJob, env: gym.Env) -> Any:
    """Make the algorithm of a job, which has learnt nothing yet."""
    algorithm: type = DQN
    if job.method == QUANTILE:
        try:
            from sb3_contrib import QRDQN
        except ImportError as error:
            raise ImportError("QR-DQN needs sb3-contrib: pip install 'sb3-combrel[experiments]'") from error
        algorithm = QRDQN
    given = dict(HYPERPARAMETERS[str(job.env)])
    given["learning_rate"] = LinearSchedule(given["learning_rate"], 0.0, 1.0)
    given["policy_kwargs"] = dict(QUANTILE_NETWORK if job.method == QUANTILE else NETWORK)
    return algorithm("MlpPolicy", env, seed=job.seed, device="cpu", **given)


def prefill(job: BaselineJob) -> tuple[Episodes, Transitions]:
    """Learn a few episodes with COMBREL; these, and what to fill the replay buffer with, translated for their states."""
    assert job.source is not None
    learner, arguments, n_episodes = PREFILLINGS[str(job.env)]
    recorder, transitions = EpisodeRecorder(n_episodes), SourceRecorder()
    with closing(Job.make_env(job)) as env, chosen_on_purpose():
        model = FittedRMax(env, transfer=COMBREL(job.source, **arguments), seed=job.seed, **learner)
        model.learn(UNLIMITED, [transitions, recorder], log_interval=None)
    transfer = model.agent.transfer
    assert transfer is not None
    visited = transitions.transitions()
    return recorder.episodes, visited if job.method == OWN else translate(transfer, visited)


def translate(transfer: Transfer, visited: Transitions) -> Transitions:
    """Translate for each state visited and each action the instance that weighs most there; within bounds, raw units."""
    assert transfer.task is not None
    scaling, units = transfer.task.scaling, transfer.task.scaling.to_unit(visited.states)
    found: list[tuple[np.ndarray, ...]] = []
    for action in range(visited.n_actions):
        actions = np.full(len(units), action, dtype=np.int64)
        given = transfer.transferred(units, actions, np.zeros(len(units)))
        rows = np.flatnonzero(given.length[: len(units)] > 0)
        # Entries beyond a row's length mean nothing.
        counts = np.arange(given.weight.shape[1]) < given.length[rows, None]
        best = np.where(counts, given.weight[rows], -np.inf).argmax(axis=1) if len(rows) else rows
        ends = np.clip(units[rows] + given.effect[rows, best], 0.0, 1.0)
        outcome = given.reward[rows, best], scaling.to_raw(ends), given.terminated[rows, best]
        found.append((visited.states[rows], actions[rows], *outcome))
    states, actions, rewards, next_states, terminated = map(np.concatenate, zip(*found, strict=True))
    scaled = visited._replace(low=scaling.low, high=scaling.high)
    return scaled._replace(states=states, actions=actions, rewards=rewards, next_states=next_states, terminated=terminated)


def fill(buffer: ReplayBuffer, transitions: Transitions, env: RescaleObservation) -> None:
    """Add transitions, raw units, to a replay buffer, each on its own: returns over steps must not go on into the next."""
    starts, ends = (env.observation(states) for states in (transitions.states, transitions.next_states))
    columns = starts, ends, transitions.actions, transitions.rewards, transitions.terminated
    for start, end, action, reward, terminated in zip(*columns, strict=True):
        # Ended by a time limit: learnt from as a single step, with the value of where it ends.
        infos = [{"TimeLimit.truncated": not terminated}]
        buffer.add(start[None], end[None], np.array([action]), np.array([reward]), np.array([True]), infos)


def evaluation_steps(n_steps: int) -> list[int]:
    """Return the numbers of steps after which to evaluate, evenly spaced on a logarithmic axis; the last is all of them."""
    spaced = np.geomspace(max(1.0, FIRST_EVALUATION * n_steps), n_steps, N_EVALUATIONS)
    return sorted({round(steps) for steps in spaced.tolist()})


class GreedyEvaluator(BaseCallback):
    """Plays episodes without exploration after some numbers of steps, each time from the same starts: ``evaluations``."""

    def __init__(self, at: Sequence[int], env: gym.Env, seed: int, n_before: int = 0):
        super().__init__()
        self.at, self.env, self.seed, self.n_before = at, env, seed, n_before
        self.evaluations: list[list[float]] = []

    def _on_step(self) -> bool:
        n_steps = self.n_before + self.num_timesteps
        if n_steps in self.at:
            played = play(self.model, self.env, EVALUATION_EPISODES, self.seed)
            self.evaluations.append([n_steps, float(played.returns.mean()), float(played.terminated.mean())])
        return True


def always_reached_from(evaluations: Sequence[Sequence[float]]) -> float:
    """Return the steps from which on all evaluated episodes ended in a terminal state; inf if the last did not."""
    good = itertools.takewhile(lambda evaluation: evaluation[2] == 1.0, reversed(evaluations))
    return min((steps for steps, *_ in good), default=np.inf)
