"""A point robot and a mountain car, which have nothing in common: the right answer is to transfer nothing."""

from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.pairs.mirrored_car import make_car
from sb3_combrel.experiments.benchmark.pairs.point_robot import ROBOT_2D

PAIR = Pair(
    name="nothing-in-common",
    description=(
        "A point robot among walls to MountainCar-v0. The robot's moves are long, the same everywhere, and stop with the "
        "command; the car's depend on the hill and on its velocity. The right answer is to transfer nothing."
    ),
    sources=(ROBOT_2D,),
    target=make_car,
    n_steps=2000,
    threshold=-120.0,
)
