"""A point robot among walls, from two variables to three."""

import functools

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.suite.tasks import SLIGHT_NOISE
from sb3_combrel.experiments.tasks.point_robot import make_point_robot

ROBOT_2D = recorded("point_robot_2d", functools.partial(make_point_robot, 2, SLIGHT_NOISE, "random"))

# Moves along the third axis are like moves along the second, which no wall stands across. With them the first stays.
IN_PLANE = InterTaskMapping(state=(0, 1, None), action=(0, 1, 2, 3, 2, 3))
UPWARD = InterTaskMapping(state=(None, None, 1), action=(0, 1, 2, 3, 2, 3))

PAIR = Pair(
    name="point-robot",
    description=(
        "A point among walls, from two variables to three; walls are as they were, and stand along the third axis too. Known: "
        "in the plane everything is the same, and the third axis is like the second, which no wall bars."
    ),
    sources=(ROBOT_2D,),
    target=functools.partial(make_point_robot, 3, SLIGHT_NOISE, "random"),
    n_steps=5000,
    threshold=-60.0,
    known=(*[IN_PLANE] * 4, *[UPWARD] * 2),
    known_by_action=(*[IN_PLANE] * 4, *[UPWARD] * 2),
)
