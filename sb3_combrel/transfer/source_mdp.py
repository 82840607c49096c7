"""A source task as a finite MDP: what its local linear model predicts at the states of a grid."""

from __future__ import annotations

import numpy as np

from sb3_combrel.planning.grid import fitting_grid
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.source_model import SourceModel

# An action is held until its cell of the grid is left, but for no more than so many steps: values that are interpolated at
# every step would spread over the grid.
MAX_STEPS = 50
# What the grid's resolution is chosen for: the least weight of an instance that reaches a grid point.
LEAST_WEIGHT_ON_GRID = 0.05
# Changes of value up to this part of the range of a step's rewards end the planning.
_TOLERANCE = 0.001


def source_mdp(source: SourceInstances, model: SourceModel, gamma: float, breadth: float, min_weight: float) -> FiniteMDP:
    """Write what each action, held until the cell is left, does at each point of a grid over the source's states.

    :param model: of the source's instances; ``breadth``: its kernel breadth, for which the grid is chosen
    :param min_weight: weight of the model's prediction from which on a pair has a model; the others are optimistic
    """
    grid = fitting_grid(source.n_variables, source.n_actions, None, breadth, LEAST_WEIGHT_ON_GRID, source.periodic)
    mdp = FiniteMDP(grid, source.n_actions, gamma)
    n_points, cells = grid.n_points, grid.arrays.cells
    states = np.tile(grid.points(), (mdp.n_actions, 1))
    actions = np.repeat(np.arange(mdp.n_actions), n_points)
    at, reward, weight = states.copy(), np.zeros(len(states)), np.zeros(len(states))
    # The probability that the episode goes on, discounted for all steps but one, which the MDP discounts itself.
    goes_on = np.ones(len(states))
    going = np.arange(len(states))
    for step in range(MAX_STEPS):
        goes_on[going] *= 1.0 if step == 0 else mdp.gamma
        found = model.predict(at[going], actions[going])
        reward[going] += goes_on[going] * found.reward
        goes_on[going] *= 1.0 - found.end
        at[going] += found.effect
        if step == 0:
            weight[:] = found.weight
        left = (np.abs(at[going] - states[going]) * cells).max(axis=1) >= 1.0
        # Of those that have no model it does not matter.
        going = going[~left & (goes_on[going] > 0.0) & (weight[going] >= min_weight)]
    pairs = np.arange(len(states))
    mdp.write_rows(pairs, weight >= min_weight, goes_on[:, None], (at - states)[:, None], reward)
    return mdp


def planning_tolerance(source: SourceInstances) -> float:
    """Return the change of value that is too small to matter."""
    lowest, highest = float(source.rewards.min()), float(source.rewards.max())
    return _TOLERANCE * max(highest - lowest, abs(highest), 1e-6)
