"""The pictures of Mountain Car: the hills as meshes and textures for MuJoCo, and the pose of the car on them.

The hills are ``sin(3x)`` in 2D and ``sin(3x) + sin(3y)`` in 4D, times a scale. In 6D there are two pieces of ground, each with
a car: 4D's for x and y, and in front of it 2D's for z. Except in :func:`model_and_assets` and in ``GROUNDS``, ``n_axes`` is
the number of axes of one piece of ground: 1 or 2.
"""

import functools
import io
import math
from pathlib import Path

import numpy as np
from PIL import Image

from combrel_envs import mountain_car_dynamics as dynamics

#: For each task's number of axes: the bodies of the scene that carry a piece of ground, and the axes that each of them shows.
GROUNDS: dict[int, dict[str, slice]] = {
    1: {"world": slice(0, 1)},
    2: {"world": slice(0, 2)},
    3: {"world": slice(0, 2), "track": slice(2, 3)},
}
#: Height of the picture's hills for each number of axes. One third in 2D is the true scale: gravity along the slope of
#: sin(3x) / 3 is proportional to cos(3x).
HEIGHT_SCALE = {1: 1 / 3, 2: 0.2}
#: How far the ground extends beyond the walls: half a car.
MARGIN = 0.1
LOW, HIGH = dynamics.MIN_POSITION - MARGIN, dynamics.MAX_POSITION + MARGIN
#: Where the ground ends along y, and the height of the block's underside.
EXTENT = {1: (-0.13, 0.13), 2: (LOW, HIGH)}
FLOOR = {n_axes: -n_axes * scale - 0.12 for n_axes, scale in HEIGHT_SCALE.items()}
WHEELBASE, TRACK = 0.096, 0.062
_WHEELS = np.array([(a * WHEELBASE / 2, b * TRACK / 2, 0.0) for a in (-1, 1) for b in (-1, 1)])

_ASSETS = Path(__file__).parent / "assets"
_GROUND_CELLS = 90
_TEXTURE_SIZE = 1024

_GRASS = np.array([[0.20, 0.42, 0.36], [0.36, 0.58, 0.38], [0.64, 0.71, 0.44], [0.80, 0.72, 0.52], [0.88, 0.84, 0.76]])
_SOIL = np.array([[0.60, 0.48, 0.37], [0.42, 0.33, 0.27]])
_TURF = np.array([0.36, 0.55, 0.33])
_GOAL = np.array([0.90, 0.28, 0.10])
_LINE = np.array([0.98, 0.98, 0.96])


def height(x: np.ndarray | float, y: np.ndarray | float, n_axes: int) -> np.ndarray:
    """Height of the ground in the picture; in 2D y is across the strip, where the ground is level."""
    hills = np.sin(3 * np.asarray(x)) + (np.sin(3 * np.asarray(y)) if n_axes == 2 else 0 * np.asarray(y))
    return HEIGHT_SCALE[n_axes] * hills


