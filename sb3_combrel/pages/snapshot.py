"""What pictures need to know of an agent, as plain data that another process can send: values, policy, bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.pages.plane import Plane
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

#: Grid points whose actions are compared at a time.
MAX_POINTS = 4096


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The value function and the policy of an agent at the points of its grid."""

    grid: StateGrid
    scaling: StateScaling
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    values: np.ndarray  #: V, shape (n_points,)
    #: Number of the action with the highest Q, -1 where one has no model, or it was not asked for; int64, shape (n_points,).
    greedy: np.ndarray
    bound: np.ndarray | None  #: what the source's values allow, shape (n_points,); None if they bound nothing


def snapshot_of(agent: FittedRMaxAgent, planes: Sequence[Plane] | None = None) -> Snapshot:
    """Take what an agent has learned.

    :param planes: over which the policy is to be drawn; None: any
    """
    transfer, n_points = agent.transfer, agent.grid.n_points
    points = np.arange(n_points) if planes is None else np.concatenate([plane.points.ravel() for plane in planes])
    greedy = np.full(n_points, -1, dtype=np.int64)
    # In parts: what is computed on the way is many times as large as the result.
    for part in np.array_split(points, len(points) // MAX_POINTS + 1):
        greedy[part] = greedy_actions(agent, part)
    bounds = isinstance(transfer, MappingTransfer) and transfer.use == "prior"
    return Snapshot(
        grid=agent.grid,
        scaling=agent.task.scaling,
        state_names=tuple(agent.task.state_names),
        action_names=tuple(agent.task.action_names),
        values=agent.planner.values.copy(),
        greedy=greedy,
        bound=transfer.source_prior.value_bound() if bounds else None,  # type: ignore[union-attr]
    )


def action_values(agent: FittedRMaxAgent, points: np.ndarray) -> np.ndarray:
    """Compute Q of every action, the first axis, at grid points of any shape; NaN for an optimistic pair."""
    arrays = agent.mdp.arrays
    shape, flat = np.shape(points), np.ravel(points)
    used = np.arange(arrays.to.shape[2]) < arrays.length[flat][:, :, None]
    following = np.where(used, arrays.weight[flat] * agent.planner.values[arrays.to[flat]], 0.0)
    modelled = arrays.modelled.reshape(agent.task.n_actions, -1)[:, flat]
    q = np.where(modelled, (arrays.reward[flat] + following.sum(axis=2)).T, np.nan)
    return q.reshape(-1, *shape)


def greedy_actions(agent: FittedRMaxAgent, points: np.ndarray) -> np.ndarray:
    """Find the action with the highest Q at grid points, -1 where one is optimistic; int64, the shape of the points."""
    q = action_values(agent, points)
    return np.where(np.isnan(q).any(axis=0), -1, np.nan_to_num(q, nan=-np.inf).argmax(axis=0))


def _write(shown: Snapshot) -> tuple[str, dict[str, Any]]:
    grid = {"resolution": shown.grid.resolution, "margin": shown.grid.margin, "periodic": shown.grid.arrays.periodic}
    grid["lines"] = None if shown.grid.arrays.even else shown.grid.arrays.lines
    scaling = {"low": shown.scaling.low, "high": shown.scaling.high}
    return "Snapshot", {**vars(shown), "grid": grid, "scaling": scaling}


def _read(grid: Any, scaling: Any, state_names: Any, action_names: Any, values: Any, greedy: Any, bound: Any) -> Snapshot:
    lines = grid.pop("lines", None)
    return Snapshot(
        grid=StateGrid(len(grid["resolution"]), **grid, lines=None if lines is None else np.array(lines, dtype=np.float64)),
        scaling=StateScaling(**scaling),
        state_names=tuple(state_names),
        action_names=tuple(action_names),
        values=np.array(values, dtype=np.float64),
        greedy=np.array(greedy, dtype=np.int64),
        bound=None if bound is None else np.array(bound, dtype=np.float64),
    )


register_writer(Snapshot, _write)
register_reader("Snapshot", _read)
