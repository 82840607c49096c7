"""A source task as a finite MDP, by what its local linear model predicts at the states of a grid, and its greedy policy."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.constants import MAX_MODEL_STEPS, SWEEPS_AT_EPISODE_END
from sb3_combrel.planning.grid import fitting_grid
from sb3_combrel.planning.mdp import FiniteMDP
from sb3_combrel.planning.planner import Planner
from sb3_combrel.planning.q_values import Prediction, QValues, ValueFunction
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import MIN_WEIGHT, SourceModel

THRESHOLD = 1.0  # weight of instances from which on a prediction counts, as by default in Fitted R-Max
_TOLERANCE = 0.001  # changes of value up to this part of the range of a step's rewards end the planning


def plan_source(
    source: SourceInstances, gamma: float, breadth: float, min_weight: float, bounds: tuple[float, float]
) -> tuple[SourceModel, Planner]:
    """Make a source's model and, of what each action, held until the cell is left, does on a grid, a planner without sweeps.

    :param min_weight: pairs with less data are optimistic; ``bounds``: the least and the largest value
    """
    model = SourceModel(stacked_instances([source]), breadth)
    grid = fitting_grid(source.n_variables, source.n_actions, None, breadth, MIN_WEIGHT, source.periodic)
    mdp = FiniteMDP(grid, source.n_actions, gamma)
    n_points, cells = grid.n_points, grid.arrays.cells
    states = np.tile(grid.points(), (mdp.n_actions, 1))
    actions = np.repeat(np.arange(mdp.n_actions), n_points)
    at, reward, weight = states.copy(), np.zeros(len(states)), np.zeros(len(states))
    # The probability that the episode goes on, discounted for all steps but one, which the MDP discounts itself.
    goes_on = np.ones(len(states))
    going = np.arange(len(states))
    # As the learner's: values that are interpolated at every step would spread over the grid.
    for step in range(MAX_MODEL_STEPS):
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
    mdp.write_rows(np.arange(len(states)), weight >= min_weight, goes_on[:, None], (at - states)[:, None], reward)
    lowest, highest = float(source.rewards.min()), float(source.rewards.max())
    tolerance = _TOLERANCE * max(highest - lowest, abs(highest), 1e-6)
    return model, Planner(mdp, max_value=bounds[1], min_value=bounds[0], tolerance=tolerance)


class SourcePolicy:
    """What is best in a source task, as far as its instances tell: Fitted R-Max's planning, but without optimism.

    An action with too few instances near a state cannot be taken there; a grid point without any action is worth the least
    that there is. ``gamma`` is below 1: the least and the largest value follow from it.
    """

    def __init__(self, source: SourceInstances, gamma: float, breadth: float):
        lowest, highest = float(source.rewards.min()), float(source.rewards.max())
        bounds = min(0.0, lowest) / (1.0 - gamma), max(0.0, highest) / (1.0 - gamma)
        self.model, planner = plan_source(source, gamma, breadth, THRESHOLD, bounds)
        self.values = planner.cautious_values(SWEEPS_AT_EPISODE_END)  #: value of each grid point
        self.grid = planner.mdp.grid
        n, d = source.n_actions, source.n_variables
        self._function = ValueFunction(self.values, self.grid.plain, float(gamma), bounds, planner.upper)
        self._q, self._actions, self._length = QValues(n, d), np.arange(n), np.ones(n, dtype=np.int64)

    def q_values(self, state: np.ndarray) -> np.ndarray:
        """Action values at a state of the source, unit coordinates; -inf for actions with too few instances near it."""
        found = self.model.predict(np.repeat(state[None], len(self._actions), axis=0), self._actions)
        modelled = found.weight >= THRESHOLD
        successors = (1.0 - found.end)[:, None], found.effect[:, None]
        self._q.compute(Prediction(modelled, found.weight, found.reward, self._length, *successors), state, self._function)
        return np.where(modelled, self._q.q, -np.inf)
