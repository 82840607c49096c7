"""The local linear model of a source task: what its instances predict of any state and action of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined, inner
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.linear_regression import add_products, fitted_effect, products_of, solve_regression
from sb3_combrel.common.periodic import bring_near
from sb3_combrel.models.fit_arrays import Kernel
from sb3_combrel.models.linear_fits import RIDGE, narrowed
from sb3_combrel.models.linear_prediction import NearestLists, nearest_instances

DEFAULT_SOURCE_BREADTH = 0.2
DEFAULT_N_NEIGHBORS = 24
DEFAULT_OUTCOME_BREADTH = 0.05  # rewards and ends jump from one state to the next: they are averaged over nearer instances


class SourcePredictions(NamedTuple):
    """What a source predicts of n state-action pairs of its own, float64."""

    effect: np.ndarray  # shape (n, n_variables): predicted displacement, unit coordinates of the source
    reward: np.ndarray  # shape (n,), raw
    end: np.ndarray  # shape (n,): probability of termination
    weight: np.ndarray  # shape (n,): how well founded the prediction is, see SourceModel


@inlined
def source_arrays(plain):
    """Instances, range of effects, Kernel and NearestLists from ``SourceModel.plain``."""
    return Instances(*plain[0]), plain[1], Kernel(*plain[2]), NearestLists(*plain[3])


@inner
def predict_source(instances, effect_range, kernel, near, action, state, effect):
    """Predict a state and action: reward, probability of termination, weight, all 0 without instances; writes ``effect``."""
    item, distance = near.item[action], near.distance[action]
    length = nearest_instances(instances, action, state, kernel.reach, item, distance, near.length[action])
    near.length[action] = length
    d = len(state)
    if length == 0:
        effect[:] = 0.0
        return 0.0, 0.0, 0.0
    scale = narrowed(distance[length - 1], kernel) if length == kernel.n_neighbors else kernel.scale
    sums, products = near.products[0], near.products[1]
    sums[:] = 0.0
    total, outcomes, reward, end = 0.0, 0.0, 0.0, 0.0
    for k in range(length):
        i = item[k]
        bring_near(instances.state[action, i], state, instances.periodic, near.state)
        products_of(near.state, instances.effect[action, i], products)
        # Seen from the nearest: far from all instances the ridge would outweigh them, and a quotient could be 0 / 0.
        beyond = distance[k] - distance[0]
        add_products(sums, np.exp(beyond * scale), products)
        total += np.exp(distance[k] * kernel.scale)
        weight = np.exp(beyond * kernel.outcome_scale)
        outcomes += weight
        reward += weight * instances.reward[action, i]
        if instances.terminated[action, i]:
            end += weight
    solve_regression(sums, -RIDGE / scale, near.factor, near.fit)
    for v in range(d):
        effect[v] = min(max(fitted_effect(near.fit, state, v), effect_range[0, action, v]), effect_range[1, action, v])
    return reward / outcomes, end / outcomes, total / (1.0 + beyond_data(sums, near.factor, state, near.fit))


@inner
def beyond_data(sums, factor, state, scratch):
    """The squared distance of a state from the mean of a fit's instances, in units of their spread along that way."""
    distance = 0.0
    for j in range(len(state)):
        entry = state[j] - sums[1 + j] / sums[0]
        for m in range(j):
            entry -= factor[j, m] * scratch[m]
        scratch[j] = entry / factor[j, j]
        distance += scratch[j] * scratch[j]
    return sums[0] * distance


@compiled
def predict_many(source, states, actions, predictions):
    """Predict many states and actions; ``source``: ``SourceModel.plain``, ``predictions``: SourcePredictions as a tuple."""
    instances, effect_range, kernel, near = source_arrays(source)
    effect, reward, end, weight = predictions
    for i in range(len(actions)):
        reward[i], end[i], weight[i] = predict_source(instances, effect_range, kernel, near, actions[i], states[i], effect[i])


_predict_many = EntryPoint(predict_many)


class SourceModel:
    """Local linear regression on the instances of a source, one model for each action.

    The effect at a state is fitted, as a linear function of the state, to the ``n_neighbors`` nearest instances of the
    action, with the kernel exp(-d^2 / breadth^2), narrowed where they lie closer so that the last of them weighs 0.05; it
    stays within the range of the effects seen. Rewards and ends are averages with a kernel of ``outcome_breadth``. Far from
    all instances the nearest ones still predict, with a small weight.

    The weight of a prediction is the sum of exp(-d^2 / breadth^2) over these instances, divided by 1 + z^2, where z is how
    far the state is from their mean in units of their spread along that way: so the variance of what a linear fit predicts
    grows. All of it is in unit coordinates of the source; ``outcome_breadth`` is no broader than ``breadth``.
    """

    def __init__(
        self,
        instances: Instances,
        breadth: float = DEFAULT_SOURCE_BREADTH,
        n_neighbors: int = DEFAULT_N_NEIGHBORS,
        outcome_breadth: float = DEFAULT_OUTCOME_BREADTH,
    ):
        n_actions, _, d = instances.state.shape
        self.n_variables, self.instances = d, instances
        scale, outcome_scale = -1.0 / breadth**2, -1.0 / min(breadth, outcome_breadth) ** 2
        self.kernel = Kernel(scale, np.inf, outcome_scale, n_neighbors, counting_scale=scale)
        effect_range = np.zeros((2, n_actions, d))
        for action, size in enumerate(instances.size.tolist()):
            if size:
                effect_range[0, action] = instances.effect[action, :size].min(axis=0)
                effect_range[1, action] = instances.effect[action, :size].max(axis=0)
        near = NearestLists.empty(n_actions, n_neighbors, d)
        #: For compiled code, see :func:`source_arrays`.
        self.plain = tuple(instances), effect_range, tuple(self.kernel), tuple(near)

    def predict(self, states: np.ndarray, actions: np.ndarray) -> SourcePredictions:
        """Predict n states and actions of the source; unit coordinates of it, and int64."""
        n = len(actions)
        found = SourcePredictions(np.empty((n, self.n_variables)), np.empty(n), np.empty(n), np.empty(n))
        _predict_many.call(self.plain, np.ascontiguousarray(states), actions, tuple(found))
        return found
