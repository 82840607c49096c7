"""The iCub's true shape, from the meshes of the PyPI package ``icub_models``: drawn instead of the primitive geoms."""

import importlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

#: The robot whose kinematics the model has.
_ROBOT = "iCubGazeboV2_5"
#: Geoms of this group are not drawn.
_HIDDEN = 3
_DRAWN = 1
#: Bodies of the model that have another name in the URDF.
_ROOT_LINKS = {"icub": "root_link"}


class _Visual(NamedTuple):
    """A mesh of a link: its file, scale, colour, and its place in the frame of a body of the model."""

    file: Path
    scale: np.ndarray
    rgba: np.ndarray
    pos: np.ndarray
    quat: np.ndarray


def add_meshes(spec: mujoco.MjSpec, robot: mujoco.MjsBody) -> None:
    """
    Draw the robot's meshes and hide its primitives. Meshes have no mass and don't collide: the dynamics stay as they are.

    :param spec: the scene
    :param robot: its outermost body
    :raises ModuleNotFoundError: when ``icub_models`` isn't installed
    """
    urdf = _find_urdf()
    visuals = _read_urdf(urdf)
    for body in [robot, *robot.find_all(mujoco.mjtObj.mjOBJ_BODY)]:
        for geom in body.geoms:
            geom.group = _HIDDEN
        for number, visual in enumerate(visuals.get(_ROOT_LINKS.get(body.name, body.name), [])):
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
    return icub_models.get_model_file(_ROBOT)


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
