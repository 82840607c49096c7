"""Figures for the logger that take some work to compute from an agent; nothing here changes what it learns."""

from __future__ import annotations

import numpy as np

from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.pages.snapshot import action_values
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.methods.combrel import COMBREL
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

MAX_POINTS = 500
"""Grid points from which a figure is computed, at most: enough for a curve, and cheap on any grid."""

MAX_PAIRS = 2000
"""The same for state-action pairs."""


def spread(n: int, max_count: int = MAX_POINTS) -> np.ndarray:
    """Choose at most ``max_count`` numbers below ``n``, evenly spread, so that grid points do not all lie on one axis."""
    return np.arange(n) if n <= max_count else (np.arange(max_count) * (n / max_count)).astype(np.int64)


def bellman_residual(agent: FittedRMaxAgent) -> float:
    """Compute the most that a backup would change V at points spread over the grid, those with optimistic actions left out."""
    points = spread(agent.grid.n_points)
    points = points[agent.mdp.arrays.n_optimistic[points] == 0]
    if len(points) == 0:
        return 0.0
    backed_up = np.clip(action_values(agent, points).max(axis=0), *agent.planner.bounds)
    return float(np.abs(backed_up - agent.planner.values[points]).max())


def mean_compliance(transfer: Transfer) -> float | None:
    """Compute the chosen mappings' mean compliance (Eq. 6 of the COMBREL paper) over pairs spread out; None without any."""
    if not isinstance(transfer, COMBREL):
        return None
    pairs = np.flatnonzero(transfer.choices() >= 0)
    if len(pairs) == 0:
        return None
    return float(transfer.chosen_compliance(pairs[spread(len(pairs), MAX_PAIRS)]).mean())


def evidence(agent: FittedRMaxAgent) -> dict[str, float]:
    """Read of a source as prior as how many instances it counts for each target action, and the mean of its bound."""
    transfer = agent.transfer
    if not isinstance(transfer, MappingTransfer) or transfer.use != "prior":
        return {}
    prior = transfer.source_prior
    strengths = np.nan_to_num(prior.strengths()).tolist()
    found = {f"evidence/{name}": strength for name, strength in zip(agent.task.action_names, strengths, strict=True)}
    bound = prior.value_bound()
    return found if bound is None else {**found, "transfer/value_bound": float(bound.mean())}
