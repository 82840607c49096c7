"""The pairs of tasks of the benchmark, each in a file of its own that defines ``PAIR``."""

from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.pairs import (
    cart_pole,
    icub,
    mirrored_car,
    mountain_car,
    nothing_in_common,
    pendulum_acrobot,
    point_robot,
    two_sources,
)

_MODULES = (mountain_car, icub, mirrored_car, cart_pole, pendulum_acrobot, point_robot, two_sources, nothing_in_common)
#: By name, in the order of the report.
PAIRS: dict[str, Pair] = {module.PAIR.name: module.PAIR for module in _MODULES}
