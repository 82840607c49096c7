"""The MuJoCo model of the ball-striking tasks: the scene in ``assets``, with only those joints that a task moves."""

from collections.abc import Mapping
from pathlib import Path

from combrel_envs import rendering

rendering.import_dm_control()

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

from combrel_envs.icub_meshes import add_meshes  # noqa: E402
from combrel_envs.icub_tasks import JOINTS, Strike  # noqa: E402

SCENE = Path(__file__).parent / "assets" / "icub_scene.xml"
#: Geoms of the robot that collide: those that strike the ball or touch the table. More would cost time.
HAND = ("r_fingers", "r_palm")
#: The robot's outermost body.
_ROBOT = "icub"


def make_model(strike: Strike, look: str) -> mujoco.MjModel:
    """
    Compile the model of a task.

    :param strike: the task
    :param look: ``"primitives"``, or ``"meshes"`` for those of the package ``icub_models``; the dynamics are the same
    :return: the compiled model; its joints are the task's, in their order, and then the ball's
    :raises ModuleNotFoundError: when the meshes aren't installed
    """
    spec = mujoco.MjSpec.from_file(str(SCENE))
    robot = spec.body(_ROBOT)
    if look == "meshes":
        add_meshes(spec, robot)
    _weld_others(spec, robot, strike)
    for name in strike.state_names:
        _add_controller(spec, name)
    # The robot's own controllers compensate for its weight.
    for body in _with_descendants(robot):
        body.gravcomp = 1
    for name in HAND:
        spec.geom(name).contype = spec.geom(name).conaffinity = 1
    return spec.compile()


def _weld_others(spec: mujoco.MjSpec, robot: mujoco.MjsBody, strike: Strike) -> None:
    """Turn the bodies whose joint the task doesn't move to their fixed angles, and remove the joints."""
    for body in _with_descendants(robot):
        for joint in body.joints:
            if joint.name not in strike.start:
                body.quat = _turned(body.quat, joint.axis, _angle(joint.name, strike.fixed))
                spec.delete(joint)


def _angle(joint: str, fixed: Mapping[str, float]) -> float:
    return np.deg2rad(fixed.get(joint, 0.0))


def _turned(quat: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    turn, result = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.asarray(axis, np.float64), angle)
    mujoco.mju_mulQuat(result, np.asarray(quat, np.float64), turn)
    return result


def _add_controller(spec: mujoco.MjSpec, name: str) -> None:
    """Control a joint's position, critically damped, within the true limits."""
    joint = JOINTS[name]
    limits = np.deg2rad([joint.low, joint.high])
    spec.joint(name).range = limits
    controller = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    controller.set_to_position(kp=joint.stiffness, dampratio=1.0)
    controller.ctrlrange = limits
    controller.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE


def _with_descendants(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    return [body, *body.find_all(mujoco.mjtObj.mjOBJ_BODY)]
