"""A point robot among walls, in two and three dimensions: greedy policies that press against a wall are noticed here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

STEP = 0.06
MAX_EPISODE_STEPS = 400
STARTS = ("fixed", "random")
#: Room between the robot's start, or the goal's corner, and the boundary.
MARGIN = 0.1
#: Side of the goal's box.
GOAL_SIZE = 0.15


class Box(NamedTuple):
    """A box of the unit square or cube, given by two corners; the robot cannot be inside a wall, whose faces are free."""

    low: np.ndarray
    high: np.ndarray

    def contains(self, position: np.ndarray) -> bool:
        """Whether a position is inside, not on a face."""
        return bool(((position > self.low) & (position < self.high)).all())


def slab(axis: int, low: float, high: float, gap: Sequence[tuple[float, float]]) -> list[Box]:
    """Make a wall of boxes, that end outside the unit box, from ``low`` to ``high`` along an axis, with a gap."""
    others = [other for other in range(len(gap) + 1) if other != axis]
    rest_low, rest_high = np.full(len(gap) + 1, -1.0), np.full(len(gap) + 1, 2.0)
    rest_low[axis], rest_high[axis] = low, high
    boxes = []
    for other, (gap_low, gap_high) in zip(others, gap, strict=True):
        for part_low, part_high in ((-1.0, gap_low), (gap_high, 2.0)):
            box = Box(rest_low.copy(), rest_high.copy())
            box.low[other], box.high[other] = part_low, part_high
            # A gap that reaches the boundary leaves no wall on that side.
            if part_high > 0.0 and part_low < 1.0:
                boxes.append(box)
        rest_low[other], rest_high[other] = gap_low, gap_high
    return boxes


#: Two walls, the first passed at the upper end of the second axis, the other at the lower end: the way is Z-shaped.
WALLS: dict[int, tuple[Box, ...]] = {
    n_variables: (
        *slab(0, 0.30, 0.36, [(0.7, 1.0), *[(0.0, 1.0)] * (n_variables - 2)]),
        *slab(0, 0.64, 0.70, [(0.0, 0.3), *[(0.0, 1.0)] * (n_variables - 2)]),
    )
    for n_variables in (2, 3)
}


def move(position: np.ndarray, displacement: np.ndarray, walls: Sequence[Box]) -> np.ndarray:
    """Move a point of the unit box, axis by axis, until a wall or the boundary stops it; shape (n_variables,)."""
    position = position.copy()
    for axis in np.flatnonzero(displacement):
        here, there = position[axis], float(np.clip(position[axis] + displacement[axis], 0.0, 1.0))
        for wall in walls:
            beside = (position > wall.low) & (position < wall.high)
            beside[axis] = True
            if not beside.all():
                continue
            if here <= wall.low[axis] < there:
                there = float(wall.low[axis])
            elif there < wall.high[axis] <= here:
                there = float(wall.high[axis])
        position[axis] = there
    return position


class PointRobotEnv(gym.Env[np.ndarray, np.int64]):
    """A point that moves in the unit square or cube, around walls, to a goal in the corner opposite to its start.

    Two walls leave it a Z-shaped way. The observation is its position. Action 2i moves it down axis i by :data:`STEP`,
    action 2i + 1 up; walls and the boundary stop it. The reward is -1 a step; the episode terminates in the goal's box.
    Made by :func:`make_point_robot`, it has a limit of 400 steps.

    :param n_variables: 2 or 3
    :param noise: standard deviation of a normal displacement along each axis that is added to every move
    :param start: where an episode begins: ``"fixed"``, in a corner, or ``"random"``, anywhere but in walls and goal
    :raises ValueError: if an argument isn't possible
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, n_variables: int = 3, noise: float = 0.0, start: str = "fixed"):
        if n_variables not in WALLS:
            raise ValueError(f"n_variables must be one of {', '.join(map(str, WALLS))}, got {n_variables!r}")
        if not (np.isfinite(noise) and noise >= 0.0):
            raise ValueError(f"noise must be a finite number of at least 0, got {noise!r}")
        if start not in STARTS:
            raise ValueError(f"start must be one of {', '.join(STARTS)}, got {start!r}")
        self.walls = WALLS[n_variables]
        self.goal = Box(np.full(n_variables, 1.0 - GOAL_SIZE), np.full(n_variables, 1.0))
        self.observation_space = spaces.Box(0.0, 1.0, (n_variables,), np.float32)
        self.action_space = spaces.Discrete(2 * n_variables)
        self._noise = noise
        self._start = start
        self._position: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        n_variables = len(self.goal.low)
        self._position = np.full(n_variables, MARGIN)
        if self._start == "random":
            self._position = self.np_random.random(n_variables)
            while not self._is_free(self._position):
                self._position = self.np_random.random(n_variables)
        return self._position.astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move the robot; see :class:`PointRobotEnv`."""
        if self._position is None:
            raise ResetNeeded("call reset() before the first step")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be in {self.action_space}, got {action!r}")
        displacement = np.zeros(len(self._position))
        displacement[int(action) // 2] = STEP if int(action) % 2 else -STEP
        if self._noise:
            displacement += self.np_random.normal(0.0, self._noise, len(displacement))
        self._position = move(self._position, displacement, self.walls)
        terminated = bool((self._position >= self.goal.low).all())
        return self._position.astype(np.float32), -1.0, terminated, False, {"is_success": terminated}

    def _is_free(self, position: np.ndarray) -> bool:
        return not (any(wall.contains(position) for wall in self.walls) or bool((position >= self.goal.low).all()))


def make_point_robot(n_variables: int = 3, noise: float = 0.0, start: str = "fixed") -> gym.Env:
    """Make a :class:`PointRobotEnv` whose episodes are cut off after 400 steps."""
    return gym.wrappers.TimeLimit(PointRobotEnv(n_variables, noise, start), MAX_EPISODE_STEPS)
