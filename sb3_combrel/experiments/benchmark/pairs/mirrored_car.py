"""MountainCar-v0 to itself: its variables change places, one is mirrored, and the actions have other numbers."""

import functools

import gymnasium as gym

from sb3_combrel import FactoredMapping
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.tasks.disguised import disguise, disguised
from sb3_combrel.runs.job import make_env

ORDER, SIGNS, ACTIONS = (1, 0), (1, -1), (2, 0, 1)
make_car = functools.partial(make_env, "MountainCar-v0", disable_env_checker=True)
SOURCE = recorded("gym_mountain_car", make_car, "q_learning")


def make_disguised() -> gym.Env:
    """Make the target."""
    return disguised(make_car(), ORDER, SIGNS, ACTIONS)


PAIR = Pair(
    name="mirrored-car",
    description=(
        "MountainCar-v0 to itself with its variables in the other order, the position mirrored, and the actions renamed. The "
        "known mapping is exact."
    ),
    sources=(SOURCE,),
    target=make_disguised,
    n_steps=2000,
    threshold=-120.0,
    known=FactoredMapping((disguise(ORDER, SIGNS, ACTIONS),)),
    known_by_action=disguise(ORDER, SIGNS, ACTIONS),
    mappings="signed_factored",
    instance_mappings="signed_injective",
)
