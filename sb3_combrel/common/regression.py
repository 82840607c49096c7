"""Weighted local linear regression on the instances nearest to a state: mean, slopes, and how sure they are.

The one fit of the package: grid pairs, exact states and sources use it. With z = (x - at) / breadth, the numbers y of an
instance at x (its effect, and its reward) are modelled as y = mean + slopes^T z by weighted least squares with a ridge on the
slopes (Atkeson, Moore & Schaal 1997, "Locally weighted learning", Section 4.2). The kernel is as broad as makes the last of
``n_neighbors`` instances weigh 0.05, and no broader than ``breadth``.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import inlined, inner
from sb3_combrel.common.constants import LAST_WEIGHT, RIDGE
from sb3_combrel.common.periodic import difference

PER_BREADTH = -np.log(LAST_WEIGHT)
# A kernel is no narrower than this part of the breadth, for the arithmetic, where all instances lie at the very same state.
NARROWEST = 1e-6


class Kernel(NamedTuple):
    """What decides which instances count, and how much."""

    scale: float  # -1 / breadth ** 2
    reach: float  # squared distance beyond which none counts
    n_neighbors: int  # instances that a fit is made to
    outcome_breadth: float  # squared: the broadest kernel of ends (see models.ends)


class LocalFit(NamedTuple):
    """A fit around a state, and work space; with d state variables there are d + 1 numbers: effects, then the reward."""

    item: np.ndarray  # int32, (n_neighbors,): instances, nearest first
    distance: np.ndarray  # float64, the same: squared distances
    factor: np.ndarray  # float64, (d + 1, d + 1): Cholesky's factor of the regression's matrix
    # The mean of each number in row 0, its slopes per unit below; in the last column the leverage in row 0, and by how much an
    # instance at the state itself that is larger by 1 moves the slopes.
    solution: np.ndarray  # float64, (d + 1, d + 2)
    low: np.ndarray  # float64, (d + 1,): the least of each number among the instances
    high: np.ndarray  # float64, the same: the largest
    z: np.ndarray  # float64, (d + 1,): 1, then an instance's place

    @classmethod
    def empty(cls, n_neighbors: int, n_variables: int) -> "LocalFit":
        """Make room for a fit to so many instances."""
        d = n_variables
        return cls(
            item=np.zeros(n_neighbors, dtype=np.int32),
            distance=np.empty(n_neighbors),
            factor=np.zeros((d + 1, d + 1)),
            solution=np.zeros((d + 1, d + 2)),
            low=np.empty(d + 1),
            high=np.empty(d + 1),
            z=np.ones(d + 1),
        )


@inlined
def kernel_scale(fit, length, kernel):
    """The scale, -1 / breadth ** 2, of the kernel of a fit to the ``length`` nearest instances."""
    if length < kernel.n_neighbors:
        return kernel.scale
    narrowed = -PER_BREADTH / max(fit.distance[length - 1], 1e-300)
    return max(min(kernel.scale, narrowed), kernel.scale / (NARROWEST * NARROWEST))


@inner
def known_weight(fit, length, kernel):
    """The weight of a fit's instances under the broad kernel, which decides what is known."""
    total = 0.0
    for k in range(length):
        total += np.exp(fit.distance[k] * kernel.scale)
    return total


