"""The equations of Mountain Car in plain Python floats, faster than arrays for two to six scalars; both interfaces use them.

A state is a pair of tuples ``(positions, velocities)`` with one float an axis, ``((x, y), (vx, vy))`` in 4D.
"""

import math
from collections.abc import Callable
from typing import Any, SupportsIndex

from combrel_envs.checks import check_action, check_number

MIN_POSITION = -1.2
MAX_POSITION = 0.6
MAX_SPEED = 0.07
GOAL_POSITION = 0.5
ENGINE = 0.001
GRAVITY = 0.0025
VALLEY = -math.pi / 6
START_OFFSET = 0.005
MAX_EPISODE_STEPS = 4000

STARTS = ("offset", "fixed", "random")

#: Names of the actions and of the state's entries for each number of axes.
ACTION_NAMES: dict[int, tuple[str, ...]] = {
    1: ("Neutral", "Left", "Right"),
    2: ("Neutral", "West", "East", "South", "North"),
    3: ("Neutral", "West", "East", "South", "North", "Down", "Up"),
}
STATE_NAMES: dict[int, tuple[str, ...]] = {
    1: ("x", "v"),
    2: ("x", "y", "vx", "vy"),
    3: ("x", "y", "z", "vx", "vy", "vz"),
}
#: For each number of axes: what each action adds to the velocities, in units of ``ENGINE``: nothing, or -1 or 1 on one axis.
PUSHES: dict[int, tuple[tuple[float, ...], ...]] = {
    n: ((0.0,) * n, *(tuple(sign if i == axis else 0.0 for i in range(n)) for axis in range(n) for sign in (-1.0, 1.0)))
    for n in (1, 2, 3)
}

Axes = tuple[float, ...]
State = tuple[Axes, Axes]
#: Draws a number between two bounds: the method of a NumPy generator.
Uniform = Callable[[float, float], float]


def step_axis(position: float, velocity: float, push: float) -> tuple[float, float]:
    """Advance position and velocity on one axis; ``push`` is -1, 0 or 1. The new velocity moves it, walls stop it."""
    velocity += ENGINE * push - GRAVITY * math.cos(3 * position)
    if velocity > MAX_SPEED:
        velocity = MAX_SPEED
    elif velocity < -MAX_SPEED:
        velocity = -MAX_SPEED
    position += velocity
    if position <= MIN_POSITION:
        return MIN_POSITION, max(velocity, 0.0)
    if position >= MAX_POSITION:
        return MAX_POSITION, min(velocity, 0.0)
    return position, velocity


def step_car(positions: Axes, velocities: Axes, pushes: Axes) -> State:
    """Advance the car by one step: every axis by :func:`step_axis`, independently of the others."""
    moved = [step_axis(*axis) for axis in zip(positions, velocities, pushes, strict=True)]
    positions, velocities = zip(*moved, strict=True)
    return positions, velocities


def at_goal(positions: Axes) -> bool:
    """Whether every axis is at ``GOAL_POSITION`` or beyond."""
    return min(positions) >= GOAL_POSITION


def check_action_noise(action_noise: Any) -> float:
    """Return ``action_noise``; ``ValueError`` unless it is a probability."""
    return check_number("action_noise", action_noise, "a probability, a number from 0 to 1", lambda p: 0 <= p <= 1)


def executed_push(action: SupportsIndex, n_axes: int, action_noise: float, uniform: Uniform) -> Axes:
    """What the engine does on each axis, at random with probability ``action_noise``; `ValueError`: no such action."""
    number = check_action(action, ACTION_NAMES[n_axes])
    pushes = PUSHES[n_axes]
    if action_noise and uniform(0.0, 1.0) < action_noise:
        number = int(uniform(0.0, len(pushes)))
    return pushes[number]


def sample_start(start: str, n_axes: int, uniform: Uniform) -> State:
    """Draw the state in which an episode begins; ``start`` as in :class:`~combrel_envs.mountain_car.Climb`."""
    if start == "random":
        positions = _uniform_axes(n_axes, uniform, MIN_POSITION, MAX_POSITION)
        while at_goal(positions):
            positions = _uniform_axes(n_axes, uniform, MIN_POSITION, MAX_POSITION)
        return positions, _uniform_axes(n_axes, uniform, -MAX_SPEED, MAX_SPEED)
    offset = uniform(-START_OFFSET, START_OFFSET) if start == "offset" else 0.0
    return (VALLEY + offset,) * n_axes, (0.0,) * n_axes


def _uniform_axes(n_axes: int, uniform: Uniform, low: float, high: float) -> Axes:
    return tuple(float(uniform(low, high)) for _ in range(n_axes))
