"""Pendulum to Acrobot, both in angles, which are periodic: nobody knows how they correspond."""

import gymnasium as gym
from gymnasium.wrappers import DiscretizeAction

from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.suite.tasks import ACROBOT, make_acrobot
from sb3_combrel.runs.job import make_env
from sb3_combrel.wrappers import AngleObservation


def make_pendulum() -> gym.Env:
    """Make the pendulum with three torques, as many as the acrobot has."""
    return AngleObservation(DiscretizeAction(make_env("Pendulum-v1", disable_env_checker=True), bins=3))


PAIR = Pair(
    name="pendulum-acrobot",
    description=(
        "Pendulum-v1, three torques, to Acrobot-v1, both in angles. Rewards differ: the pendulum's depends on its state, the "
        "acrobot's is -1 until it is up. Nobody knows a mapping: the acrobot's links are pendulums that pull each other."
    ),
    sources=(recorded("pendulum", make_pendulum, gamma=0.97, n_episodes=10),),
    target=make_acrobot,
    n_steps=5000,
    threshold=-120.0,
    learner=ACROBOT,
)
