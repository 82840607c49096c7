"""A plane through the grid of states, for pictures: two variables vary, the others are constant."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.planning.grid import StateGrid

VariablePair = tuple[int | str, int | str]
#: Along each variable of a picture of a grid whose lines are not evenly spread.
PIXELS = 64
#: How the velocity of a variable "x" is called, in lower case without blanks and underscores.
VELOCITIES = ("v{}", "{}v", "d{}", "{}dot", "dot{}", "vel{}", "{}vel", "velocity{}", "{}velocity", "velocityof{}")
#: Words in names of variables, and those in the names of their velocities.
WORDS = (("position", "velocity"), ("angle", "angularvelocity"), ("angle", "velocity"))


class Plane(NamedTuple):
    """The grid points of a plane, and the texts for a picture of it."""

    points: np.ndarray  # numbers, int64, shape (points along the second variable, along the first)
    names: tuple[str, str]  # the second is empty for a task with one variable
    extent: tuple[float, float, float, float]  # raw units: left, right, bottom, top, half a cell beyond the outer points
    held: str  # the other variables and their values


def has_matplotlib() -> bool:
    """Return whether pictures can be drawn."""
    return find_spec("matplotlib") is not None


def check_matplotlib(otherwise: str) -> None:
    """Raise a ModuleNotFoundError that says what to do ``otherwise``, unless pictures can be drawn."""
    if not has_matplotlib():
        raise ModuleNotFoundError(f"pictures need matplotlib: install it, or {otherwise}", name="matplotlib")


def planes_of(
    grid: StateGrid,
    scaling: StateScaling,
    names: Sequence[str],
    variables: Sequence[VariablePair] | None,
    at: ArrayLike | None = None,
) -> list[Plane]:
    """Find the planes over which pictures are drawn; for the arguments see :func:`~sb3_combrel.tensorboard.explain.explain`.

    :raises ValueError: if they do not fit the task
    """
    if at is not None and not _is_state(at, len(names)):
        raise ValueError(f"at must be {len(names)} finite numbers, one a state variable, got {at!r}")
    return [plane_through(grid, scaling, names, pair, at) for pair in numbered(variables, names)]


def _is_state(at: ArrayLike, n_variables: int) -> bool:
    try:
        state = np.asarray(at, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return state.shape == (n_variables,) and bool(np.isfinite(state).all())


def plane_through(
    grid: StateGrid,
    scaling: StateScaling,
    names: Sequence[str],
    variables: tuple[int, int],
    at: ArrayLike | None = None,
) -> Plane:
    """Find the plane of two variables, twice the same for a line, through the grid points nearest to a state; without margin.

    :param at: raw units, shape (n_variables,); None for the middle of the state space
    """
    across, up = variables
    g = grid.arrays
    unit = np.full(grid.n_variables, 0.5) if at is None else np.clip(scaling.to_unit(at), 0.0, 1.0)
    nearest = np.rint(grid.coordinates(unit[None])[0]).astype(np.int64)
    held = np.where(g.periodic, nearest % g.shape, nearest)
    held_state = scaling.to_raw(g.lines[np.arange(grid.n_variables), held])
    points = np.array(int(held @ g.strides)) + (_shown(grid, across) - held[across]) * g.strides[across]
    rows = np.zeros(1, dtype=np.int64) if up == across else (_shown(grid, up) - held[up]) * g.strides[up]
    left, right = _edges(grid, scaling, across)
    bottom, top = (0.0, 1.0) if up == across else _edges(grid, scaling, up)
    others = [f"{names[k]} = {held_state[k]:.3g}" for k in range(grid.n_variables) if k not in variables]
    return Plane(
        points=np.add.outer(rows, points),
        names=(names[across], "" if up == across else names[up]),
        extent=(left, right, bottom, top),
        held=", ".join(others),
    )


def _shown(grid: StateGrid, variable: int) -> np.ndarray:
    """The numbers of the grid lines that a picture shows, from left to right: of uneven ones the nearest to each pixel."""
    g = grid.arrays
    margin, n = int(g.margin[variable]), int(g.shape[variable])
    if g.even:
        return np.arange(margin, n - margin)
    half_cell = 0.5 / g.cells[variable]
    last = 1.0 - half_cell if g.periodic[variable] else 1.0 + half_cell
    pixels = np.linspace(-half_cell, last, 2 * PIXELS + 1)[1::2]
    away = np.abs(pixels[:, None] - g.lines[variable, : n + 1 if g.periodic[variable] else n])
    return away.argmin(axis=1) % n


def _edges(grid: StateGrid, scaling: StateScaling, variable: int) -> tuple[float, float]:
    half_cell = 0.5 / grid.arrays.cells[variable]
    low, high = scaling.low[variable], scaling.high[variable]
    # The last point of a periodic variable is a cell away from its upper bound, which is the lower one again.
    beyond = -half_cell if grid.arrays.periodic[variable] else half_cell
    return float(low - half_cell * (high - low)), float(high + beyond * (high - low))


def numbered(variables: Sequence[VariablePair] | None, names: Sequence[str]) -> list[tuple[int, int]]:
    """Turn pairs of variables, by name or number, into pairs of numbers; None is a variable beside its own velocity.

    :raises ValueError: if a pair is none of two different variables, or names one that there is not
    """
    if variables is None:
        return [default_pair(names)]
    number: dict[Any, int] = {**{name: k for k, name in enumerate(names)}, **{k: k for k in range(len(names))}}
    pairs = []
    # No pair at all is refused like a wrong one.
    for pair in variables if isinstance(variables, Sequence | np.ndarray) and len(variables) else [variables]:
        given: list[Any] = list(pair) if isinstance(pair, Sequence | np.ndarray) and not isinstance(pair, str) else []
        found = tuple(number.get(each, -1) if isinstance(each, Hashable) else -1 for each in given)
        if len(found) != 2 or -1 in found or (found[0] == found[1] and len(names) > 1):
            raise ValueError(
                f"variables must be pairs of two different state variables, by numbers below {len(names)} or names out of "
                f"{', '.join(names)}, such as [({names[0]!r}, {names[-1]!r})], got {pair!r}{_meant(given, names)}"
            )
        pairs.append((found[0], found[1]))
    return pairs


def default_pair(names: Sequence[str]) -> tuple[int, int]:
    """Find a variable and its own velocity, by their names; else the first two; or the only one, twice."""
    plain = [name.lower().replace(" ", "").replace("_", "") for name in names]
    for k, name in enumerate(plain):
        called = [pattern.format(name) for pattern in VELOCITIES]
        called += [name.replace(word, other) for word, other in WORDS if word in name]
        for velocity in called:
            if velocity in plain:
                return k, plain.index(velocity)
    return 0, min(1, len(names) - 1)


def _meant(given: Sequence[int | str], names: Sequence[str]) -> str:
    """Suggest a name for the first that is unknown."""
    unknown = [each for each in given if isinstance(each, str) and each not in names]
    return did_you_mean(unknown[0], names) if unknown else ""
