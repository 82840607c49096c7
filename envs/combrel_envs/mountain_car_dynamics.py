"""The equations of Mountain Car, in plain Python floats.

Both interfaces of the environment, dm_control's and Gymnasium's, step the car with :func:`step_car`: there is one set of
equations. This module needs neither NumPy nor MuJoCo: for two to six scalars Python's floats are several times faster than
arrays.

A state is a pair ``(positions, velocities)`` of tuples with one float an axis: ``((x,), (v,))``, ``((x, y), (vx, vy))`` or
``((x, y, z), (vx, vy, vz))``.
"""

import math
import operator
from collections.abc import Callable
from numbers import Real
from typing import SupportsIndex

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


def _pushes(n_axes: int) -> tuple[tuple[float, ...], ...]:
    along_axes = (tuple(sign if i == axis else 0.0 for i in range(n_axes)) for axis in range(n_axes) for sign in (-1.0, 1.0))
    return ((0.0,) * n_axes, *along_axes)


#: For each number of axes: what each action adds to the velocities, in units of ``ENGINE``: nothing, or -1 or 1 on one axis.
PUSHES: dict[int, tuple[tuple[float, ...], ...]] = {n_axes: _pushes(n_axes) for n_axes in (1, 2, 3)}
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

Axes = tuple[float, ...]
State = tuple[Axes, Axes]


def step_axis(position: float, velocity: float, push: float) -> tuple[float, float]:
    """
    Advance one axis by one step: engine and gravity change the velocity, the new velocity moves the car, the walls stop it.

    :param position: position before the step
    :param velocity: velocity before the step
    :param push: what the engine does on this axis: -1, 0 or 1
    :return: position and velocity after the step
    """
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
    """
    Advance the car by one step: every axis by :func:`step_axis`, independently of the others.

    :param positions: position on each axis
    :param velocities: velocity on each axis
    :param pushes: what the engine does on each axis: -1, 0 or 1
    :return: the state after the step
    """
    moved = [step_axis(*axis) for axis in zip(positions, velocities, pushes, strict=True)]
    positions, velocities = zip(*moved, strict=True)
    return positions, velocities


def push_of(action: SupportsIndex, n_axes: int) -> Axes:
    """
    Look up the push of the engine that an action stands for.

    :param action: number of an action, any integer type
    :param n_axes: number of axes, 1, 2 or 3
    :return: what the engine does on each axis
    :raises ValueError: when there is no such action
    """
    pushes = PUSHES[n_axes]
    try:
        number = operator.index(action)
    except TypeError:
        number = -1
    if not 0 <= number < len(pushes):
        raise ValueError(f"action must be an integer from 0 to {len(pushes) - 1}, got {action!r}")
    return pushes[number]


def at_goal(positions: Axes) -> bool:
    """
    Check whether the car is at the goal.

    :param positions: position on each axis
    :return: True if every axis is at ``GOAL_POSITION`` or beyond
    """
    return min(positions) >= GOAL_POSITION


def check_start(start: str) -> str:
    """
    Check a start option.

    :param start: the option that a user gave
    :return: the same option
    :raises ValueError: if it is not one of ``STARTS``
    """
    if start not in STARTS:
        raise ValueError(f"start must be one of {', '.join(map(repr, STARTS))}, got {start!r}")
    return start


def check_action_noise(action_noise: float) -> float:
    """
    Check a probability of random actions.

    :param action_noise: the probability that a user gave
    :return: the same probability
    :raises ValueError: if it is not a number from 0 to 1
    """
    if not (isinstance(action_noise, Real) and not isinstance(action_noise, bool) and 0 <= action_noise <= 1):
        raise ValueError(f"action_noise must be a probability, a number from 0 to 1, got {action_noise!r}")
    return float(action_noise)


def noisy_push(push: Axes, action_noise: float, uniform: Callable[[float, float], float]) -> Axes:
    """
    Draw what the engine does if its actions are noisy.

    :param push: push of the action that was chosen
    :param action_noise: probability with which a random action, drawn from all, is executed instead
    :param uniform: draws a number between two bounds (the method of a NumPy generator)
    :return: push of the action that is executed
    """
    if uniform(0.0, 1.0) >= action_noise:
        return push
    pushes = PUSHES[len(push)]
    return pushes[int(uniform(0.0, len(pushes)))]


def sample_start(start: str, n_axes: int, uniform: Callable[[float, float], float]) -> State:
    """
    Draw the state in which an episode begins.

    :param start: ``"offset"``: at rest at the bottom of the valley, moved by one offset, the same on every axis;
        ``"fixed"``: at rest exactly at the bottom; ``"random"``: anywhere but at the goal, at any velocity
    :param n_axes: number of axes, 1, 2 or 3
    :param uniform: draws a number between two bounds (the method of a NumPy generator)
    :return: the state
    """
    if start == "random":
        positions = _uniform_axes(n_axes, uniform, MIN_POSITION, MAX_POSITION)
        while at_goal(positions):
            positions = _uniform_axes(n_axes, uniform, MIN_POSITION, MAX_POSITION)
        return positions, _uniform_axes(n_axes, uniform, -MAX_SPEED, MAX_SPEED)
    offset = uniform(-START_OFFSET, START_OFFSET) if start == "offset" else 0.0
    return (VALLEY + offset,) * n_axes, (0.0,) * n_axes


def _uniform_axes(n_axes: int, uniform: Callable[[float, float], float], low: float, high: float) -> Axes:
    return tuple(float(uniform(low, high)) for _ in range(n_axes))
