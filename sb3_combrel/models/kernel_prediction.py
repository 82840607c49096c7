"""Compiled loops of the kernel average at an exact state: which instances are near it, and what they predict."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import any_periodic, near_instances, squared_distance
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.planning.q_values import Prediction


class NearLists(NamedTuple):
    """The kept instances at an exact state, one row an action.

    :param item: int32, shape (n_actions, list room): instances, nearest first; ``weight``: float64, same shape
    :param length: int64, shape (n_actions,)
    """

    item: np.ndarray
    weight: np.ndarray
    length: np.ndarray


@part
def predict_own(instances, state, kernel, threshold, near, prediction):
    """Predict every action at ``state`` from the instances that the kernel keeps there.

    :param kernel: (breadth, min_weight, min_fraction)
    :param near: receives these instances; those of the last query make the search shorter
    :param prediction: receives the prediction; an action of less weight than ``threshold`` has none. An action that was
        known stays known: one whose list a nearer instance has shortened counts as weighing ``threshold``.
    :return: the least weight that an action has
    """
    least = np.inf
    for action in range(len(near.length)):
        item = near.item[action]
        weight = near.weight[action]
        n, total = near_instances(instances, action, state, kernel, item, weight, near.length[action])
        near.length[action] = n
        prediction.reward[action] = 0.0
        prediction.length[action] = 0
        if total > 0.0:
            predict_from_lists(instances, action, near, total, prediction)
        if total < threshold and known_before(instances, action, state, kernel, threshold, total):
            total = threshold
        prediction.weight[action] = total
        prediction.modelled[action] = total >= threshold
        least = min(least, total)
    return least


@part
def known_before(instances, action, state, kernel, threshold, total):
    """Whether the kept instances at ``state``, of weight ``total``, reached the threshold before nearer ones came.

    Let f be ``min_fraction`` and T the threshold. An instance with which a list reaches T weighs at least f times the sum P
    of those before it, and T - P, hence f T / (1 + f). So lists that reach T consist, up to there, of instances of at
    least that weight, and once all of these sum to T they always will. A nearer instance can only push such a list below T
    when what remains has at least T / (1 + f).
    """
    breadth, _, min_fraction = kernel
    if total * (1.0 + min_fraction) < threshold:
        return False
    least = min_fraction * threshold / (1.0 + min_fraction)
    scale = -1.0 / (breadth * breadth)
    farthest = np.log(least) / scale
    everything = 0.0
    wraps = any_periodic(instances.periodic)
    for i in range(instances.size[action]):
        distance = squared_distance(state, instances.state[action, i], instances.periodic, wraps)
        if distance <= farthest:
            everything += np.exp(distance * scale)
    return everything >= threshold


@compiled
def predict_own_plain(instances, state, kernel, threshold, near, prediction):
    """:func:`predict_own` for callers from Python, with plain tuples."""
    return predict_own(Instances(*instances), state, kernel, threshold, NearLists(*near), Prediction(*prediction))


@inlined
def enter_successor(prediction, action, n, p, effect):
    """Write the ``n``-th successor of an action, of probability ``p``."""
    prediction.probability[action, n] = p
    for v in range(len(effect)):
        prediction.effect[action, n, v] = effect[v]


@part
def predict_from_lists(instances, action, near, total, prediction):
    """Enter what the instances in ``near`` predict of an action, all instances weighing ``total``."""
    reward = 0.0
    n = 0
    for k in range(near.length[action]):
        i = near.item[action, k]
        p = near.weight[action, k] / total
        reward += p * instances.reward[action, i]
        if not instances.terminated[action, i]:
            enter_successor(prediction, action, n, p, instances.effect[action, i])
            n += 1
    prediction.reward[action] = reward
    prediction.length[action] = n


@part
def join_transferred(instances, near, transferred, threshold, prediction):
    """Let transferred instances join the prediction of the actions whose own instances weigh less than ``threshold``.

    :param transferred: one row an action
    """
    for action in range(len(near.length)):
        n_transferred = transferred.length[action]
        if prediction.weight[action] >= threshold or n_transferred == 0:
            continue
        total = prediction.weight[action]
        for j in range(n_transferred):
            total += transferred.weight[action, j]
        predict_from_lists(instances, action, near, total, prediction)
        n = prediction.length[action]
        reward = prediction.reward[action]
        for j in range(n_transferred):
            p = transferred.weight[action, j] / total
            reward += p * transferred.reward[action, j]
            if not transferred.terminated[action, j]:
                enter_successor(prediction, action, n, p, transferred.effect[action, j])
                n += 1
        prediction.reward[action] = reward
        prediction.length[action] = n
        prediction.modelled[action] = True


@compiled
def join_transferred_plain(instances, near, transferred, threshold, prediction):
    """:func:`join_transferred` for callers from Python, with plain tuples."""
    transferred = TransferredInstances(*transferred)
    join_transferred(Instances(*instances), NearLists(*near), transferred, threshold, Prediction(*prediction))
