"""The kernel average of Jong & Stone (2007): reward and relative effects as weighted means of the instances near a state."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import any_periodic, list_room, near_instances, squared_distance
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import InstanceTransfer, ModelSettings
from sb3_combrel.models.grid_model import GridModel, add_to_row, total_weight
from sb3_combrel.models.grid_points import PairArrays, note_fit
from sb3_combrel.planning.grid import GridArrays, coordinates_of, unit_coordinates_of
from sb3_combrel.planning.mdp import FiniteMDP, MDPArrays, RowScratch, add_successor, finish_row, set_modelled
from sb3_combrel.planning.q_values import Prediction


class NearList(NamedTuple):
    """The kept instances at a state."""

    item: np.ndarray  # int32, (list room,): instances, nearest first
    weight: np.ndarray  # float64, the same
    at: np.ndarray  # float64, (n_variables,)


@compiled
def weight_ever(instances, action, state, kernel, threshold, total):
    """``total``, the weight of the kept instances at ``state``; ``threshold`` if it had reached that before nearer ones came.

    Let f be ``min_fraction`` and T the threshold. An instance with which a list reaches T weighs at least f times the sum P
    of those before it, and T - P, hence f T / (1 + f). So lists that reach T consist, up to there, of instances of at
    least that weight, and once all of these sum to T they always will. A nearer instance can only push such a list below T
    when what remains has at least T / (1 + f).
    """
    breadth, _, min_fraction = kernel
    if total >= threshold or total * (1.0 + min_fraction) < threshold:
        return total
    scale = -1.0 / (breadth * breadth)
    farthest = np.log(min_fraction * threshold / (1.0 + min_fraction)) / scale
    everything = 0.0
    wraps = any_periodic(instances.periodic)
    for i in range(instances.size[action]):
        distance = squared_distance(state, instances.state[action, i], instances.periodic, wraps)
        if distance <= farthest:
            everything += np.exp(distance * scale)
    return threshold if everything >= threshold else total


@entry_point
def predict_own(instances, state, kernel, threshold, near, prediction):
    """Predict every action at ``state`` from the instances that the kernel keeps there; the least weight that one has.

    :param kernel: (breadth, min_weight, min_fraction); plain tuples for the rest
    """
    instances, near, prediction = Instances(*instances), NearList(*near), Prediction(*prediction)
    breadth, min_weight, _ = kernel
    farthest = -np.log(min_weight) * breadth * breadth
    least = np.inf
    for action in range(len(instances.size)):
        length, total = near_instances(instances, action, state, farthest, kernel, near.item, near.weight)
        reward = 0.0
        n = 0
        for k in range(length):
            i, p = near.item[k], near.weight[k] / total
            reward += p * instances.reward[action, i]
            if not instances.terminated[action, i]:
                prediction.probability[action, n] = p
                for v in range(len(state)):
                    prediction.effect[action, n, v] = instances.effect[action, i, v]
                n += 1
        weight = weight_ever(instances, action, state, kernel, threshold, total)
        prediction.reward[action], prediction.length[action] = reward, n
        prediction.weight[action], prediction.modelled[action] = weight, weight >= threshold
        least = min(least, weight)
    return least


@inlined
def entry_distance(near, length, total, kernel, threshold, known):
    """The squared distance within which an instance changes a list, or whether a pair that is not known yet is known.

    The latter see :func:`weight_ever`.
    """
    breadth, min_weight, min_fraction = kernel
    least = min_weight
    if length > 0:
        counts = min_fraction * (total if known else min(total, threshold / (1.0 + min_fraction)))
        least = max(min_weight, min(near.weight[length - 1], counts))
    return -np.log(least) * breadth * breadth * (1 + 1e-12)


@entry_point
def update_rows(instances, pairs, mdp, grid, kernel, planned, which, transferred, row_scratch, near):
    """Write rows of pairs from the instances that the kernel keeps, and from transferred ones; how many are done.

    :param planned: (gamma, threshold, transitions so far); plain tuples for the rest
    :param which: (pairs, how many of them are done)
    :param transferred: a row for each of them, which counts only while the pair is not known
    """
    instances, pairs, mdp, grid = Instances(*instances), PairArrays(*pairs), MDPArrays(*mdp), GridArrays(*grid)
    transferred, row_scratch, near = TransferredInstances(*transferred), RowScratch(*row_scratch), NearList(*near)
    gamma, threshold, transitions = planned
    which, done = which
    n_points = len(mdp.n_optimistic)
    while done < len(which):
        pair = which[done]
        point = pair % n_points
        action = pair // n_points
        coordinates_of(point, grid, row_scratch.at)
        unit_coordinates_of(row_scratch.at, grid, near.at)
        # Instances only come nearer, but for those that are removed (see grid_points.look_at).
        length, total = near_instances(instances, action, near.at, pairs.reach[pair], kernel, near.item, near.weight)
        weight = weight_ever(instances, action, near.at, kernel, threshold, total)
        known = note_fit(pair, length, weight, threshold, transitions, pairs)
        pairs.reach[pair] = entry_distance(near, length, total, kernel, threshold, known)
        joined = not known and transferred.length[done] > 0
        if known or joined:
            if joined:
                total = total_weight(total, transferred, done)
            reward = 0.0
            n_touched = np.int64(0)
            for k in range(length):
                i, p = near.item[k], near.weight[k] / total
                reward += p * instances.reward[action, i]
                if not instances.terminated[action, i]:
                    n_touched = add_successor(p, instances.effect[action, i], row_scratch, grid, n_touched)
            if joined:
                reward, n_touched = add_to_row(reward, n_touched, transferred, done, total, row_scratch, grid)
            if not finish_row(mdp, gamma, pair, point, reward, n_touched, row_scratch):
                return done
        set_modelled(mdp, pair, known or joined)
        done += 1
    return done


class KernelAverage(GridModel):
    """The model of Jong & Stone (2007), one for each action.

    An instance at distance d (unit coordinates) weighs exp(-d^2 / breadth^2). Instances that weigh less than ``min_weight``
    do not count; of the others, nearest first, one counts while its weight is at least ``min_fraction`` of the sum of those
    before it. A nearer instance can so shorten the list of a known pair, which is a better model, not less knowledge: the
    pair stays known.
    """

    # Rows of dozens of successors take long to back up.
    follows_changes = True

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        self._own_room = list_room(settings.min_fraction)
        super().__init__(mdp, settings, transfer)
        self._weights = float(settings.model_breadth), float(settings.min_weight), float(settings.min_fraction)
        room = self._own_room
        self._near = tuple(NearList(np.zeros(room, dtype=np.int32), np.empty(room), np.empty(self.grid.n_variables)))

    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        mdp, planned = self.mdp, (self.mdp.gamma, self._threshold, self.n_added)
        model = self._plain_experience[0], tuple(self.pairs), tuple(mdp.arrays), self.grid.plain, self._weights
        return int(update_rows.call(*model, planned, pairs, transferred, tuple(mdp.scratch), self._near))

    def _predict_own(self, state: np.ndarray) -> float:
        given = state, self._weights, self.exploration_threshold, self._near, tuple(self._prediction)
        return float(predict_own.call(self._plain_experience[0], *given))
