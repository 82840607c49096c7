"""Weighted local linear regression on the instances nearest to a state: mean, slopes, and how sure they are.

The one fit of the package: grid pairs, exact states and sources use it. With z = (x - at) / breadth, the numbers y of an
instance at x (its effect, its reward, and perhaps whether it ended an episode) are modelled as y = mean + slopes^T z by
weighted least squares with a ridge on the slopes (Atkeson, Moore & Schaal 1997, "Locally weighted learning", Section 4.2). The
kernel is as broad as makes the last of ``n_neighbors`` instances weigh ``min_weight``, the least that counts, and no broader
than ``breadth``.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined
from sb3_combrel.common.constants import RIDGE
from sb3_combrel.common.periodic import difference

# Sums over instances are taken in so many parts at a time, as vector registers do: in the same order on any machine.
GROUP = 4
# A kernel is no narrower than this part of the breadth, for the arithmetic, where all instances lie at the very same state.
NARROWEST = 1e-6


class Kernel(NamedTuple):
    """What decides which instances count, and how much."""

    scale: float  # -1 / breadth ** 2
    per_breadth: float  # squared distance at which an instance weighs the least that counts, in squared breadths
    reach: float  # squared distance beyond which none counts
    n_neighbors: int  # instances that a fit is made to
    outcome_breadth: float  # squared: the broadest kernel of ends (see models.ends)


class LocalFit(NamedTuple):
    """A fit around a state, and work space; with d state variables there are d + 1 numbers: effects, then the reward.

    Where the action decides how episodes end there is one more, whether one does: 1 or 0.
    """

    item: np.ndarray  # int32, (n_neighbors,): instances, nearest first
    distance: np.ndarray  # float64, the same: squared distances
    factor: np.ndarray  # float64, (d + 1, d + 1): Cholesky's factor of the regression's matrix
    # The mean of each number in row 0, its slopes per unit below; in the last column the leverage in row 0, and by how much an
    # instance at the state itself that is larger by 1 moves the slopes.
    solution: np.ndarray  # float64, (d + 1, n_numbers + 1)
    low: np.ndarray  # float64, (n_numbers,): the least of each number among the instances
    high: np.ndarray  # float64, the same: the largest
    # What is fitted, for each instance: 1 and its place, the same weighted, both float64, (d + 1, groups, GROUP).
    z: np.ndarray
    weighted: np.ndarray
    number: np.ndarray  # its numbers, float64, (n_numbers, groups, GROUP)
    # By how much effects of instances differ from what is fitted of them; what of that is noise; float64, (n_neighbors, d).
    residual: np.ndarray
    noise: np.ndarray
    noisy: np.ndarray  # float64, (1,): the weighted mean of the squared lengths of the noise; NaN: that is not written yet

    @classmethod
    def empty(cls, n_neighbors: int, n_variables: int, ends_by_action: bool = False) -> "LocalFit":
        """Make room for a fit to so many instances; ``ends_by_action``: of whether they ended an episode as well."""
        d, n_numbers = n_variables, n_variables + 1 + ends_by_action
        groups = (n_neighbors + GROUP - 1) // GROUP, GROUP
        return cls(
            item=np.zeros(n_neighbors, dtype=np.int32),
            distance=np.empty(n_neighbors),
            factor=np.zeros((d + 1, d + 1)),
            solution=np.zeros((d + 1, n_numbers + 1)),
            low=np.empty(n_numbers),
            high=np.empty(n_numbers),
            z=np.empty((d + 1, *groups)),
            weighted=np.empty((d + 1, *groups)),
            number=np.empty((n_numbers, *groups)),
            residual=np.zeros((n_neighbors, d)),
            noise=np.zeros((n_neighbors, d)),
            noisy=np.full(1, np.nan),
        )


@inlined
def kernel_scale(fit, length, kernel):
    """The scale, -1 / breadth ** 2, of the kernel of a fit to the ``length`` nearest instances."""
    if length < kernel.n_neighbors:
        return kernel.scale
    narrowed = -kernel.per_breadth / max(fit.distance[length - 1], 1e-300)
    return max(min(kernel.scale, narrowed), kernel.scale / (NARROWEST * NARROWEST))


@compiled
def known_weight(fit, length, kernel):
    """The weight of a fit's instances under the broad kernel, which decides what is known."""
    total = 0.0
    for k in range(length):
        total += np.exp(fit.distance[k] * kernel.scale)
    return total


