"""Constants of the iCub's ball-striking tasks, without MuJoCo; all angles in degrees, as the iCub's encoders report them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

#: Steps until an episode is truncated.
MAX_EPISODE_STEPS = 400
#: Reward of a step, and what is added to it when the step hits the ball.
STEP_REWARD = -1.0
HIT_REWARD = 100.0

#: How far a command moves a joint, in degrees.
EXTENT = 2.0
#: Noise of the stochastic variants. Motors: standard deviation as a fraction of the extent. Encoders: in degrees.
NOISE = {"motor_noise": 0.1, "encoder_noise": 0.2}

#: Horizontal distance in metres that the ball must move to count as hit: far above numerical drift, still "even slightly".
HIT_DISTANCE = 0.002

LOOKS = ("primitives", "meshes")


class Joint(NamedTuple):
    """A joint that a task moves: its limits in degrees, and the stiffness of its position controller in Nm/rad."""

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
    """One of the tasks."""

    prefix: str  # first letter of the action names
    start: Mapping[str, float]  # where an episode begins: the task's joints, in the order of its observation
    fixed: Mapping[str, float]  # angles of the joints that do not move, where they differ from 0

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the observation's entries: the joints."""
        return tuple(self.start)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the actions: ``S1-`` moves the first joint of the source task in the negative direction."""
        return tuple(f"{self.prefix}{k + 1}{sign}" for k in range(len(self.start)) for sign in "-+")


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


def check_start(start: Any, strike: Strike) -> tuple[float, ...]:
    """Return the start's angles, in degrees; None: the task's; ``ValueError`` unless one for each joint, within its limits."""
    if start is None:
        return tuple(strike.start.values())
    try:
        angles = tuple(float(angle) for angle in start)
    except (TypeError, ValueError):
        angles = ()
    if len(angles) != len(strike.start):
        raise ValueError(f"start must be {len(strike.start)} angles in degrees ({', '.join(strike.start)}), got {start!r}")
    for name, angle in zip(strike.start, angles, strict=True):
        joint = JOINTS[name]
        if not joint.low <= angle <= joint.high:
            raise ValueError(f"start: {name} must lie between {joint.low:g} and {joint.high:g} degrees, got {angle:g}")
    return angles
