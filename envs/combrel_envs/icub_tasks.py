"""Constants of the iCub's ball-striking tasks and checks of their options, without MuJoCo.

All angles are in degrees, as the iCub's encoders report them.
"""

import math
import numbers
import operator
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, SupportsIndex

#: Steps until an episode is truncated.
MAX_EPISODE_STEPS = 400
#: Reward of a step, and what is added to it when the step hits the ball.
STEP_REWARD = -1.0
HIT_REWARD = 100.0

#: How far a command moves a joint, in degrees.
EXTENT = 2.0
#: Noise of the stochastic variants. Motors: standard deviation as a fraction of the extent. Encoders: in degrees.
NOISY_MOTORS = 0.1
NOISY_ENCODERS = 0.2

#: Horizontal distance in metres that the ball must move to count as hit: far above numerical drift, still "even slightly".
HIT_DISTANCE = 0.002

LOOKS = ("primitives", "meshes")


class Joint(NamedTuple):
    """
    A joint that a task moves.

    :param low: lower limit in degrees
    :param high: upper limit in degrees
    :param stiffness: of the joint's position controller, in Nm/rad
    """

    low: float
    high: float
    stiffness: float


#: Limits of the real robot (iCubGazeboV2_5). With this stiffness a joint reaches its target within a step and still yields
#: to the table.
JOINTS: dict[str, Joint] = {
    "torso_pitch": Joint(-20.0, 70.0, 2500.0),
    "torso_yaw": Joint(-50.0, 50.0, 900.0),
    "r_shoulder_pitch": Joint(-95.5, 10.0, 250.0),
    "r_shoulder_roll": Joint(0.0, 160.8, 450.0),
    "r_shoulder_yaw": Joint(-37.0, 80.0, 130.0),
    "r_elbow": Joint(15.0, 106.0, 80.0),
}


class Strike(NamedTuple):
    """
    One of the tasks.

    :param prefix: first letter of the action names
    :param start: where an episode begins: the task's joints, in the order of its observation
    :param fixed: angles of the joints that do not move, where they differ from 0
    """

    prefix: str
    start: Mapping[str, float]
    fixed: Mapping[str, float]

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the observation's entries: the joints."""
        return tuple(self.start)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the actions: ``S1-`` moves the first joint of the source task in the negative direction."""
        return tuple(f"{self.prefix}{k + 1}{sign}" for k in range(len(self.start)) for sign in "-+")

    @property
    def low(self) -> tuple[float, ...]:
        """Lower limits of the joints."""
        return tuple(JOINTS[name].low for name in self.start)

    @property
    def high(self) -> tuple[float, ...]:
        """Upper limits of the joints."""
        return tuple(JOINTS[name].high for name in self.start)


#: Pose of the left arm and the head, which only affects the look: neither can reach the ball.
_REST = {"l_shoulder_pitch": -10.0, "l_shoulder_roll": 25.0, "l_elbow": 95.0, "neck_pitch": -15.0}

#: "S" for the source task of the paper, "T" for its target task (Table 4, Figure 7).
TASKS: dict[str, Strike] = {
    "torso_strike": Strike(
        "S",
        {"torso_pitch": 0.0, "torso_yaw": 40.0},
        {"r_shoulder_pitch": -75.0, "r_shoulder_roll": 10.0, "r_shoulder_yaw": 0.0, "r_elbow": 15.0, **_REST},
    ),
    "arm_strike": Strike(
        "T",
        {"r_shoulder_pitch": -40.0, "r_shoulder_roll": 40.0, "r_shoulder_yaw": -10.0, "r_elbow": 60.0},
        {"torso_pitch": 15.0, "torso_yaw": 0.0, **_REST},
    ),
}


def check_look(look: Any) -> str:
    """
    Check the name of a look.

    :param look: name of a look
    :return: the same
    :raises ValueError: when there is no such look
    """
    if look not in LOOKS:
        raise ValueError(f"look must be one of {', '.join(map(repr, LOOKS))}, got {look!r}")
    return look


def check_time_limit(seconds: Any) -> None:
    """
    Check a time limit.

    :param seconds: the time limit of a dm_control environment; infinity for none
    :raises ValueError: when it isn't a number above 0
    """
    if isinstance(seconds, bool) or not isinstance(seconds, numbers.Real) or not float(seconds) > 0:
        raise ValueError(f"time_limit must be a number of seconds above 0, got {seconds!r}")


def check_amount(name: str, value: Any, zero: bool) -> float:
    """
    Check that an argument is a finite number above 0, or at least 0.

    :param name: name of an argument
    :param value: its value
    :param zero: whether it may be 0
    :return: the value as a float
    :raises ValueError: when it isn't a finite number, is negative, or is 0 and may not be
    """
    right = f"a finite number {'of at least' if zero else 'above'} 0"
    number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    if not math.isfinite(number) or number < 0 or (number == 0 and not zero):
        raise ValueError(f"{name} must be {right}, got {value!r}")
    return number


def check_start(start: Any, strike: Strike) -> tuple[float, ...]:
    """
    Check the angles at which an episode begins.

    :param start: angles of the task's joints in degrees, or None for the task's own start
    :param strike: the task
    :return: the angles
    :raises ValueError: when they aren't one number for each joint, or one is beyond its joint's limits
    """
    if start is None:
        return tuple(strike.start.values())
    names = ", ".join(strike.start)
    try:
        angles = tuple(float(angle) for angle in start)
    except (TypeError, ValueError) as error:
        raise ValueError(f"start must be {len(strike.start)} angles in degrees ({names}), got {start!r}") from error
    if len(angles) != len(strike.start):
        raise ValueError(f"start must be {len(strike.start)} angles in degrees ({names}), got {start!r}")
    for name, angle in zip(strike.start, angles, strict=True):
        joint = JOINTS[name]
        if not joint.low <= angle <= joint.high:
            raise ValueError(f"start: {name} must lie between {joint.low:g} and {joint.high:g} degrees, got {angle:g}")
    return angles


def check_action(action: SupportsIndex, names: Sequence[str]) -> int:
    """
    Check the number of an action.

    :param action: number of an action
    :param names: names of all actions
    :return: the number
    :raises ValueError: when there is no such action
    """
    try:
        number = operator.index(action)
    except TypeError:
        number = -1
    if not 0 <= number < len(names):
        raise ValueError(f"action must be an integer from 0 to {len(names) - 1} ({', '.join(names)}), got {action!r}")
    return number
