"""The local linear model of a source task: what its instances predict of any state and action of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import nearest_instances
from sb3_combrel.common.regression import Kernel, LocalFit, fit_around, known_weight, number_at

DEFAULT_SOURCE_BREADTH = 0.2
N_NEIGHBORS = 24
MIN_WEIGHT = 0.05  # of an instance that counts, as by default in Fitted R-Max
OUTCOME_BREADTH = 0.05  # rewards and ends jump from one state to the next: they are averaged over nearer instances


class SourcePredictions(NamedTuple):
    """What a source predicts of n state-action pairs of its own, float64."""

    effect: np.ndarray  # shape (n, n_variables): predicted displacement, unit coordinates of the source
    reward: np.ndarray  # shape (n,), raw
    end: np.ndarray  # shape (n,): probability of termination
    weight: np.ndarray  # shape (n,): how well founded the prediction is, see SourceModel


@inlined
def source_arrays(plain):
    """Instances, Kernel, LocalFit and the instances near the last states from ``SourceModel.plain``."""
    return Instances(*plain[0]), Kernel(*plain[1]), LocalFit(*plain[2]), plain[3]


@compiled
def predict_effect(instances, kernel, fit, away, action, state, effect, farthest):
    """Write to ``effect`` what a state and action lead to; instances near it, listed in ``fit``, and the weight, 0 without.

    :param farthest: squared distance beyond which none of the nearest instances is, if that is known
    """
    length = nearest_instances(instances, action, state, min(kernel.reach, farthest), fit.item, fit.distance)
    if length == 0:
        effect[:] = 0.0
        return length, 0.0
    fit_around(state, action, length, instances, kernel, fit)
    for v in range(len(state)):
        effect[v] = number_at(fit, v, away)
    return length, known_weight(fit, length, kernel) / (1.0 + beyond_data(fit))


@compiled
def predict_source(instances, kernel, fit, away, action, state, effect):
    """Predict a state and action: reward, probability of termination, weight, all 0 without instances; writes ``effect``."""
    length, founded = predict_effect(instances, kernel, fit, away, action, state, effect, np.inf)
    outcomes, reward, end = 0.0, 0.0, 0.0
    for k in range(length):
        i = fit.item[k]
        # Seen from the nearest: far from all instances a quotient could be 0 / 0.
        weight = np.exp((fit.distance[0] - fit.distance[k]) / kernel.outcome_breadth)
        outcomes += weight
        reward += weight * instances.reward[action, i]
        if instances.terminated[action, i]:
            end += weight
    return (reward / outcomes, end / outcomes, founded) if length > 0 else (0.0, 0.0, 0.0)


@inlined
def beyond_data(fit):
    """The squared distance of a state from the mean of a fit's instances, in units of their spread along that way.

    With the fit's total weight W and leverage h that is h W - 1: at their mean the leverage is 1 / W.
    """
    return max(0.0, fit.solution[0, len(fit.z)] * fit.factor[0, 0] * fit.factor[0, 0] - 1.0)


@entry_point
def predict_many(source, states, actions, predictions):
    """Predict many states and actions; ``source``: ``SourceModel.plain``, ``predictions``: SourcePredictions as a tuple."""
    instances, kernel, fit, away = source_arrays(source)
    effect, reward, end, weight = predictions
    for i in range(len(actions)):
        reward[i], end[i], weight[i] = predict_source(instances, kernel, fit, away, actions[i], states[i], effect[i])


class SourceModel:
    """Local linear regression on the instances of a source, one model for each action.

    The effect at a state is fitted, as a linear function of the state, to the ``N_NEIGHBORS`` nearest instances of the
    action, with the kernel exp(-d^2 / breadth^2), narrowed where they lie closer so that the last weighs ``MIN_WEIGHT``; it
    stays within the range of theirs. Rewards and ends are averages with a kernel of ``OUTCOME_BREADTH``. Far from
    all instances the nearest ones still predict, with a small weight.

    The weight of a prediction is the sum of exp(-d^2 / breadth^2) over these instances, divided by 1 + z^2, where z is how
    far the state is from their mean in units of their spread along that way: so the variance of what a linear fit predicts
    grows. All of it is in unit coordinates of the source; ``OUTCOME_BREADTH`` is no broader than ``breadth``.
    """

    def __init__(self, instances: Instances, breadth: float):
        d = instances.state.shape[2]
        self.n_variables, self.instances = d, instances
        self.kernel = Kernel(-1.0 / breadth**2, -np.log(MIN_WEIGHT), np.inf, N_NEIGHBORS, min(breadth, OUTCOME_BREADTH) ** 2)
        #: For compiled code, see :func:`source_arrays`.
        self.plain = tuple(instances), tuple(self.kernel), tuple(LocalFit.empty(N_NEIGHBORS, d)), np.zeros(d)

    def predict(self, states: np.ndarray, actions: np.ndarray) -> SourcePredictions:
        """Predict n states and actions of the source; unit coordinates of it, and int64."""
        n = len(actions)
        found = SourcePredictions(np.empty((n, self.n_variables)), np.empty(n), np.empty(n), np.empty(n))
        predict_many.call(self.plain, np.ascontiguousarray(states), actions, tuple(found))
        return found
