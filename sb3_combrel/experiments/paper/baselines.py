"""
What a user would pick instead: DQN, QR-DQN, and DQN whose replay buffer is filled by COMBREL before it learns.

Each is learnt by :func:`learn`, a function of one :class:`BaselineJob` that can be pickled, for a process or a cluster.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import RescaleObservation
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.common.checks import check_count
from sb3_combrel.experiments.paper.domains import EXPLORE, ICUB
from sb3_combrel.experiments.tasks import icub_arm, mountain_car
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder, Episodes, play
from sb3_combrel.runs.job import chosen_on_purpose, make_env
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
_CAR: dict[str, Any] = {
    "learning_rate": 0.002,
    "batch_size": 128,
    "buffer_size": 100_000,
    "learning_starts": 1000,
    "gamma": 0.99,
    "n_steps": 5,
    "target_update_interval": 600,
    "train_freq": 16,
    "gradient_steps": 8,
    "exploration_fraction": 0.3,
    "exploration_final_eps": 0.05,
}
HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    mountain_car.TARGET_ID: _CAR,
    icub_arm.TARGET_ID: {**_CAR, "learning_rate": 0.001, "buffer_size": 50_000},
}
#: What the networks are given lies between these. Of the type of the observations: with Python's floats Gymnasium warns.
OBSERVATION_RANGE = (np.float32(-1.0), np.float32(1.0))
# "fused": Adam in one pass over all weights, which takes a sixth off a gradient step of so small a network. QR-DQN sets the
# arguments of its optimizer itself.
NETWORK: dict[str, Any] = {"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}}
QUANTILE_NETWORK: dict[str, Any] = {"net_arch": [64, 64], "n_quantiles": 25}

#: The greedy policy is evaluated after so many numbers of steps, from this fraction of all steps on, over so many episodes.
N_EVALUATIONS = 10
FIRST_EVALUATION = 0.01
EVALUATION_EPISODES = 5

NEEDS_EXTRA = "QR-DQN needs sb3-contrib, which is not installed: pip install 'sb3-combrel[experiments]'"


@dataclass(frozen=True)
class Prefilling:
    """
    How COMBREL learns before the replay buffer is filled.

    :param learn_source: from a seed to the instances of the source task
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`
    :param transfer: arguments of :class:`~sb3_combrel.COMBREL`
    :param n_episodes: episodes that it learns; instances are translated for the states visited in them
    """

    learn_source: Callable[[int], SourceInstances]
    learner: Mapping[str, Any]
    transfer: Mapping[str, Any]
    n_episodes: int


_ARM = ICUB.settings[EXPLORE]
# As in zoo_configs/combrel.yml.
PREFILLINGS: dict[str, Prefilling] = {
    mountain_car.TARGET_ID: Prefilling(
        mountain_car.learn_source,
        {"degree": 0, "model_breadth": 0.1, "resolution": 3},
        {"mappings": "injective", "use": "instances"},
        n_episodes=2,
    ),
    icub_arm.TARGET_ID: Prefilling(
        icub_arm.learn_source,
        _ARM.learner,
        {"mappings": _ARM.mappings, **_ARM.combrel, "use": "instances"},
        n_episodes=5,
    ),
}


@dataclass(frozen=True)
class BaselineJob:
    """
    One algorithm that learns one task with one seed.

    :param algorithm: one of :data:`ALGORITHMS`
    :param env_id: a task of :data:`HYPERPARAMETERS`
    :param seed: of the algorithm and its environment
    :param total_timesteps: environment steps of learning, those of the prefilling included; exploration ends and the learning
        rate falls relative to them
    :param max_episode_steps: steps after which an episode is cut off
    :param source: instances of the source task, see :func:`learn_source`, for the algorithms of :data:`OF_SOURCE`; None for
        the others
    :raises ValueError: if an argument is out of its range, or ``source`` is missing or given in vain
    """

    algorithm: str
    env_id: str
    seed: int
    total_timesteps: int
    max_episode_steps: int
    source: SourceInstances | None = None

    def __post_init__(self) -> None:
        for name, known in {"algorithm": ALGORITHMS, "env_id": tuple(HYPERPARAMETERS)}.items():
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        check_count("seed", self.seed, min=0)
        check_count("total_timesteps", self.total_timesteps)
        check_count("max_episode_steps", self.max_episode_steps)
        if self.algorithm in OF_SOURCE and not isinstance(self.source, SourceInstances):
            raise ValueError(f"source must be SourceInstances with algorithm={self.algorithm!r}, got {self.source!r}")
        if self.algorithm not in OF_SOURCE and self.source is not None:
            raise ValueError(f"source must be None with algorithm={self.algorithm!r}, got {self.source!r}")


class Evaluations(NamedTuple):
    """
    What the greedy policy has reached while it was learnt.

    :param steps: environment steps until then, int64, shape (n,)
    :param returns: undiscounted return, mean of :data:`EVALUATION_EPISODES` episodes, shape (n,)
    :param reached: fraction of these that ended in a terminal state, shape (n,)
    """

    steps: np.ndarray
    returns: np.ndarray
    reached: np.ndarray

    def always_reached_from(self) -> float:
        """
        Return the steps from which on every episode of every evaluation ended in a terminal state; inf if the last did not.

        A single evaluation proves little: on the arm one command, repeated for ever, may hit the ball in the end.
        """
        failed = np.flatnonzero(self.reached < 1.0)
        n_before = int(failed[-1]) + 1 if len(failed) else 0
        return float(self.steps[n_before]) if n_before < len(self.steps) else np.inf


class Learnt(NamedTuple):
    """
    What :func:`learn` returns.

    :param episodes: all that have ended, those of the prefilling first
    :param evaluations: of the greedy policy of the network
    :param prefilled: what the replay buffer was filled with, raw units; None if it was not
    """

    episodes: Episodes
    evaluations: Evaluations
    prefilled: Transitions | None


def learn_source(env_id: str, seed: int = 0) -> SourceInstances:
    """
    Learn the source task of a target and keep 1000 of its instances, for jobs of :data:`OF_SOURCE`.

    :param env_id: the target, a task of :data:`PREFILLINGS`
    :param seed: seed of the learner and the choice
    :raises ValueError: if there is no such task
    """
    if env_id not in PREFILLINGS:
        raise ValueError(f"env_id must be one of {', '.join(PREFILLINGS)}, got {env_id!r}")
    return PREFILLINGS[env_id].learn_source(seed)


def learn(job: BaselineJob) -> Learnt:
    """
    Learn a task, and evaluate the greedy policy meanwhile. Nothing is written; the same job has the same result.

    :raises ImportError: if QR-DQN is asked for and sb3-contrib is missing
    :raises ValueError: if no steps are left after those of the prefilling
    """
    th.set_num_threads(1)
    before, prefilled = prefill(job) if job.source is not None else (Episodes.from_rows([]), None)
    n_before = int(before.steps.sum())
    if n_before >= job.total_timesteps:
        raise ValueError(
            f"total_timesteps must be more than the {n_before} steps that were made to fill the replay buffer of "
            f"{job.algorithm!r}, got {job.total_timesteps}"
        )
    with closing(scaled_env(job)) as env, closing(scaled_env(job)) as evaluation_env:
        model = make_model(job, env)
        if prefilled is not None:
            assert model.replay_buffer is not None
            fill(model.replay_buffer, prefilled, env)
        recorder = EpisodeRecorder()
        at = evaluation_steps(job.total_timesteps)
        evaluator = GreedyEvaluator(at, evaluation_env, EVALUATION_SEED + job.seed, n_before)
        model.learn(job.total_timesteps - n_before, [recorder, evaluator], log_interval=None)
    both = (np.concatenate(columns) for columns in zip(before, recorder.episodes, strict=True))
    return Learnt(Episodes(*both), evaluator.evaluations, prefilled)


def scaled_env(job: BaselineJob) -> RescaleObservation:
    """Make the environment of a job as the networks see it, observations between -1 and 1."""
    return RescaleObservation(make_env(job.env_id, max_episode_steps=job.max_episode_steps), *OBSERVATION_RANGE)


def make_model(job: BaselineJob, env: gym.Env) -> Any:
    """
    Make the algorithm of a job, which has learnt nothing yet.

    :param env: from :func:`scaled_env`
    :raises ImportError: if QR-DQN is asked for and sb3-contrib is missing
    """
    algorithm: type = DQN
    if job.algorithm == QUANTILE:
        # Of an extra, so not imported before it is needed.
        try:
            from sb3_contrib import QRDQN
        except ImportError as error:
            raise ImportError(NEEDS_EXTRA) from error
        algorithm = QRDQN
    given = dict(HYPERPARAMETERS[job.env_id])
    given["learning_rate"] = LinearSchedule(given["learning_rate"], 0.0, 1.0)
    given["policy_kwargs"] = dict(QUANTILE_NETWORK if job.algorithm == QUANTILE else NETWORK)
    return algorithm("MlpPolicy", env, seed=job.seed, device="cpu", **given)


def prefill(job: BaselineJob) -> tuple[Episodes, Transitions]:
    """
    Learn a few episodes with COMBREL, and translate instances for all states visited in them.

    :param job: one of :data:`OF_SOURCE`
    :return: these episodes, and what to fill the replay buffer with, raw units
    :raises ValueError: if the job's algorithm is another
    """
    if job.source is None:
        raise ValueError(
            f"algorithm must be one of {', '.join(OF_SOURCE)}, got {job.algorithm!r}: there is nothing to transfer"
        )
    settings = PREFILLINGS[job.env_id]
    recorder, transitions = EpisodeRecorder(settings.n_episodes), SourceRecorder()
    with closing(make_env(job.env_id, max_episode_steps=job.max_episode_steps)) as env, chosen_on_purpose():
        model = FittedRMax(env, transfer=COMBREL(job.source, **settings.transfer), seed=job.seed, **settings.learner)
        model.learn(settings.n_episodes * job.max_episode_steps, [transitions, recorder], log_interval=None)
    transfer = model.agent.transfer
    assert transfer is not None
    visited = transitions.transitions()
    return recorder.episodes, visited if job.algorithm == OWN else translate(transfer, visited)


def translate(transfer: Transfer, visited: Transitions) -> Transitions:
    """
    Translate for each state visited, with each action, the one instance that weighs most there.

    :param transfer: bound to the target, and with what it has observed of it
    :param visited: transitions of the target, raw units; only the states count
    :return: translated transitions, raw units, within the bounds of the states; none where nothing is transferred
    """
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
    return visited._replace(states=states, actions=actions, rewards=rewards, next_states=next_states, terminated=terminated)


def fill(buffer: ReplayBuffer, transitions: Transitions, env: RescaleObservation) -> None:
    """
    Add transitions to a replay buffer, each on its own: returns over several steps must not go on into the next one.

    :param transitions: raw units
    :param env: scales them
    """
    starts, ends = (env.observation(states) for states in (transitions.states, transitions.next_states))
    columns = starts, ends, transitions.actions, transitions.rewards, transitions.terminated
    for start, end, action, reward, terminated in zip(*columns, strict=True):
        # Ended by a time limit: learnt from as a single step, with the value of where it ends.
        infos = [{"TimeLimit.truncated": not terminated}]
        buffer.add(start[None], end[None], np.array([action]), np.array([reward]), np.array([True]), infos)


def evaluation_steps(total_timesteps: int) -> list[int]:
    """Return the numbers of steps after which to evaluate, evenly spaced on a logarithmic axis; the last is all of them."""
    spaced = np.geomspace(max(1.0, FIRST_EVALUATION * total_timesteps), total_timesteps, N_EVALUATIONS)
    return sorted({round(steps) for steps in spaced.tolist()})


class GreedyEvaluator(BaseCallback):
    """
    Plays episodes without exploration after some numbers of steps, each time from the same starts.

    :param at: numbers of steps, ascending; those of steps made before are left out
    :param env: the environment to play in, with a time limit
    :param seed: its seed
    :param n_before: steps that were made before this learning, and count
    """

    def __init__(self, at: Sequence[int], env: gym.Env, seed: int, n_before: int = 0):
        super().__init__()
        self._at = frozenset(at)
        self._env = env
        self._seed = seed
        self._n_before = n_before
        self._rows: list[tuple[int, float, float]] = []

    @property
    def evaluations(self) -> Evaluations:
        """What was measured so far."""
        steps, returns, reached = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        return Evaluations(np.array(steps, dtype=np.int64), np.array(returns, dtype=float), np.array(reached, dtype=float))

    def _on_step(self) -> bool:
        n_steps = self._n_before + self.num_timesteps
        if n_steps in self._at:
            played = play(self.model, self._env, EVALUATION_EPISODES, self._seed, keeps_state=False)
            self._rows.append((n_steps, float(played.returns.mean()), float(played.terminated.mean())))
        return True
