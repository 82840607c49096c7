"""Weighted local linear regression from sums over instances, so that an instance can be added without the others.

The effect e of an instance at x is modelled as e = a + B^T x by weighted least squares, with a ridge on the slopes B
(Atkeson, Moore & Schaal 1997, "Locally weighted learning", Section 4.2). All that this needs to know of an instance are
products of its numbers, and of the instances the weighted sums of these: with d state variables, in this order

    1;  x (d);  x x^T, lower triangle, row by row (d (d + 1) / 2);  e (d);  x e^T, row by row (d^2)
"""

import numpy as np

from sb3_combrel.common.compiled import inlined, inner


def n_products(n_variables: int) -> int:
    """How many products there are for so many state variables."""
    d = n_variables
    return 1 + d + d * (d + 1) // 2 + d + d * d


@inlined
def products_of(state, effect, products):
    """Write the products of an instance to ``products``, shape (n_products,)."""
    d = len(state)
    products[0] = 1.0
    at = 1 + d
    crossed = at + d * (d + 1) // 2 + d
    for j in range(d):
        products[1 + j] = state[j]
        for k in range(j + 1):
            products[at + k] = state[j] * state[k]
        at += j + 1
        for k in range(d):
            products[crossed + k] = state[j] * effect[k]
        crossed += d
    for k in range(d):
        products[at + k] = effect[k]


@inlined
def add_products(sums, weight, products):
    """Add an instance to the sums; or take one out, with a negative weight."""
    for k in range(len(products)):
        sums[k] += weight * products[k]


@inner
def solve_regression(sums, ridge, factor, fit):
    """Fit intercept and slopes to the sums.

    Means are subtracted first, so that the ridge does not shrink the intercept. With S = sum w (x - mean) (x - mean)^T
    + ridge I and C = sum w (x - mean) (e - mean)^T, B = S^-1 C by Cholesky's decomposition.

    :param ridge: above 0, as few instances do not determine all slopes
    :param factor: scratch, shape (d, d)
    :param fit: receives them, shape (d + d^2,): a, then B: ``fit[d + j * d + k]`` is how much effect k grows along variable j
    """
    d = factor.shape[0]
    total = sums[0]
    at = 1 + d
    means = at + d * (d + 1) // 2
    crossed = means + d
    for j in range(d):
        for k in range(j + 1):
            entry = sums[at + k] - sums[1 + j] * sums[1 + k] / total
            if j == k:
                # Rounding can leave less than nothing.
                entry = max(entry, 0.0) + ridge
            for m in range(k):
                entry -= factor[j, m] * factor[k, m]
            factor[j, k] = np.sqrt(max(entry, 1e-3 * ridge)) if j == k else entry / factor[k, k]
        at += j + 1
    for k in range(d):
        mean = sums[means + k] / total
        for j in range(d):
            entry = sums[crossed + j * d + k] - sums[1 + j] * mean
            for m in range(j):
                entry -= factor[j, m] * fit[d + m * d + k]
            fit[d + j * d + k] = entry / factor[j, j]
        intercept = mean
        for step in range(d):
            j = d - 1 - step
            entry = fit[d + j * d + k]
            for m in range(j + 1, d):
                entry -= factor[m, j] * fit[d + m * d + k]
            fit[d + j * d + k] = entry / factor[j, j]
            intercept -= fit[d + j * d + k] * sums[1 + j] / total
        fit[k] = intercept


@inlined
def fitted_effect(fit, state, k):
    """Effect ``k`` that a fit predicts at a state."""
    d = len(state)
    effect = fit[k]
    for j in range(d):
        effect += fit[d + j * d + k] * state[j]
    return effect
