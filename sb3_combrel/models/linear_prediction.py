"""Compiled loops of the local linear model at an exact state: the nearest instances, and the fit to them."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import nearest_instances
from sb3_combrel.common.linear_regression import add_products, fitted_effect, n_products, products_of, solve_regression
from sb3_combrel.common.periodic import bring_near
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.compiled_model import add_to_prediction, total_weight
from sb3_combrel.models.fit_arrays import Kernel
from sb3_combrel.models.linear_fits import PRIOR_WEIGHT, RIDGE, mean_outcome, narrowed, unexplained_effect
from sb3_combrel.planning.grid import GridArrays, corners_of, grid_coordinates
from sb3_combrel.planning.q_values import Prediction


class NearestLists(NamedTuple):
    """The nearest instances at an exact state, one row an action, and work space for fits."""

    item: np.ndarray  # int32, (n_actions, n_neighbors): instances, nearest first
    distance: np.ndarray  # float64, the same: their squared distances
    length: np.ndarray  # int64, (n_actions,)
    state: np.ndarray  # float64, (n_variables,)
    products: np.ndarray  # float64, (2, n_products): sums, and of one instance
    factor: np.ndarray  # float64, (n_variables, n_variables)
    fit: np.ndarray  # as in LinearFits, of one pair
    outcome: np.ndarray  # as in LinearFits, of one pair

    @classmethod
    def empty(cls, n_actions: int, n_neighbors: int, n_variables: int) -> "NearestLists":
        """Make room for so many."""
        d = n_variables
        return cls(
            item=np.zeros((n_actions, n_neighbors), dtype=np.int32),
            distance=np.empty((n_actions, n_neighbors)),
            length=np.zeros(n_actions, dtype=np.int64),
            state=np.empty(d),
            products=np.empty((2, n_products(d))),
            factor=np.empty((d, d)),
            fit=np.empty(d + d * d),
            outcome=np.empty(3 + 2 * d),
        )


@part
def fit_nearest(instances, target, action, state, kernel, near):
    """Fit the effect around ``state`` to the instances in ``near``, into ``near.fit``; the weight that decides on known."""
    length = near.length[action]
    nearest, last = near.distance[action, 0], near.distance[action, length - 1]
    scale = narrowed(last, kernel) if length == kernel.n_neighbors else kernel.scale
    sums, products, outcome = near.products[0], near.products[1], near.outcome
    sums[:] = 0.0
    outcome[:] = 0.0
    d = len(state)
    total = 0.0
    for k in range(length):
        i = near.item[action, k]
        distance = near.distance[action, k]
        bring_near(instances.state[action, i], state, instances.periodic, near.state)
        products_of(near.state, target[action, i], products)
        add_products(sums, np.exp(distance * scale), products)
        total += np.exp(distance * kernel.counting_scale)
        # Seen from the nearest: far from all instances the weights would be too small for a quotient.
        weight = np.exp((distance - nearest) * kernel.outcome_scale)
        outcome[0] += weight
        outcome[1] += weight * instances.reward[action, i]
        if instances.terminated[action, i]:
            outcome[2] += weight
        for v in range(d):
            outcome[3 + v] += weight * near.state[v]
            outcome[3 + d + v] += weight * target[action, i, v]
    closeness = max(1e-200, np.exp(nearest * kernel.outcome_scale))
    for k in range(len(outcome)):
        outcome[k] *= closeness
    solve_regression(sums, -RIDGE / scale, near.factor, near.fit)
    return total


@inlined
def enter_mean(prediction, action, near, state, prior, claimed, known, effect_range):
    """Enter reward, end and mean effect of an action; ``claimed``: the prior makes a model, ``known``: the instances do."""
    d = len(state)
    if near.length[action] > 0:
        reward, end = mean_outcome(near.outcome, prior, claimed and not known)
        share = near.products[0, 0] / (near.products[0, 0] + (PRIOR_WEIGHT if claimed else 0.0))
    else:
        reward, end, share = prior[d], prior[d + 1], 0.0
    prediction.reward[action] = reward
    prediction.length[action] = 1 if end < 1.0 else 0
    prediction.probability[action, 0] = 1.0 - end
    for v in range(d):
        effect = prior[v]
        if share > 0.0:
            effect += share * (fitted_effect(near.fit, state, v) + unexplained_effect(near.fit, near.outcome, v))
        prediction.effect[action, 0, v] = min(max(effect, effect_range[0, action, v]), effect_range[1, action, v])


@compiled
def predict_own(instances, of_model, state, kernel, threshold, near, prediction):
    """Predict every action at ``state`` from the instances nearest to it, and from the prior; the least weight one has.

    :param of_model: (target, effect_range) as in ``LinearFits``; what the prior predicts at ``state``, float64, shape
        (n_actions, n_variables + 2); and whether that suffices for a model, bool, shape (n_actions,)
    :param near: receives these instances; those of the last query make the search shorter; plain tuples for the rest
    """
    instances, kernel = Instances(*instances), Kernel(*kernel)
    near, prediction = NearestLists(*near), Prediction(*prediction)
    target, effect_range, prior, claimed = of_model
    least = np.inf
    for action in range(len(near.length)):
        item = near.item[action]
        distance = near.distance[action]
        n = nearest_instances(instances, action, state, kernel.reach, item, distance, near.length[action])
        near.length[action] = n
        total = 0.0
        prediction.reward[action] = 0.0
        prediction.length[action] = 0
        if n > 0:
            total = fit_nearest(instances, target, action, state, kernel, near)
        if n > 0 or claimed[action]:
            known = total >= threshold
            enter_mean(prediction, action, near, state, prior[action], claimed[action], known, effect_range)
        prediction.weight[action] = total
        prediction.modelled[action] = total >= threshold or claimed[action]
        least = min(least, total)
    return least


@compiled
def join_transferred(transferred, threshold, prediction):
    """Let transferred instances join the prediction of actions of less weight than ``threshold``; plain tuples."""
    transferred, prediction = TransferredInstances(*transferred), Prediction(*prediction)
    for action in range(len(prediction.weight)):
        own = prediction.weight[action]
        if own < threshold and transferred.length[action] > 0:
            total = total_weight(own, transferred, action)
            for k in range(prediction.length[action]):
                prediction.probability[action, k] *= own / total
            prediction.reward[action] *= own / total
            add_to_prediction(prediction, action, transferred, total)


@compiled
def interpolate_prior(prior, grid, states, actions, corners, found):
    """Write the effects that a prior predicts of states and actions, multilinear between the grid points, to ``found``.

    :param prior: as in ``LinearFits``; ``corners``: work space: position, corner_index, corner_weight (see ``corners_of``)
    """
    grid = GridArrays(*grid)
    position, corner, weight = corners
    d = len(position)
    n_points = grid.shape[0] * grid.strides[0]
    for i in range(len(actions)):
        grid_coordinates(states[i], grid, position)
        found[i, :] = 0.0
        first_pair = actions[i] * n_points
        for c in range(corners_of(position, grid, corner, weight)):
            for k in range(d):
                found[i, k] += weight[c] * prior[first_pair + corner[c], k]
