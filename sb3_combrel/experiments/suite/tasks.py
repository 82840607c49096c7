"""The tasks of the suite: environment, budget, measures. The learner is told nothing of them, but for a target of transfer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_combrel.common.checks import check_count
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.experiments.suite.measures import (
    Measure,
    mean_return_in,
    mean_steps_in,
    steps_in,
    steps_until_always,
    steps_until_first_end,
    steps_until_median,
)
from sb3_combrel.experiments.tasks import cart_pole, icub_arm, mountain_car
from sb3_combrel.experiments.tasks.point_robot import make_point_robot
from sb3_combrel.experiments.tasks.swing_ups import make_car, make_dm_cart_pole, make_dm_pendulum, make_pendulum
from sb3_combrel.runs.job import make_env
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.wrappers import AngleObservation


class NoisyActions(gym.ActionWrapper):
    """Replaces a Discrete action, with a probability, by one drawn uniformly from all, by the environment's generator."""

    def __init__(self, env: gym.Env, probability: float = 0.1):
        super().__init__(env)
        if not 0.0 <= probability <= 1.0:
            raise ValueError(f"probability must be in [0, 1], got {probability!r}")
        self.probability = probability

    def action(self, action: Any) -> Any:
        """Return the action, or another one in its place."""
        assert isinstance(self.action_space, gym.spaces.Discrete)
        if self.np_random.random() >= self.probability:
            return action
        return int(self.action_space.start + self.np_random.integers(self.action_space.n))


@dataclass(frozen=True)
class Source:
    """A source task of transfer. Each run has a source of its own, recorded with the seed of the run."""

    name: str  # of its files
    learn: Callable[[int], SourceInstances]  # learns it with a seed and returns its instances


@dataclass(frozen=True)
class Task:
    """A task to learn, and how learning it is measured. Exactly one of ``n_steps`` and ``n_episodes`` is given.

    :raises ValueError: if both or none of ``n_steps`` and ``n_episodes`` are given
    """

    name: str  # in tables and on the command line
    make: Callable[[], gym.Env]  # makes the environment; its seed is that of the run
    learner: Mapping[str, Any] = field(default_factory=dict)  # of FittedRMax, that describe the task: gamma, max_value, bounds
    n_steps: int | None = None  # steps to learn
    n_episodes: int | None = None  # episodes to learn
    measures: tuple[Measure, ...] = ()  # of the episodes of learning
    headline: str = "greedy_mean"  # the column that stands for the task in the overview, a measure or one of the evaluation
    failure_return: float | None = None  # an episode with at most this return is a failure; None: one that a time limit ends
    source: Source | None = None  # source task for transfer

    def __post_init__(self) -> None:
        check_budget(self.name, self.n_steps, self.n_episodes)


def check_budget(name: str, n_steps: int | None, n_episodes: int | None) -> None:
    """:raises ValueError: unless exactly one of the numbers is given, at least 1"""
    if (n_steps is None) == (n_episodes is None):
        raise ValueError(f"{name}: either n_steps or n_episodes must be given, got {n_steps!r} and {n_episodes!r}")
    check_count("n_steps", n_steps, none_allowed=True)
    check_count("n_episodes", n_episodes, none_allowed=True)


def make_acrobot() -> gym.Env:
    """Make the acrobot with its two angles in place of their cosines and sines."""
    return AngleObservation(make_env("Acrobot-v1", disable_env_checker=True))


def make_noisy(env_id: str, **kwargs: Any) -> gym.Env:
    """Make an environment in which every tenth action is a random one; see ``gymnasium.make``."""
    return NoisyActions(make_env(env_id, **kwargs))


#: Steps after which an episode of combrel's Mountain Cars is cut off.
CAP = 2000
#: As in zoo_configs/fitted_rmax.yml: the bounds of the velocities leave out what the swing-up does not reach.
ACROBOT: dict[str, Any] = {"gamma": 0.99, "bounds": ([-np.pi, -np.pi, -7.0, -12.0], [np.pi, np.pi, 7.0, 12.0])}

#: A twentieth of the robot's step. Without any it visits the points of a lattice only, which is a case of its own.
SLIGHT_NOISE = 0.003

CAR_2D = Source("mountain_car_2d", mountain_car.learn_source)
TORSO = Source("icub_torso", icub_arm.learn_source)
CART_POLE = Source("cart_pole", cart_pole.learn_source)

_car_2d = partial(make_env, mountain_car.SOURCE_ID, max_episode_steps=CAP)
_car_4d = partial(make_env, mountain_car.TARGET_ID, max_episode_steps=CAP)
_car_6d = partial(make_env, "combrel/MountainCar6D-v0", max_episode_steps=CAP)
_gym_car = partial(make_env, "MountainCar-v0", disable_env_checker=True)
_cart_pole = cart_pole.make_cart_pole
_long_cart_pole = partial(cart_pole.make_cart_pole, cart_pole.LONG, cart_pole.ORDER)
_noisy_car_2d = partial(make_noisy, mountain_car.SOURCE_ID, max_episode_steps=CAP)
_noisy_gym_car = partial(make_noisy, "MountainCar-v0", disable_env_checker=True)

