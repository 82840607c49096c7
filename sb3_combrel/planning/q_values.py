"""Q at an exact state: from the instances near it, not from the grid's Q."""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct
from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.kernels import near_instances
from sb3_combrel.planning.corrections import corrected_value, visit


class QueryScratch(ArrayStruct):
    """Work space and results of a query at one state.

    :param index: int32, shape (n_actions, list room): kept instances of each action, nearest first
    :param weight: float64, same shape
    :param length: int64, shape (n_actions,); ``total``: float64, same shape: sum of the weights
    :param position: float64, shape (n_variables,); ``there``: the same
    :param corner_index: int64, shape (2 ** n_variables,); ``corner_weight``: float64, same shape
    """

    index: np.ndarray
    weight: np.ndarray
    length: np.ndarray
    total: np.ndarray
    position: np.ndarray
    there: np.ndarray
    corner_index: np.ndarray
    corner_weight: np.ndarray

    @classmethod
    def empty(cls, n_actions: int, n_variables: int, room: int) -> "QueryScratch":
        """Work space for lists of up to ``room`` instances."""
        return cls(
            index=np.empty((n_actions, room), dtype=np.int32),
            weight=np.empty((n_actions, room)),
            length=np.zeros(n_actions, dtype=np.int64),
            total=np.zeros(n_actions),
            position=np.empty(n_variables),
            there=np.empty(n_variables),
            corner_index=np.empty(2**n_variables, dtype=np.int64),
            corner_weight=np.empty(2**n_variables),
        )


@compiled
def find_near(instances, state, kernel, query):
    """Fill ``query`` with the instances that the kernel keeps at ``state``, for every action.

    :param kernel: (breadth, min_weight, min_fraction)
    :return: the least sum of weights that an action has
    """
    breadth, min_weight, min_fraction = kernel
    least = np.inf
    for action in range(len(query.length)):
        query.length[action], query.total[action] = near_instances(
            instances,
            action,
            state,
            breadth,
            min_weight,
            min_fraction,
            query.index[action],
            query.weight[action],
            query.length[action],
        )
        least = min(least, query.total[action])
    return least


@inlined
def add_successor(p, state, effect, values, corrections, grid, query):
    """(undiscounted value, probability to stay) that one instance adds to a backup at ``state``."""
    moved = 0.0
    for k in range(len(state)):
        last = float(grid.shape[k] - 1)
        here = state[k] * grid.cells[k] + grid.margin[k]
        there = min(max(here + effect[k] * grid.cells[k], 0.0), last)
        moved = max(moved, abs(there - here))
        query.position[k] = there
    if moved < 1e-9:
        return 0.0, p
    return p * corrected_value(values, corrections, query.position, grid, query), 0.0


@part
def q_values(instances, state, threshold, gamma, values, corrections, grid, bounds, supply, query, q):
    """Q of every action at ``state``, from the lists in ``query`` and the supply for it.

    An effect of exactly nothing leads back to the state itself, whose value is the maximum sought, not the
    interpolated one: as in ``build_row``, staying is summed as a geometric series.

    :param bounds: (min_value, max_value); an optimistic action has the latter
    :param supply: one row an action; counts where the action's own weights stay below ``threshold``
    :param q: receives the values, shape (n_actions,)
    """
    for action in range(len(q)):
        n_supplied = 0
        total = query.total[action]
        if total < threshold:
            n_supplied = supply.count[action]
            if n_supplied == 0:
                q[action] = bounds[1]
                continue
            for j in range(n_supplied):
                total += supply.weight[action, j]
        reward = 0.0
        after = 0.0
        stay = 0.0
        for k in range(query.length[action]):
            i = query.index[action, k]
            p = query.weight[action, k] / total
            reward += p * instances.reward[action, i]
            if not instances.terminated[action, i]:
                a, s = add_successor(p, state, instances.effect[action, i], values, corrections, grid, query)
                after += a
                stay += s
        for j in range(n_supplied):
            p = supply.weight[action, j] / total
            reward += p * supply.reward[action, j]
            if not supply.terminated[action, j]:
                a, s = add_successor(p, state, supply.effect[action, j], values, corrections, grid, query)
                after += a
                stay += s
        leave = 1.0 - gamma * stay
        if leave >= 1e-9:
            value = (reward + gamma * after) / leave
        elif reward == 0.0:
            value = 0.0
        else:
            value = np.inf * reward
        q[action] = min(max(value, bounds[0]), bounds[1])


@compiled
def choose(instances, state, threshold, gamma, values, corrections, grid, bounds, supply, query, q, visitor):
    """Action values at a state, from the lists in ``query``, and what is to be remembered of the visit.

    :param visitor: see ``corrections.visit``; an episode of -1: nobody is there, nothing is remembered
    :return: the best action, -1 if several are
    """
    q_values(instances, state, threshold, gamma, values, corrections, grid, bounds, supply, query, q)
    best = 0
    ties = 0
    for action in range(1, len(q)):
        if q[action] > q[best]:
            best = action
            ties = 0
        elif q[action] == q[best]:
            ties += 1
    if visitor[0] >= 0:
        visit(values, corrections, state, q[best], visitor, grid, query)
    return -1 if ties > 0 else best
