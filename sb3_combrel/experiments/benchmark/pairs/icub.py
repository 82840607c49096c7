"""The iCub's torso is the source of its arm, both striking a ball (Section 5.2 of the COMBREL paper)."""

from sb3_combrel import FactoredMapping, InterTaskMapping
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.suite.tasks import STRIKE, TORSO
from sb3_combrel.experiments.tasks import icub_arm

PITCH, YAW = 0, 1
# Actions of the torso: 2k moves joint k in the negative, 2k + 1 in the positive direction.
N_JOINTS = 4


def moves_like_yaw(joint: int) -> InterTaskMapping:
    """
    Map one joint of the arm to the torso's yaw.

    :param joint: of the arm; commands to others leave it where it is, as commands to the torso's pitch leave the yaw
    """
    state = [YAW if k == joint else None for k in range(N_JOINTS)]
    action = [2 * YAW + a % 2 if a // 2 == joint else 2 * PITCH for a in range(2 * N_JOINTS)]
    return InterTaskMapping(tuple(state), tuple(action))


# The torso's pitch would do as well, but the table stops it, where it stops no joint of the arm.
COPIES = tuple(moves_like_yaw(joint) for joint in range(N_JOINTS))

PAIR = Pair(
    name="icub",
    description=(
        "The iCub's torso to its right arm, two joints to four, both strike a ball. Known, to the length of a move: a command "
        "moves a joint as the same kind of command moves the torso's yaw, and leaves the others. The ball's place is not."
    ),
    sources=(TORSO,),
    target=icub_arm.TARGET_ID,
    n_steps=5000,
    threshold=50.0,
    learner=STRIKE,
    known=FactoredMapping(COPIES),
    known_by_action=tuple(COPIES[a // 2] for a in range(2 * N_JOINTS)),
)
