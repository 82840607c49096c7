"""Q at an exact state: from what the model predicts there, not from the grid's Q."""

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined, part
from sb3_combrel.common.periodic import difference
from sb3_combrel.planning.corrections import CorrectionArrays, ValueScratch, corrected_value, visit
from sb3_combrel.planning.grid import GridArrays, corners_of, grid_coordinates
from sb3_combrel.planning.mdp import NEVER_LEAVES, infinite_reward


class Prediction(NamedTuple):
    """What a model predicts at one state, one row an action. Unit coordinates."""

    modelled: np.ndarray  # bool, (n_actions,): the action has a model; the others are optimistic
    weight: np.ndarray  # float64, (n_actions,): weight of the target's own instances behind it
    reward: np.ndarray  # float64, (n_actions,): expected reward
    length: np.ndarray  # int64, (n_actions,): how many successors it has
    probability: np.ndarray  # float64, (n_actions, max_successors); what is missing to 1 ends the episode
    effect: np.ndarray  # float64, (n_actions, max_successors, n_variables): displacement to each successor

    @classmethod
    def empty(cls, n_actions: int, max_successors: int, n_variables: int) -> "Prediction":
        """Make room for so many successors of each action; no action has a model."""
        return cls(
            modelled=np.zeros(n_actions, dtype=np.bool_),
            weight=np.zeros(n_actions),
            reward=np.zeros(n_actions),
            length=np.zeros(n_actions, dtype=np.int64),
            probability=np.zeros((n_actions, max_successors)),
            effect=np.zeros((n_actions, max_successors, n_variables)),
        )


class ValueFunction(NamedTuple):
    """The value of any state."""

    values: np.ndarray  # float64, (n_points,), at the grid points
    corrections: CorrectionArrays  # caps on what is interpolated between them
    grid: GridArrays
    gamma: float
    bounds: tuple[float, float]  # min_value, max_value
    upper: np.ndarray  # float64, (n_points,): value of an optimistic action at the grid points


# The same as plain tuples (see ``common.compiled``).
PlainValueFunction = tuple[np.ndarray, tuple[Any, ...], tuple[Any, ...], float, tuple[float, float], np.ndarray]


@inlined
def moves(state, effect, grid, scratch):
    """Write where ``effect`` leads from ``state`` to ``scratch.position`` (grid coordinates); whether that is elsewhere."""
    moved = 0.0
    for k in range(len(state)):
        here = state[k] * grid.cells[k] + grid.margin[k]
        there = here + effect[k] * grid.cells[k]
        if grid.periodic[k]:
            moved = max(moved, abs(difference(effect[k], 0.0, True)) * grid.cells[k])
        else:
            there = min(max(there, 0.0), float(grid.shape[k] - 1))
            moved = max(moved, abs(there - here))
        scratch.position[k] = there
    return moved >= 1e-9


@part
def q_values(prediction, state, function, q, scratch):
    """Q of every action at ``state``.

    An effect of exactly nothing leads back to the state itself, whose value is the maximum sought, not the
    interpolated one: as in ``finish_row``, staying is summed as a geometric series.
    """
    n_optimistic = 0
    for action in range(len(q)):
        if not prediction.modelled[action]:
            n_optimistic += 1
            continue
        after = 0.0
        stay = 0.0
        for k in range(prediction.length[action]):
            p = prediction.probability[action, k]
            if moves(state, prediction.effect[action, k], function.grid, scratch):
                after += p * corrected_value(function.values, function.corrections, function.grid, scratch)
            else:
                stay += p
        leave = 1.0 - function.gamma * stay
        reward = prediction.reward[action]
        value = infinite_reward(reward) if leave < NEVER_LEAVES else (reward + function.gamma * after) / leave
        q[action] = min(max(value, function.bounds[0]), function.bounds[1])
    if n_optimistic > 0:
        upper = optimistic_value(state, function, scratch)
        for action in range(len(q)):
            if not prediction.modelled[action]:
                q[action] = upper


@inlined
def optimistic_value(state, function, scratch):
    """The value of an action without a model at ``state``: exactly ``max_value`` where that is the bound all around."""
    grid_coordinates(state, function.grid, scratch.position)
    value = function.bounds[1]
    for c in range(corners_of(scratch.position, function.grid, scratch.corner_index, scratch.corner_weight)):
        value += scratch.corner_weight[c] * (function.upper[scratch.corner_index[c]] - function.bounds[1])
    return value


@compiled
def evaluate_actions(prediction, state, function, q, visitor, scratch):
    """See :meth:`QValues.compute`; ``q`` receives the values, shape (n_actions,), and the rest are plain tuples."""
    prediction, scratch = Prediction(*prediction), ValueScratch(*scratch)
    values, corrections, grid, gamma, bounds, upper = function
    function = ValueFunction(values, CorrectionArrays(*corrections), GridArrays(*grid), gamma, bounds, upper)
    q_values(prediction, state, function, q, scratch)
    best = 0
    ties = 0
    for action in range(1, len(q)):
        if q[action] > q[best]:
            best = action
            ties = 0
        elif q[action] == q[best]:
            ties += 1
    if visitor[0] >= 0:
        visit(function.values, function.corrections, state, q[best], visitor, function.grid, scratch)
    return -1 if ties > 0 else best


_evaluate_actions = EntryPoint(evaluate_actions)
# An episode of -1: the agent is not there, and nothing is counted or corrected.
NOBODY = (-1, 0.0, 0)


class QValues:
    """Action values at exact states, with work space of their own."""

    def __init__(self, n_actions: int, n_variables: int):
        self.q = np.empty(n_actions)
        self._scratch = tuple(ValueScratch.for_variables(n_variables))

    def compute(
        self,
        prediction: Prediction,
        state: np.ndarray,
        function: PlainValueFunction,
        visitor: tuple[int, float, int] = NOBODY,
    ) -> int:
        """Compute :attr:`q` at a state from what the model predicts there.

        :param state: unit coordinates, shape (n_variables,)
        :param function: a ValueFunction as plain tuples
        :param visitor: whose visit is counted: (episode, tolerance, max_visits), see ``corrections.visit``
        :return: the best action, -1 if several are
        """
        best: int = _evaluate_actions.call(tuple(prediction), state, function, self.q, visitor, self._scratch)
        return best
