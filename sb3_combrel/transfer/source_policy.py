"""The greedy policy of a source task, planned from its instances."""

from __future__ import annotations

import numpy as np

from sb3_combrel.planning.corrections import CorrectionArrays
from sb3_combrel.planning.q_values import Prediction, QValues
from sb3_combrel.planning.sweeping import Planner
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_mdp import planning_tolerance, source_mdp
from sb3_combrel.transfer.source_model import SourceModel

# Weight of instances from which on a prediction counts, as by default in Fitted R-Max.
MIN_WEIGHT = 1.0


class SourcePolicy:
    """What is best in a source task, as far as its instances tell: Fitted R-Max's planning, but without optimism.

    An action with too few instances near a state cannot be taken there; a grid point without any action counts as the worst
    of its neighbours.

    :param source: instances of the source task
    :param gamma: discount factor, below 1, as the least and the largest value are computed with it
    :param breadth: kernel breadth of the source's model, in unit coordinates of the source
    """

    def __init__(self, source: SourceInstances, gamma: float, breadth: float):
        self.model = SourceModel(stacked_instances([source]), breadth)
        mdp = source_mdp(source, self.model, gamma, breadth, MIN_WEIGHT)
        lowest, highest = float(source.rewards.min()), float(source.rewards.max())
        bounds = min(0.0, lowest) / (1.0 - gamma), max(0.0, highest) / (1.0 - gamma)
        planner = Planner(mdp, max_value=bounds[1], min_value=bounds[0], tolerance=planning_tolerance(source))
        # From below: values then come from ways that exist, however few sweeps there are.
        planner.values[:] = bounds[0]
        #: Value of each grid point.
        self.values = planner.exploitation_values()
        self.grid = mdp.grid
        n, d = source.n_actions, source.n_variables
        self._function = self.values, tuple(CorrectionArrays.empty(d)), self.grid.plain, float(gamma), bounds, planner.upper
        self._q = QValues(n, d)
        self._actions = np.arange(n)
        self._length = np.ones(n, dtype=np.int64)

    def q_values(self, state: np.ndarray) -> np.ndarray:
        """Action values at a state of the source, unit coordinates; -inf for actions with too few instances near it."""
        found = self.model.predict(np.repeat(state[None], len(self._actions), axis=0), self._actions)
        modelled = found.weight >= MIN_WEIGHT
        successors = (1.0 - found.end)[:, None], found.effect[:, None]
        self._q.compute(Prediction(modelled, found.weight, found.reward, self._length, *successors), state, self._function)
        return np.where(modelled, self._q.q, -np.inf)
