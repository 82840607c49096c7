"""Compiled loops of the kernel average at an exact state: which instances are near it, and what they predict."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, part
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import any_periodic, near_instances, squared_distance
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.compiled_model import add_to_prediction, total_weight
from sb3_combrel.planning.q_values import Prediction


class NearLists(NamedTuple):
    """The kept instances at an exact state, one row an action."""

    item: np.ndarray  # int32, (n_actions, list room): instances, nearest first
    weight: np.ndarray  # float64, the same
    length: np.ndarray  # int64, (n_actions,)


@compiled
def predict_own(instances, state, kernel, threshold, near, prediction):
    """Predict every action at ``state`` from the instances that the kernel keeps there; the least weight that one has.

    An action that was known stays known: one whose list a nearer instance has shortened counts as weighing ``threshold``.

    :param kernel: (breadth, min_weight, min_fraction); plain tuples for the rest
    :param near: receives these instances; those of the last query make the search shorter
    """
    instances, near, prediction = Instances(*instances), NearLists(*near), Prediction(*prediction)
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
            prediction.probability[action, n] = p
            for v in range(instances.effect.shape[2]):
                prediction.effect[action, n, v] = instances.effect[action, i, v]
            n += 1
    prediction.reward[action] = reward
    prediction.length[action] = n


@compiled
def join_transferred(instances, near, transferred, threshold, prediction):
    """Let transferred instances join the prediction of actions of less weight than ``threshold``; plain tuples."""
    instances, near, prediction = Instances(*instances), NearLists(*near), Prediction(*prediction)
    transferred = TransferredInstances(*transferred)
    for action in range(len(near.length)):
        if prediction.weight[action] < threshold and transferred.length[action] > 0:
            total = total_weight(prediction.weight[action], transferred, action)
            predict_from_lists(instances, action, near, total, prediction)
            add_to_prediction(prediction, action, transferred, total)