def gradient(x: np.ndarray | float, y: np.ndarray | float, n_axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of :func:`height` with respect to x and to y."""
    scale = 3 * HEIGHT_SCALE[n_axes]
    along_y = np.cos(3 * np.asarray(y)) if n_axes == 2 else 0 * np.asarray(y)
    return scale * np.cos(3 * np.asarray(x)), scale * along_y


def model_and_assets(n_axes: int) -> tuple[bytes, dict[str, bytes]]:
    """The MJCF model of a task's scene and the files that it includes, as ``Physics.from_xml_string`` takes them."""
    return (_ASSETS / f"mountain_car_{2 * n_axes}d.xml").read_bytes(), dict(_assets(n_axes))


@functools.cache
def _assets(n_axes: int) -> dict[str, bytes]:
    vehicle = (_ASSETS / "mountain_car_vehicle.xml").read_bytes()
    assets = {"mountain_car_common.xml": (_ASSETS / "mountain_car_common.xml").read_bytes(), "soil.png": _png(_soil_texture())}
    for body, axes in GROUNDS[n_axes].items():
        n_shown = axes.stop - axes.start
        assets |= {
            # MuJoCo includes no file twice: each car has a copy of it under a name of its own.
            f"{body}_vehicle.xml": vehicle,
            f"{body}_ground.obj": _ground_mesh(n_shown),
            f"{body}_soil.obj": _soil_mesh(n_shown),
            f"{body}_ground.png": _png(_ground_texture(n_shown)),
        }
    return assets


def car_pose(positions: dynamics.Axes, velocities: dynamics.Axes) -> tuple[np.ndarray, np.ndarray]:
    """The pose in which a car is drawn: position relative to its ground's body; rotation, columns nose, left side and roof.

    In 2D the nose points right, as the car can reverse; in 4D it points in the direction of motion (north-east at rest).
    """
    n_axes = len(positions)
    x, y = (positions[0], 0.0) if n_axes == 1 else positions
    slope_x, slope_y = (3 * HEIGHT_SCALE[n_axes] * math.cos(3 * axis) if i < n_axes else 0.0 for i, axis in enumerate((x, y)))
    east, north = (1.0, 0.0) if n_axes == 1 else _heading(velocities)
    nose = _unit(east, north, slope_x * east + slope_y * north)
    roof = _unit(-slope_x, -slope_y, 1.0)
    left = (
        roof[1] * nose[2] - roof[2] * nose[1],
        roof[2] * nose[0] - roof[0] * nose[2],
        roof[0] * nose[1] - roof[1] * nose[0],
    )
    rotation = np.array((nose, left, roof)).T
    wheels = _WHEELS @ rotation.T
    # The ground is curved: the mean over the wheels, not the ground below the middle, keeps them on it.
    z = (height(x + wheels[:, 0], y + wheels[:, 1], n_axes) - wheels[:, 2]).sum() / len(wheels)
    return np.array((x, y, z)), rotation


def _heading(velocities: dynamics.Axes) -> tuple[float, float]:
    east, north = velocities
    speed = math.hypot(east, north)
    return (east / speed, north / speed) if speed > 0 else (math.sqrt(0.5), math.sqrt(0.5))


def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def _ground_mesh(n_axes: int) -> bytes:
    """The surface on which the car drives, with a texture projected from above."""
    xs = np.linspace(LOW, HIGH, _GROUND_CELLS + 1)
    ys = np.linspace(*EXTENT[n_axes], _GROUND_CELLS + 1 if n_axes == 2 else 3)
    x, y = (grid.ravel() for grid in np.meshgrid(xs, ys, indexing="ij"))
    slope_x, slope_y = gradient(x, y, n_axes)
    vertices = np.column_stack([x, y, height(x, y, n_axes)])
    normals = np.column_stack([-slope_x, -slope_y + 0 * x, np.ones_like(x)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = np.column_stack([(x - xs[0]) / (xs[-1] - xs[0]), (y - ys[0]) / (ys[-1] - ys[0])])
    return _obj(vertices, normals, uv, _grid_faces(len(xs), len(ys)))


def _soil_mesh(n_axes: int) -> bytes:
    """The four sides of the block and its underside; the texture's v is the depth under the surface."""
    y_low, y_high = EXTENT[n_axes]
    corners = np.array([[LOW, y_low], [HIGH, y_low], [HIGH, y_high], [LOW, y_high]])
    parts = [_side(corners[i], corners[(i + 1) % 4], n_axes) for i in range(4)]
    floor = np.column_stack([corners[[0, 3, 1, 2]], np.full(4, FLOOR[n_axes])])
    parts.append((floor, np.tile([0.0, 0.0, -1.0], (4, 1)), np.zeros((4, 2)), _grid_faces(2, 2)[:, ::-1]))
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    faces = np.concatenate([part[3] + start for part, start in zip(parts, starts, strict=False)])
    vertices, normals, uv = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return _obj(vertices, normals, uv, faces)


def _side(start: np.ndarray, end: np.ndarray, n_axes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One vertical side from ``start`` to ``end``, whose outer face is on the right of that direction."""
    share = np.linspace(0, 1, _GROUND_CELLS + 1)
    foot = start + share[:, None] * (end - start)
    top = height(foot[:, 0], foot[:, 1], n_axes)
    levels = np.linspace(0, 1, 9)
    depth = (top - FLOOR[n_axes])[:, None] * levels
    vertices = np.column_stack([np.repeat(foot, len(levels), axis=0), (top[:, None] - depth).ravel()])
    along = (end - start) / np.linalg.norm(end - start)
    normals = np.tile([along[1], -along[0], 0.0], (len(vertices), 1))
    uv = np.column_stack([np.repeat(share, len(levels)), 1 - depth.ravel()])
    return vertices, normals, uv, _grid_faces(len(share), len(levels))[:, ::-1]


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles for each cell of a grid of vertices, counter-clockwise when rows go right and columns go up."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up, across = corner + columns, corner + 1, corner + columns + 1
    return np.concatenate([np.column_stack([corner, right, across]), np.column_stack([corner, across, up])])


def _obj(vertices: np.ndarray, normals: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> bytes:
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices.tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.tolist()]
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in uv.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (faces + 1).tolist()]
    return "\n".join(lines).encode()


def _ground_texture(n_axes: int) -> np.ndarray:
    """Colour by height, contour lines, the walls as pale lines, the goal as a patch; rows from north to south."""
    y_low, y_high = EXTENT[n_axes]
    # Square texels: a texture that is squeezed in one direction gets blurred in the other.
    rows = round(_TEXTURE_SIZE * (y_high - y_low) / (HIGH - LOW))
    x, y = np.linspace(LOW, HIGH, _TEXTURE_SIZE), np.linspace(y_high, y_low, rows)[:, None]
    z = height(x, y, n_axes)
    top = n_axes * HEIGHT_SCALE[n_axes]
    image = _colours((z + top) / (2 * top), _GRASS)
    slope = np.hypot(*np.broadcast_arrays(*gradient(x, y, n_axes)))
    image = _draw(image, _near(z, top / 6, slope), 0.82 * image)
    axes = (x, y) if n_axes == 2 else (x,)
    goal = inside = np.ones((1, 1), dtype=np.bool_)
    for axis in axes:
        goal = goal & (axis >= dynamics.GOAL_POSITION)
        inside = inside & (axis >= dynamics.MIN_POSITION) & (axis <= dynamics.MAX_POSITION)
    image = _draw(image, goal, 0.1 * image + 0.9 * _GOAL)
    return _draw(image, ~inside, 0.45 * image + 0.55 * _LINE)


def _near(z: np.ndarray, spacing: float, slope: np.ndarray) -> np.ndarray:
    """Mark the points on contour lines, which have the same width on steep and on level ground."""
    distance = np.abs((z + spacing / 2) % spacing - spacing / 2)
    return distance < np.minimum(0.0028 * slope, 0.05 * spacing)


def _draw(image: np.ndarray, where: np.ndarray, colour: np.ndarray) -> np.ndarray:
    return np.where(np.broadcast_to(where, image.shape[:2])[..., None], colour, image)


def _soil_texture() -> np.ndarray:
    """A thin turf over soil that darkens with depth; the picture's height is one unit of length."""
    depth = np.linspace(0, 1, _TEXTURE_SIZE)[:, None] * np.ones(8)
    image = _colours(np.minimum(depth / 0.6, 1), _SOIL)
    return _draw(image, depth < 0.018, _TURF)


def _colours(share: np.ndarray, stops: np.ndarray) -> np.ndarray:
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(share, at, stops[:, channel]) for channel in range(3)], axis=-1)


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * image).astype(np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()
