"""Mountain Car in two dimensions is the source of Mountain Car in four (Section 5.1 of the COMBREL paper)."""

import functools

from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.suite.tasks import CAP, CAR_2D
from sb3_combrel.experiments.tasks import mountain_car
from sb3_combrel.runs.job import make_env

PAIR = Pair(
    name="mountain-car",
    description="Mountain Car in two dimensions to four. Known: two cars, one along each axis; an action pushes one of them.",
    sources=(CAR_2D,),
    target=functools.partial(make_env, mountain_car.TARGET_ID, max_episode_steps=CAP),
    n_episodes=20,
    threshold=-220.0,
    known=mountain_car.factored_mapping(2),
    known_by_action=mountain_car.intuitive_mapping(),
)