@inner
def fit_around(at, action, length, instances, target, kernel, fit):
    """Fit the numbers of ``action`` around ``at`` to the instances in ``fit.item``, of which there is at least one.

    Of an instance that ended an episode the reward does not count: what an end pays is known by where it is.

    :param target: float64, (n_actions, capacity, n_variables): the effects to be fitted, or what a prior leaves of them
    """
    d = len(at)
    scale = kernel_scale(fit, length, kernel)
    per_unit = np.sqrt(-scale)
    factor, solution, z = fit.factor, fit.solution, fit.z
    factor[:] = 0.0
    solution[:] = 0.0
    fit.low[:] = np.inf
    fit.high[:] = -np.inf
    any_ended = False
    for k in range(length):
        any_ended = any_ended or instances.terminated[action, fit.item[k]]
    reward_going_on = mean_reward(action, length, instances, scale, fit) if any_ended else 0.0
    for k in range(length):
        i = fit.item[k]
        # Seen from the nearest: far from all instances the ridge would outweigh them.
        weight = np.exp((fit.distance[k] - fit.distance[0]) * scale)
        for j in range(d):
            z[j + 1] = difference(instances.state[action, i, j], at[j], instances.periodic[j]) * per_unit
        reward = reward_going_on if instances.terminated[action, i] else instances.reward[action, i]
        for p in range(d + 1):
            weighted = weight * z[p]
            for q in range(p + 1):
                factor[p, q] += weighted * z[q]
            for v in range(d):
                solution[p, v] += weighted * target[action, i, v]
            solution[p, d] += weighted * reward
        for v in range(d):
            fit.low[v] = min(fit.low[v], target[action, i, v])
            fit.high[v] = max(fit.high[v], target[action, i, v])
        fit.low[d] = min(fit.low[d], reward)
        fit.high[d] = max(fit.high[d], reward)
    for p in range(1, d + 1):
        factor[p, p] += RIDGE
    solution[0, d + 1] = 1.0
    solve(factor, solution)
    for p in range(1, d + 1):
        for v in range(d + 2):
            solution[p, v] *= per_unit


@inlined
def weight_of_nearest(fit, length, kernel):
    """The weight of a fit's nearest instance, in parts of which those of all are."""
    return np.exp(fit.distance[0] * kernel_scale(fit, length, kernel))


@inlined
def join_prior(weights, kernel, length, fit):
    """Let a fit to residuals know that a prior says of each effect that they are 0, as so many instances at its very state.

    A further instance of weight p at the state itself, whose number is 0: by the Sherman-Morrison formula all coefficients
    lose p y / (1 + p h) times what such an instance would move them by, where y is the mean so far and h its leverage.

    :param weights: float64, shape (n_variables,)
    """
    d = len(weights)
    nearest = weight_of_nearest(fit, length, kernel)
    for v in range(d):
        p = weights[v] / nearest
        if p > 0.0:
            moved = p * fit.solution[0, v] / (1.0 + p * fit.solution[0, d + 1])
            for j in range(d + 1):
                fit.solution[j, v] -= moved * fit.solution[j, d + 1]
            fit.low[v] = min(fit.low[v], 0.0)
            fit.high[v] = max(fit.high[v], 0.0)


@inlined
def mean_reward(action, length, instances, scale, fit):
    """The weighted mean reward of those of a fit's instances that did not end an episode; of all, if they all did."""
    total, reward = 0.0, 0.0
    for every in range(2):
        for k in range(length):
            i = fit.item[k]
            if every == 1 or not instances.terminated[action, i]:
                weight = np.exp((fit.distance[k] - fit.distance[0]) * scale)
                total += weight
                reward += weight * instances.reward[action, i]
        if total > 0.0:
            break
    return reward / total


@inner
def solve(factor, solution):
    """Replace the lower triangle of a matrix by Cholesky's factor, and right-hand sides by what solves them."""
    n, columns = solution.shape
    for j in range(n):
        for k in range(j):
            factor[j, j] -= factor[j, k] * factor[j, k]
        factor[j, j] = np.sqrt(max(factor[j, j], 1e-3 * RIDGE))
        for i in range(j + 1, n):
            for k in range(j):
                factor[i, j] -= factor[i, k] * factor[j, k]
            factor[i, j] /= factor[j, j]
    for c in range(columns):
        for i in range(n):
            for k in range(i):
                solution[i, c] -= factor[i, k] * solution[k, c]
            solution[i, c] /= factor[i, i]
        for step in range(n):
            i = n - 1 - step
            for k in range(i + 1, n):
                solution[i, c] -= factor[k, i] * solution[k, c]
            solution[i, c] /= factor[i, i]


@inlined
def number_at(fit, v, away):
    """What a fit predicts of number ``v`` at ``away`` from its state, within the range of its instances."""
    value = fit.solution[0, v]
    for j in range(len(away)):
        value += fit.solution[j + 1, v] * away[j]
    return min(max(value, fit.low[v]), fit.high[v])
