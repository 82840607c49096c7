"""The values by which a cautious frozen policy acts: those of what is known alone."""

from __future__ import annotations

from sb3_combrel.common.constants import LONGEST_PLAN
from sb3_combrel.models.base import Model
from sb3_combrel.planning.grid import MAX_PAIRS_BY_DEFAULT
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.planner import Planner
from sb3_combrel.planning.q_values import ValueFunction


def cautious_function(model: Model, planner: Planner, finer: bool, holds: bool) -> ValueFunction:
    """Plan without optimism, from below, until the values have converged.

    :param finer: whether to fit and plan on a grid twice as fine as the learner's, which takes seconds, if the model does so
        and there is room. The learner has no time for that at every step.
    :param holds: whether an action counts as held until it leaves a cell
    """
    mdp = model.mdp
    if finer and model.plans_finer and (grid := model.grid.finer()).n_points * mdp.n_actions <= MAX_PAIRS_BY_DEFAULT:
        mdp, (low, high) = FiniteMDP(grid, mdp.n_actions, mdp.gamma), planner.bounds
        model.on(mdp)
        planner = Planner(mdp, max_value=high, min_value=low, tolerance=planner.tolerance)
    values = planner.cautious_values(LONGEST_PLAN)
    return ValueFunction(values, mdp.grid.plain, mdp.gamma, planner.bounds, planner.worth, holds)