@inlined
def sum_of_products(a, b, p, q, groups):
    """The sum of the products of row ``p`` of one array and row ``q`` of another."""
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for g in range(groups):
        first += a[p, g, 0] * b[q, g, 0]
        second += a[p, g, 1] * b[q, g, 1]
        third += a[p, g, 2] * b[q, g, 2]
        fourth += a[p, g, 3] * b[q, g, 3]
    return (first + second) + (third + fourth)


@inlined
def ends_by_action(fit):
    """Whether the last of a fit's numbers is whether an episode ends."""
    return len(fit.number) > len(fit.z)


@inlined
def write_instances(at, action, length, instances, scale, fit):
    """Write what is fitted, and zeros up to a whole group; how many groups these are."""
    d = len(at)
    per_unit = np.sqrt(-scale)
    z, weighted, number = fit.z, fit.weighted, fit.number
    any_ended = False
    groups = (length + GROUP - 1) // GROUP
    for k in range(GROUP * groups):
        g, lane = k // GROUP, k % GROUP
        if k >= length:
            for p in range(d + 1):
                z[p, g, lane], weighted[p, g, lane] = 0.0, 0.0
            for v in range(len(number)):
                number[v, g, lane] = 0.0
            continue
        i = fit.item[k]
        # Seen from the nearest: far from all instances the ridge would outweigh them.
        weight = np.exp((fit.distance[k] - fit.distance[0]) * scale)
        z[0, g, lane], weighted[0, g, lane] = 1.0, weight
        for j in range(d):
            place = difference(instances.state[action, i, j], at[j], instances.periodic[j]) * per_unit
            z[j + 1, g, lane], weighted[j + 1, g, lane] = place, weight * place
            number[j, g, lane] = instances.effect[action, i, j]
        number[d, g, lane] = instances.reward[action, i]
        if ends_by_action(fit):
            number[d + 1, g, lane] = instances.terminated[action, i]
        any_ended = any_ended or instances.terminated[action, i]
    if any_ended:
        # What an end pays is known by where it is; or else where it leads does not matter.
        if ends_by_action(fit):
            for j in range(d):
                leave_ends_out(j, action, length, instances, fit)
        else:
            leave_ends_out(d, action, length, instances, fit)
    return groups


