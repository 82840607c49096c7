"""Q at an exact state: from what the model predicts there, not from the grid's Q."""

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import entry_point, inlined
from sb3_combrel.common.periodic import difference
from sb3_combrel.planning.grid import GridArrays, between_lines, corners_of, grid_coordinate, grid_coordinates, interpolate
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
    """The value of any state, multilinear between the grid points."""

    values: np.ndarray  # float64, (n_points,)
    grid: tuple[Any, ...]  # GridArrays as a plain tuple (see ``common.compiled``)
    gamma: float
    bounds: tuple[float, float]  # min_value, max_value
    worth: np.ndarray  # float64, (n_points,): value of an optimistic action at the grid points
    holds: bool = False  # whether an action that moves by a part of a cell is held until the cell is left


@inlined
def move(state, effect, grid, position):
    """Write where ``effect`` leads from ``state`` to ``position`` (grid coordinates); by how many cells, at most 1."""
    moved = 0.0
    for k in range(len(state)):
        here = grid_coordinate(state[k], k, grid)
        there = here + effect[k] * grid.cells[k] if grid.even else between_lines(state[k] + effect[k], k, grid)
        if grid.periodic[k]:
            moved = max(moved, abs(difference(effect[k], 0.0, True)) * grid.cells[k])
        else:
            there = min(max(there, 0.0), float(grid.shape[k] - 1))
            moved = max(moved, abs(there - here))
        position[k] = there
    return min(moved, 1.0) if moved >= 1e-9 else 0.0


@inlined
def optimistic_value(state, function, grid, scratch):
    """The value of an action without a model at ``state``: exactly ``max_value`` where all around are worth that."""
    position, corner_index, corner_weight = scratch
    grid_coordinates(state, grid, position)
    value = function.bounds[1]
    for c in range(corners_of(position, grid, corner_index, corner_weight)):
        value += corner_weight[c] * (function.worth[corner_index[c]] - function.bounds[1])
    return value


@entry_point
def evaluate_actions(prediction, state, function, q, scratch):
    """Q of every action at ``state``, into ``q``, shape (n_actions,); the best action, -1 if several are; plain tuples.

    An effect of exactly nothing leads back to the state itself, whose value is the maximum sought, not the interpolated one:
    as in ``finish_row``, staying is summed as a geometric series. Where actions are held, of a move by a part of a cell the
    rest counts as staying: values between grid points may promise more than any action keeps, as across a wall, and a step
    that hardly moves would never pay for it. Munos & Moore (2002) follow a control until it leaves the cell.
    """
    prediction, function = Prediction(*prediction), ValueFunction(*function)
    grid = GridArrays(*function.grid)
    position, corner_index, corner_weight = scratch
    best, ties, here = 0, 0, 0.0
    if function.holds:
        grid_coordinates(state, grid, position)
        here = interpolate(function.values, position, grid, corner_index, corner_weight)
    for action in range(len(q)):
        if prediction.modelled[action]:
            after, stay = 0.0, 0.0
            for k in range(prediction.length[action]):
                p = prediction.probability[action, k]
                part = move(state, prediction.effect[action, k], grid, position)
                if part > 0.0:
                    rest = 1.0 - part if function.holds else 0.0
                    there = interpolate(function.values, position, grid, corner_index, corner_weight)
                    after += p * (there - rest * here)
                    stay += p * rest
                else:
                    stay += p
            leave = 1.0 - function.gamma * stay
            reward = prediction.reward[action]
            value = infinite_reward(reward) if leave < NEVER_LEAVES else (reward + function.gamma * after) / leave
            q[action] = min(max(value, function.bounds[0]), function.bounds[1])
        else:
            q[action] = optimistic_value(state, function, grid, scratch)
        if q[action] > q[best]:
            best, ties = action, 0
        elif action > 0 and q[action] == q[best]:
            ties += 1
    return -1 if ties > 0 else best


class QValues:
    """Action values at exact states, with work space of their own."""

    def __init__(self, n_actions: int, n_variables: int):
        self.q = np.empty(n_actions)
        self._scratch = np.empty(n_variables), np.empty(2**n_variables, dtype=np.int64), np.empty(2**n_variables)

    def compute(self, prediction: Prediction, state: np.ndarray, function: ValueFunction) -> int:
        """Compute :attr:`q` at a state from what the model predicts there.

        :param state: unit coordinates, shape (n_variables,)
        :return: the best action, -1 if several are
        """
        best: int = evaluate_actions.call(tuple(prediction), state, tuple(function), self.q, self._scratch)
        return best
