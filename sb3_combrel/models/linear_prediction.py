"""Compiled loops of the local linear model at an exact state: the nearest instances, and the fit to them."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.instances import BLOCK, Instances
from sb3_combrel.common.kernels import any_periodic, measure_gaps, squared_distance
from sb3_combrel.common.linear_regression import add_products, fitted_effect, products_of, solve_regression
from sb3_combrel.common.periodic import bring_near
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.fit_arrays import Kernel
from sb3_combrel.models.linear_fits import PRIOR_WEIGHT, RIDGE, mean_outcome, narrowed, unexplained_effect
from sb3_combrel.planning.q_values import Prediction


class NearestLists(NamedTuple):
    """The nearest instances at an exact state, one row an action, and work space for fits.

    :param item: int32, shape (n_actions, n_neighbors): instances, nearest first
    :param distance: float64, same shape: their squared distances
    :param length: int64, shape (n_actions,)
    :param state: float64, shape (n_variables,)
    :param products: float64, shape (2, n_products): sums, and of one instance
    :param factor: float64, shape (n_variables, n_variables); ``fit`` and ``outcome``: as in ``LinearFits``, of one pair
    """

    item: np.ndarray
    distance: np.ndarray
    length: np.ndarray
    state: np.ndarray
    products: np.ndarray
    factor: np.ndarray
    fit: np.ndarray
    outcome: np.ndarray


@inlined
def insert_by_distance(items, distances, length, item, distance):
    """Put an instance into a full or growing list sorted by distance; its length. Of equal ones the lower number is first."""
    room = len(items)
    if length == room:
        last = distances[room - 1]
        if distance > last or (distance == last and item > items[room - 1]):
            return length
        length -= 1
    k = length
    while k > 0 and (distances[k - 1] > distance or (distances[k - 1] == distance and items[k - 1] > item)):
        distances[k] = distances[k - 1]
        items[k] = items[k - 1]
        k -= 1
    items[k] = item
    distances[k] = distance
    return length + 1


@part
def nearest_instances(instances, action, state, farthest, items, distances, n_before):
    """The nearest instances of ``action``, nearest first, as many as ``items`` has room for.

    What was near at the last query is looked at first; the result does not depend on it.

    :param farthest: squared distance beyond which none counts
    :param items: int32; receives them. ``distances``: float64; receives their squared distances
    :param n_before: how many of the last query are in ``items``
    :return: how many
    """
    count = instances.size[action]
    room = len(items)
    wraps = any_periodic(instances.periodic)
    instances.searches[0] += 1
    search = instances.searches[0]
    length = np.int64(0)
    for b in range(n_before):
        before = np.int64(items[b])
        if before < count:
            instances.seen[action, before] = search
            distance = squared_distance(state, instances.state[action, before], instances.periodic, wraps)
            if distance <= farthest:
                length = insert_by_distance(items, distances, length, before, distance)
    if length == room:
        farthest = distances[room - 1]
    n_blocks = (count + BLOCK - 1) // BLOCK
    measure_gaps(state, instances.block_low[action], instances.block_high[action], instances.periodic, n_blocks, instances.gap)
    for block in range(n_blocks):
        if instances.gap[block] > farthest:
            continue
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            distance = squared_distance(state, instances.state[action, i], instances.periodic, wraps)
            if distance > farthest or instances.seen[action, i] == search:
                continue
            length = insert_by_distance(items, distances, length, i, distance)
            if length == room:
                farthest = distances[room - 1]
    return length


@part
def fit_nearest(instances, target, action, state, kernel, near):
    """Fit the effect around ``state`` to the instances in ``near``; into ``near.fit``.

    :param target: as in ``LinearFits``
    :return: sum of their weights (of the kernel that decides what is known)
    """
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
    """Enter what is predicted of an action: reward, end, and the mean of its successors, within the range of effects.

    :param prior: float64, shape (n_variables + 2,): effect, reward and end that the prior predicts
    :param claimed: whether the prior suffices for a model; ``known``: whether the instances do
    """
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


@part
def predict_own(instances, of_model, state, kernel, threshold, near, prediction):
    """Predict every action at ``state`` from the instances nearest to it, and from the prior.

    :param of_model: (target, effect_range) as in ``LinearFits``; what the prior predicts at ``state``, float64, shape
        (n_actions, n_variables + 2); and whether that suffices for a model, bool, shape (n_actions,)
    :param near: receives these instances; those of the last query make the search shorter
    :param prediction: receives the prediction; an action of less weight than ``threshold`` has no model without the prior
    :return: the least weight that an action has
    """
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
def predict_own_plain(instances, of_model, state, kernel, threshold, near, prediction):
    """:func:`predict_own` for callers from Python, with plain tuples."""
    instances, near, prediction = Instances(*instances), NearestLists(*near), Prediction(*prediction)
    return predict_own(instances, of_model, state, Kernel(*kernel), threshold, near, prediction)


@compiled
def join_transferred_plain(transferred, threshold, prediction):
    """Let transferred instances join the prediction of the actions whose own instances weigh less than ``threshold``.

    :param transferred: one row an action; plain tuples, as ``prediction``
    """
    transferred, prediction = TransferredInstances(*transferred), Prediction(*prediction)
    for action in range(len(prediction.weight)):
        n_transferred = transferred.length[action]
        own = prediction.weight[action]
        if own >= threshold or n_transferred == 0:
            continue
        total = own
        for j in range(n_transferred):
            total += transferred.weight[action, j]
        n = prediction.length[action]
        for k in range(n):
            prediction.probability[action, k] *= own / total
        reward = own / total * prediction.reward[action]
        for j in range(n_transferred):
            p = transferred.weight[action, j] / total
            reward += p * transferred.reward[action, j]
            if not transferred.terminated[action, j]:
                prediction.probability[action, n] = p
                for v in range(prediction.effect.shape[2]):
                    prediction.effect[action, n, v] = transferred.effect[action, j, v]
                n += 1
        prediction.reward[action] = reward
        prediction.length[action] = n
        prediction.modelled[action] = True