@inlined
def leave_ends_out(v, action, length, instances, fit):
    """Give the instances that ended an episode the weighted mean of a number of the others; of all, if they all did."""
    total, mean = 0.0, 0.0
    for every in range(2):
        for k in range(length):
            if every == 1 or not instances.terminated[action, fit.item[k]]:
                weight = fit.weighted[0, k // GROUP, k % GROUP]
                total += weight
                mean += weight * fit.number[v, k // GROUP, k % GROUP]
        if total > 0.0:
            break
    for k in range(length):
        if instances.terminated[action, fit.item[k]]:
            fit.number[v, k // GROUP, k % GROUP] = mean / total


@inlined
def write_ranges(length, fit):
    """Write the least and the largest of each number among the instances."""
    for p in range(len(fit.low)):
        low, high = fit.number[p, 0, 0], fit.number[p, 0, 0]
        for k in range(1, length):
            number = fit.number[p, k // GROUP, k % GROUP]
            low = number if number < low else low
            high = number if number > high else high
        fit.low[p], fit.high[p] = low, high


@compiled
def fit_around(at, action, length, instances, kernel, fit):
    """Fit the numbers of ``action`` around ``at`` to the instances in ``fit.item``, of which there is at least one.

    Of an instance that ended an episode the reward does not count, as what an end pays is known by where it is; or else, where
    the action decides how episodes end, the effect does not.
    """
    d, n_numbers = len(at), len(fit.number)
    scale = kernel_scale(fit, length, kernel)
    per_unit = np.sqrt(-scale)
    factor, solution = fit.factor, fit.solution
    groups = write_instances(at, action, length, instances, scale, fit)
    write_ranges(length, fit)
    for p in range(d + 1):
        for q in range(p + 1):
            factor[p, q] = sum_of_products(fit.weighted, fit.z, p, q, groups)
        for v in range(n_numbers):
            solution[p, v] = sum_of_products(fit.weighted, fit.number, p, v, groups)
        solution[p, n_numbers] = 0.0
    for p in range(1, d + 1):
        factor[p, p] += RIDGE
    solution[0, n_numbers] = 1.0
    solve(factor, solution)
    for p in range(1, d + 1):
        for v in range(n_numbers + 1):
            solution[p, v] *= per_unit


@compiled
def largest_residual(length, kernel, fit):
    """The largest squared length of what effects differ by from what is fitted of them."""
    d = fit.residual.shape[1]
    per_unit = np.sqrt(-kernel_scale(fit, length, kernel))
    largest = 0.0
    for k in range(length):
        square = 0.0
        for v in range(d):
            # In parts of a breadth: a division for each slope would take most of the time.
            residual = (fit.number[v, k // GROUP, k % GROUP] - fit.solution[0, v]) * per_unit
            for j in range(1, d + 1):
                residual -= fit.solution[j, v] * fit.z[j, k // GROUP, k % GROUP]
            square += residual * residual
        largest = max(largest, square)
    return largest / (per_unit * per_unit)


@inlined
def write_residuals(length, kernel, fit):
    """Write by how much effects differ from what is fitted of them."""
    d = fit.residual.shape[1]
    per_unit = np.sqrt(-kernel_scale(fit, length, kernel))
    for k in range(length):
        for v in range(d):
            residual = fit.number[v, k // GROUP, k % GROUP] - fit.solution[0, v]
            for j in range(1, d + 1):
                residual -= fit.solution[j, v] * fit.z[j, k // GROUP, k % GROUP] / per_unit
            fit.residual[k, v] = residual


@compiled
def write_noise(length, kernel, fit):
    """Write by how much residuals differ from those of the instance that is nearest to each, in parts of the root of 2.

    Where a line fits badly, as at a wall, residuals are large, and nearly the same beside each other; noise is not (Rice 1984,
    "Bandwidth choice for nonparametric regression"). No noise is larger than the root of 2 times the largest residual.
    """
    d = fit.residual.shape[1]
    write_residuals(length, kernel, fit)
    total, sum_of_squares = 0.0, 0.0
    for k in range(length):
        nearest, least = k, np.inf
        for i in range(length):
            apart = 0.0
            for j in range(1, d + 1):
                along = fit.z[j, i // GROUP, i % GROUP] - fit.z[j, k // GROUP, k % GROUP]
                apart += along * along
            if i != k and apart < least:
                nearest, least = i, apart
        square = 0.0
        for v in range(d):
            fit.noise[k, v] = (fit.residual[k, v] - fit.residual[nearest, v]) * np.sqrt(0.5)
            square += fit.noise[k, v] * fit.noise[k, v]
        weight = fit.weighted[0, k // GROUP, k % GROUP]
        total += weight
        sum_of_squares += weight * square
    fit.noisy[0] = sum_of_squares / total


@inlined
def leverage_of(fit, length, kernel):
    """The fit's leverage: 1 over as how many instances at the very state it counts.

    No more than the nearest instance would have alone, under the broad kernel. Where instances lie in a plane, as in front of
    a wall, the slope across it is not determined: the fit would count for nothing close beside them.
    """
    last = fit.solution.shape[1] - 1
    # The weights of all are in parts of that of the nearest.
    nearest = np.exp(fit.distance[0] * kernel_scale(fit, length, kernel))
    return min(fit.solution[0, last] / nearest, np.exp(-fit.distance[0] * kernel.scale))


@compiled
def join_prior(prior, kernel, length, fit):
    """Let a fit know what a prior says of each effect, as so many instances at its very state.

    With a weight p and a leverage h the mean y becomes that of s, of weight p, and of y, of weight 1 / h; and the slopes
    change with it as a further instance at the state would change them (the formula of Sherman and Morrison).

    :param prior: what it says of each effect, s, and the weights p, float64, shape (2 * n_variables,)
    """
    d, last = len(prior) // 2, len(fit.number)
    leverage = leverage_of(fit, length, kernel)
    for v in range(d):
        p = prior[d + v]
        if p > 0.0:
            pull = p * leverage / (1.0 + p * leverage)
            moved = pull * (fit.solution[0, v] - prior[v]) / fit.solution[0, last]
            for j in range(d + 1):
                fit.solution[j, v] -= moved * fit.solution[j, last]
            fit.low[v] = min(fit.low[v], prior[v])
            fit.high[v] = max(fit.high[v], prior[v])


@compiled
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
    for i in range(n):
        for k in range(i):
            for c in range(columns):
                solution[i, c] -= factor[i, k] * solution[k, c]
        for c in range(columns):
            solution[i, c] /= factor[i, i]
    for step in range(n):
        i = n - 1 - step
        for k in range(i + 1, n):
            for c in range(columns):
                solution[i, c] -= factor[k, i] * solution[k, c]
        for c in range(columns):
            solution[i, c] /= factor[i, i]


@inlined
def number_at(fit, v, away):
    """What a fit predicts of number ``v`` at ``away`` from its state, within the range of its instances."""
    value = fit.solution[0, v]
    for j in range(len(away)):
        value += fit.solution[j + 1, v] * away[j]
    return min(max(value, fit.low[v]), fit.high[v])
