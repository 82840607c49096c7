"""The MuJoCo model of the ball-striking tasks: the scene in ``assets``, with only those joints that a task moves."""

import importlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from combrel_envs import rendering

rendering.import_dm_control()

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

from combrel_envs.icub_tasks import JOINTS, Strike  # noqa: E402

SCENE = Path(__file__).parent / "assets" / "icub_scene.xml"
#: Geoms of the robot that collide: those that strike the ball or touch the table. More would cost time.
HAND = ("r_fingers", "r_palm")
#: The robot's outermost body, and its name in the URDF of the meshes.
_ROBOT = "icub"
_ROOT_LINK = "root_link"
#: The robot whose kinematics the model has, in the package ``icub_models``.
_MESHES = "iCubGazeboV2_5"
#: Groups of geoms that are drawn and that are not.
_DRAWN, _HIDDEN = 1, 3


def make_model(strike: Strike, look: str) -> mujoco.MjModel:
    """Compile the model of a task; its joints are the task's, in their order, and then the ball's.

    :param look: ``"primitives"``, or ``"meshes"`` for those of the package ``icub_models``
    :raises ModuleNotFoundError: when the meshes aren't installed
    """
    spec = mujoco.MjSpec.from_file(str(SCENE))
    robot = spec.body(_ROBOT)
    if look == "meshes":
        _add_meshes(spec, robot)
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
                turn, turned = np.zeros(4), np.zeros(4)
                angle = np.deg2rad(strike.fixed.get(joint.name, 0.0))
                mujoco.mju_axisAngle2Quat(turn, np.asarray(joint.axis, np.float64), angle)
                mujoco.mju_mulQuat(turned, np.asarray(body.quat, np.float64), turn)
                body.quat = turned
                spec.delete(joint)


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


class _Visual(NamedTuple):
    """A mesh of a link: its file, scale, colour, and its place in the frame of a body of the model."""

    file: Path
    scale: np.ndarray
    rgba: np.ndarray
    pos: np.ndarray
    quat: np.ndarray


def _add_meshes(spec: mujoco.MjSpec, robot: mujoco.MjsBody) -> None:
    """Draw the robot's meshes and hide its primitives. They have no mass and don't collide: the dynamics stay as they are."""
    visuals = _read_urdf(_find_urdf())
    for body in _with_descendants(robot):
        for geom in body.geoms:
            geom.group = _HIDDEN
        for number, visual in enumerate(visuals.get(_ROOT_LINK if body.name == _ROBOT else body.name, [])):
            name = f"{body.name}_mesh_{number}"
            # An STL file is a surface; whether it is closed doesn't matter here.
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=name, file=str(visual.file), scale=visual.scale, inertia=shell)
            geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=visual.pos, quat=visual.quat)
            geom.contype = geom.conaffinity = 0
            geom.mass, geom.group, geom.rgba = 0.0, _DRAWN, visual.rgba


def _find_urdf() -> Path:
    try:
        icub_models = importlib.import_module("icub_models")
    except ModuleNotFoundError as error:
        advice = "look='meshes' needs icub_models; install it with pip install 'sb3-combrel[icub]', or use look='primitives'"
        raise ModuleNotFoundError(advice, name="icub_models") from error
    return icub_models.get_model_file(_MESHES)


def _read_urdf(urdf: Path) -> dict[str, list[_Visual]]:
    """The meshes of each link, those of rigidly attached links included."""
    robot = ET.parse(urdf).getroot()
    # .../iCub/robots/<name>/model.urdf; package://iCub is .../iCub.
    package = urdf.parents[2]
    visuals = {link.attrib["name"]: list(_visuals_of(link, package)) for link in robot.iterfind("link")}
    for joint in robot.iterfind("joint[@type='fixed']"):
        links = {end.tag: end.attrib["link"] for end in joint if end.tag in ("parent", "child")}
        pos, quat = _pose(joint)
        visuals[links["parent"]] += [_moved(visual, pos, quat) for visual in visuals[links["child"]]]
    return visuals


def _visuals_of(link: ET.Element, package: Path) -> Iterator[_Visual]:
    for visual in link.iterfind("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is None:
            continue
        file = package / mesh.attrib["filename"].removeprefix("package://iCub/")
        colour = visual.find("material/color")
        rgba = _numbers("0.9 0.9 0.9 1" if colour is None else colour.attrib["rgba"])
        yield _Visual(file, _numbers(mesh.attrib.get("scale", "1 1 1")), rgba, *_pose(visual))


def _pose(element: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of an element's origin; a URDF turns about the fixed axes x, y and z, in this order."""
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, _numbers(attributes.get("rpy", "0 0 0")), "XYZ")
    return _numbers(attributes.get("xyz", "0 0 0")), quat


def _moved(visual: _Visual, pos: np.ndarray, quat: np.ndarray) -> _Visual:
    """The same mesh, seen from the frame in which its own frame has the given pose."""
    moved_pos, moved_quat = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(moved_pos, visual.pos, quat)
    mujoco.mju_mulQuat(moved_quat, quat, visual.quat)
    return visual._replace(pos=moved_pos + pos, quat=moved_quat)


def _numbers(text: str) -> np.ndarray:
    return np.array(text.split(), dtype=np.float64)