_TWELVE = steps_in(1, 12)
_LAST_OF_60 = mean_steps_in(41, 60)
_LAST_OF_50 = mean_steps_in(41, 50)
_FIRST_8 = mean_steps_in(1, 8)
_FIRST_EPISODE = mean_return_in(1, 1)
_FIRST_3 = mean_return_in(1, 3)
_TORSO_SETTLED = steps_until_always(27)
_NEAR_50 = steps_until_median(50)
_FIRST_HIT = steps_until_first_end()
# 475 is Gymnasium's own threshold.
_FALLEN = 474.0
# A pendulum that never swings up has about -1000 or less; no return of dm_control's tasks is a failure of its own.
_NOT_UP, _NEVER = -800.0, -1.0

_ALL = (
    Task("MountainCar4D", _car_4d, n_episodes=12, measures=(_TWELVE,), headline=_TWELVE.name, source=CAR_2D),
    Task(
        "MountainCar4D-60", _car_4d, n_episodes=60, measures=(_TWELVE, _LAST_OF_60), headline=_LAST_OF_60.name, source=CAR_2D
    ),
    Task("MountainCar2D", _car_2d, n_episodes=50, measures=(_LAST_OF_50,), headline=_LAST_OF_50.name),
    Task("MountainCar2D-noisy", _noisy_car_2d, n_episodes=50, measures=(_LAST_OF_50,), headline=_LAST_OF_50.name),
    Task("MountainCar-v0", _gym_car, n_steps=1500),
    Task("MountainCar-v0-noisy", _noisy_gym_car, n_steps=3000),
    Task("Acrobot-v1", make_acrobot, n_steps=6000),
    Task("Acrobot-v1-15000", make_acrobot, n_steps=15_000),
    Task("CartPole-v1", _cart_pole, n_steps=3000, failure_return=_FALLEN),
    Task(
        "CartPole-long",
        _long_cart_pole,
        cart_pole.LONG_LEARNER,
        n_steps=5000,
        # Both the jumpstart and, as the headline, what is left of it after learning.
        measures=(_FIRST_EPISODE, _FIRST_3),
        failure_return=_FALLEN,
        source=CART_POLE,
    ),
    Task("Pendulum-v1", make_pendulum, n_steps=1000, failure_return=_NOT_UP),
    Task("MountainCarContinuous-v0", make_car, n_steps=3000),
    Task("dm_control-pendulum", make_dm_pendulum, n_steps=3000, failure_return=_NEVER),
    Task("dm_control-cart-pole", make_dm_cart_pole, n_steps=5000, failure_return=_NEVER),
    *(
        Task(
            f"ICubTorso{suffix}",
            partial(make_env, f"combrel/ICubTorsoStrike{noisy}-v0"),
            n_steps=4000,
            measures=(_TORSO_SETTLED, _NEAR_50),
            headline=headline,
        )
        # With noise now and then an episode needs more than 27 commands, however good the policy.
        for suffix, noisy, headline in (("", "", _TORSO_SETTLED.name), ("-noisy", "Noisy", _NEAR_50.name))
    ),
    *(
        Task(
            f"ICubArm{suffix}",
            partial(make_env, f"combrel/ICubArmStrike{noisy}-v0"),
            n_steps=10_000,
            measures=(_NEAR_50, _FIRST_HIT),
            headline=_NEAR_50.name,
            source=TORSO,
        )
        for suffix, noisy in (("", ""), ("-noisy", "Noisy"))
    ),
    Task("MountainCar6D", _car_6d, n_episodes=8, measures=(_FIRST_8,), headline=_FIRST_8.name, source=CAR_2D),
    *(
        Task(f"PointRobot{suffix}", partial(make_point_robot, n_variables, noise, start), n_steps=5000)
        for suffix, n_variables, noise, start in (
            ("2D", 2, SLIGHT_NOISE, "fixed"),
            ("3D", 3, SLIGHT_NOISE, "fixed"),
            ("3D-exact", 3, 0.0, "fixed"),
            ("3D-random", 3, SLIGHT_NOISE, "random"),
        )
    ),
)
TASKS: dict[str, Task] = {task.name: task for task in _ALL}


def tasks_of(names: list[str]) -> list[Task]:
    """Return the tasks of some names, or of "all" alone."""
    if names == ["all"]:
        return list(TASKS.values())
    unknown = [name for name in names if name not in TASKS]
    if unknown or not names:
        close = did_you_mean(unknown[0], TASKS) if unknown else ""
        raise ValueError(f"tasks must be 'all' or some of {', '.join(TASKS)}, got {names!r}{close}")
    return [TASKS[name] for name in dict.fromkeys(names)]
