"""The pairs of tasks of the benchmark."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
from gymnasium.wrappers import DiscretizeAction

from sb3_combrel import FactoredMapping, InterTaskMapping
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.suite.tasks import ACROBOT, CAP, CAR_2D, CART_POLE, SLIGHT_NOISE, TORSO, make_acrobot
from sb3_combrel.experiments.tasks import cart_pole, icub_arm, mountain_car
from sb3_combrel.experiments.tasks.cart_with_pendulum import make_cart_with_pendulum
from sb3_combrel.experiments.tasks.disguised import disguise, disguised
from sb3_combrel.experiments.tasks.point_robot import make_point_robot
from sb3_combrel.runs.job import make_env
from sb3_combrel.wrappers import AngleObservation

# Mountain Car in two dimensions is the source of Mountain Car in four (Section 5.1 of the COMBREL paper).
MOUNTAIN_CAR = Pair(
    name="mountain-car",
    description="Mountain Car in two dimensions to four. Known: two cars, one along each axis; an action pushes one of them.",
    sources=(CAR_2D,),
    target=partial(make_env, mountain_car.TARGET_ID, max_episode_steps=CAP),
    n_episodes=20,
    threshold=-220.0,
    known=mountain_car.factored_mapping(2),
    known_by_action=mountain_car.intuitive_mapping(),
)

# The iCub's torso is the source of its arm, both striking a ball (Section 5.2).
PITCH, YAW = 0, 1
# Actions of the torso: 2k moves joint k in the negative, 2k + 1 in the positive direction.
N_JOINTS = 4


def moves_like_yaw(joint: int) -> InterTaskMapping:
    """Map one joint of the arm to the torso's yaw; commands to others leave it where it is, as the pitch's leave the yaw."""
    state = [YAW if k == joint else None for k in range(N_JOINTS)]
    action = [2 * YAW + a % 2 if a // 2 == joint else 2 * PITCH for a in range(2 * N_JOINTS)]
    return InterTaskMapping(tuple(state), tuple(action))


# The torso's pitch would do as well, but the table stops it, where it stops no joint of the arm.
JOINT_COPIES = tuple(moves_like_yaw(joint) for joint in range(N_JOINTS))

ICUB = Pair(
    name="icub",
    description=(
        "The iCub's torso to its right arm, two joints to four, both strike a ball. Known, to the length of a move: a command "
        "moves a joint as the same kind of command moves the torso's yaw, and leaves the others. The ball's place is not."
    ),
    sources=(TORSO,),
    target=icub_arm.TARGET_ID,
    n_steps=5000,
    threshold=50.0,
    learner=icub_arm.LEARNER,
    known=FactoredMapping(JOINT_COPIES),
    known_by_action=tuple(JOINT_COPIES[a // 2] for a in range(2 * N_JOINTS)),
)

ORDER, SIGNS, ACTIONS = (1, 0), (1, -1), (2, 0, 1)
make_car = partial(make_env, "MountainCar-v0", disable_env_checker=True)
GYM_CAR = recorded("gym_mountain_car", make_car, "q_learning")


def make_disguised_car() -> gym.Env:
    """Make MountainCar-v0 with its variables exchanged, one mirrored, and other numbers of the actions."""
    return disguised(make_car(), ORDER, SIGNS, ACTIONS)


MIRRORED_CAR = Pair(
    name="mirrored-car",
    description=(
        "MountainCar-v0 to itself with its variables in the other order, the position mirrored, and the actions renamed. The "
        "known mapping is exact."
    ),
    sources=(GYM_CAR,),
    target=make_disguised_car,
    n_steps=2000,
    threshold=-120.0,
    known=FactoredMapping((disguise(ORDER, SIGNS, ACTIONS),)),
    known_by_action=disguise(ORDER, SIGNS, ACTIONS),
    mappings="signed_factored",
    instance_mappings="signed_injective",
)

#: Half the length of the pole, 0.5 in CartPole-v1. With twice that, the right mapping would predict twice the angular effects
#: of a push, which is no better than none.
HALF_LENGTH = 0.7

LONGER_POLE = Pair(
    name="cart-pole",
    description="CartPole-v1 to a pole of 1.4 times the length, variables in another order. Known but for the length.",
    sources=(CART_POLE,),
    target=partial(cart_pole.make_cart_pole, HALF_LENGTH, cart_pole.ORDER),
    n_steps=5000,
    threshold=400.0,
    learner=cart_pole.LONG_LEARNER,
    known=FactoredMapping((cart_pole.right_mapping(),)),
    known_by_action=cart_pole.right_mapping(),
)


def make_pendulum_of_three() -> gym.Env:
    """Make the pendulum with three torques, as many as the acrobot has."""
    return AngleObservation(DiscretizeAction(make_env("Pendulum-v1", disable_env_checker=True), bins=3))


PENDULUM_ACROBOT = Pair(
    name="pendulum-acrobot",
    description=(
        "Pendulum-v1, three torques, to Acrobot-v1, both in angles. Rewards differ: the pendulum's depends on its state, the "
        "acrobot's is -1 until it is up. Nobody knows a mapping: the acrobot's links are pendulums that pull each other."
    ),
    sources=(recorded("pendulum", make_pendulum_of_three, gamma=0.97, n_episodes=10),),
    target=make_acrobot,
    n_steps=5000,
    threshold=-120.0,
    learner=ACROBOT,
)

ROBOT_2D = recorded("point_robot_2d", partial(make_point_robot, 2, SLIGHT_NOISE, "random"))

# Moves along the third axis are like moves along the second, which no wall stands across. With them the first stays.
IN_PLANE = InterTaskMapping(state=(0, 1, None), action=(0, 1, 2, 3, 2, 3))
UPWARD = InterTaskMapping(state=(None, None, 1), action=(0, 1, 2, 3, 2, 3))

POINT_ROBOT = Pair(
    name="point-robot",
    description=(
        "A point among walls, from two variables to three; walls are as they were, and stand along the third axis too. Known: "
        "in the plane everything is the same, and the third axis is like the second, which no wall bars."
    ),
    sources=(ROBOT_2D,),
    target=partial(make_point_robot, 3, SLIGHT_NOISE, "random"),
    n_steps=5000,
    threshold=-60.0,
    known=(*[IN_PLANE] * 4, *[UPWARD] * 2),
    known_by_action=(*[IN_PLANE] * 4, *[UPWARD] * 2),
)

CART = recorded("cart", partial(make_cart_with_pendulum, "cart"), n_instances=500, n_episodes=30)
PENDULUM = recorded("pendulum_alone", partial(make_cart_with_pendulum, "pendulum"), n_episodes=50)

# Actions of the target: nothing, a push to either side, a torque in either direction.
OF_CART = InterTaskMapping(state=(0, 1, None, None), action=(0, 1, 2, 0, 0))
OF_PENDULUM = InterTaskMapping(state=(None, None, 0, 1), action=(0, 0, 0, 1, 2))

TWO_SOURCES = Pair(
    name="two-sources",
    description=(
        "Two sources, a cart on a track and a pendulum with a motor, to a cart that carries the pendulum. Known but for the "
        "pull of the cart on the pendulum: each part is one of the sources, and an action moves one of them."
    ),
    sources=(CART, PENDULUM),
    target=make_cart_with_pendulum,
    n_steps=6000,
    threshold=-120.0,
    known=(FactoredMapping((OF_CART,)), FactoredMapping((OF_PENDULUM,))),
    known_by_action=(OF_CART, OF_CART, OF_CART, OF_PENDULUM, OF_PENDULUM),
    sources_by_action=(0, 0, 0, 1, 1),
)

NOTHING_IN_COMMON = Pair(
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

_PAIRS = (MOUNTAIN_CAR, ICUB, MIRRORED_CAR, LONGER_POLE, PENDULUM_ACROBOT, POINT_ROBOT, TWO_SOURCES, NOTHING_IN_COMMON)
#: By name, in the order of the report.
PAIRS: dict[str, Pair] = {pair.name: pair for pair in _PAIRS}
