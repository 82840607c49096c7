"""How much work a grid makes, estimated before it begins: a fine grid can take minutes without any sign of life."""

from __future__ import annotations

import math
from typing import NamedTuple

from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.planning.grid import FEWER_VARIABLES, MAX_VARIABLES, StateGrid

# In seconds, without and with transfer: for each state-action pair until the first step, and for each grid point that an
# instance reaches in a step.
SETUP_OF_PAIR = (1e-6, 1e-5)
STEP_OF_POINT = (7e-7, 4e-6)

LONG_SETUP_SECONDS = 5.0
LONG_STEP_SECONDS = 0.05


class Workload(NamedTuple):
    """The size of a grid, and what it costs by estimate."""

    n_points: int
    n_pairs: int
    setup_seconds: float  # until the first step, and for loading a model
    step_seconds: float

    def __str__(self) -> str:
        return (
            f"{self.n_points:,} grid points and {self.n_pairs:,} state-action pairs: roughly {_time(self.setup_seconds)} "
            f"until the first step, and {_time(self.step_seconds)} a step"
        )


def workload(grid: StateGrid, n_actions: int, settings: ModelSettings, transfers: bool) -> Workload:
    """Estimate the work; the reach of the model's kernel decides how many grid points an instance changes."""
    d = grid.n_variables
    reach = settings.model_breadth * math.sqrt(-math.log(settings.min_weight))
    ball = math.pi ** (d / 2) / math.gamma(d / 2 + 1) * min(reach, 1.0) ** d
    n_pairs = grid.n_points * n_actions
    setup, step = SETUP_OF_PAIR[transfers] * n_pairs, STEP_OF_POINT[transfers] * min(ball, 1.0) * grid.n_points
    return Workload(grid.n_points, n_pairs, setup, step)


def warn_if_long(work: Workload, grid: StateGrid) -> None:
    """Warn of a grid that takes long, before it does, and of more state variables than a grid is good for."""
    if grid.n_variables > MAX_VARIABLES:
        warn_user(
            f"{grid.n_variables} state variables are many for a grid, with {grid.arrays.shape.min()} points along some of "
            f"them: {work}; {FEWER_VARIABLES}"
        )
    elif work.setup_seconds > LONG_SETUP_SECONDS or work.step_seconds > LONG_STEP_SECONDS:
        warn_user(
            f"resolution={list(grid.resolution)} means {work}; a lower resolution takes less time, each number less by one "
            "about half"
        )


def _time(seconds: float) -> str:
    if seconds >= 90.0:
        return f"{seconds / 60.0:.0f} minutes"
    return f"{seconds:.0f} seconds" if seconds >= 2.0 else f"{seconds:.1g} seconds"
