"""Compiled loops of the local linear model: the fit of one state-action pair of the grid."""

import numpy as np

from sb3_combrel.common.compiled import inlined, inner
from sb3_combrel.common.instances import BLOCK
from sb3_combrel.common.kernels import any_periodic, measure_blocks, nearest_instances, squared_distance
from sb3_combrel.common.linear_regression import add_products, fitted_effect, products_of, solve_regression
from sb3_combrel.common.periodic import bring_near
from sb3_combrel.planning.grid import unit_coordinates_of

# The kernel of a pair is so broad that the farthest of its instances weighs this, and no broader than ``model_breadth``.
LAST_WEIGHT = 0.05
PER_BREADTH = -np.log(LAST_WEIGHT)
# No narrower than this fraction of ``model_breadth``: all instances may be at the very same state.
NARROWEST = 0.02
# On the slopes, in squares of the kernel's breadth: more flattens slopes across a trajectory once the kernel has narrowed.
RIDGE = 0.001
# What the fit leaves unexplained of the nearest instances, as at a wall, is added to its prediction, as if there were besides
# so much weight of instances that it explains.
EXPLAINED_WEIGHT = 0.5
# A prior counts as so much weight of instances that agree with it; for rewards and ends, of the narrower kernel.
PRIOR_WEIGHT, PRIOR_OUTCOME_WEIGHT = 0.5, 0.1
# A row is written again within an episode when its prediction has moved by this, in parts of the size of the action's effects.
TOLERANCE = 0.1
# The narrower weight of an instance is no less than this: where all are far away their mean is still a quotient.
LEAST_WEIGHT = 1e-200


@inlined
def narrowed(reach, kernel):
    """The scale, -1 / breadth ** 2, of a kernel for instances up to a squared distance of ``reach``."""
    if reach >= kernel.reach:
        return kernel.scale
    return max(min(kernel.scale, -PER_BREADTH / max(reach, 1e-300)), kernel.scale / (NARROWEST * NARROWEST))


@inlined
def count_instance(fits, pair, distance, products, reward, terminated, kernel, sign):
    """Add an instance at a squared distance to a pair's sums (``sign`` -1: take it out); by which parts these have grown."""
    weight = sign * np.exp(distance * fits.scale[pair])
    sums = fits.sums[pair]
    add_products(sums, weight, products)
    near = sign * max(LEAST_WEIGHT, np.exp(distance * kernel.outcome_scale))
    outcome = fits.outcome[pair]
    outcome[0] += near
    outcome[1] += near * reward
    if terminated:
        outcome[2] += near
        fits.n_ended[pair] += np.int32(sign)
    d = (len(outcome) - 3) // 2
    effects = 1 + d + d * (d + 1) // 2
    for k in range(d):
        outcome[3 + k] += near * products[1 + k]
        outcome[3 + d + k] += near * products[effects + k]
    return weight / sums[0], near / outcome[0]


@inlined
def unexplained_effect(fit, outcome, k):
    """The part of effect ``k`` that a linear fit leaves unexplained of the instances nearest to a state."""
    d = (len(outcome) - 3) // 2
    effect = outcome[3 + d + k] - fit[k] * outcome[0]
    for j in range(d):
        effect -= fit[d + j * d + k] * outcome[3 + j]
    return effect / (outcome[0] + EXPLAINED_WEIGHT)


@inner
def recount(instances, fits, pair, action, kernel, left_out, scratch):
    """Compute a pair's sums anew from all instances that count but ``left_out``; the weight that decides what is known."""
    fits.sums[pair, :] = 0.0
    fits.outcome[pair, :] = 0.0
    fits.n_ended[pair] = 0
    fits.scale[pair] = narrowed(fits.reach[pair], kernel)
    reach = fits.reach[pair]
    products = scratch.products[1]
    wraps = any_periodic(instances.periodic)
    count = np.int64(0)
    total = 0.0
    for block in range(measure_blocks(instances, action, scratch.at)):
        if instances.gap[block] > reach * (1 + 1e-12):
            continue
        for i in range(block * BLOCK, min(instances.size[action], (block + 1) * BLOCK)):
            distance = squared_distance(scratch.at, instances.state[action, i], instances.periodic, wraps)
            if distance > reach or i == left_out:
                continue
            bring_near(instances.state[action, i], scratch.at, instances.periodic, scratch.counted)
            products_of(scratch.counted, fits.target[action, i], products)
            reward, terminated = instances.reward[action, i], instances.terminated[action, i]
            count_instance(fits, pair, distance, products, reward, terminated, kernel, 1.0)
            total += np.exp(distance * kernel.counting_scale)
            count += 1
    fits.n_counted[pair] = count
    return total


@inner
def narrow(instances, fits, pair, action, kernel, left_out, scratch):
    """Let only the ``n_neighbors`` nearest instances of a pair count, and those as near as the last of them."""
    nearest, n = scratch.nearest, kernel.n_neighbors
    length = nearest_instances(instances, action, scratch.at, fits.reach[pair], scratch.item, nearest, 0, left_out)
    if length == n:
        fits.reach[pair] = nearest[length - 1]
    recount(instances, fits, pair, action, kernel, left_out, scratch)
    # Many instances at one state: to look for narrower kernels again and again would be in vain.
    n_counted = fits.n_counted[pair]
    fits.limit[pair] = max(n + n // 2, 2 * n_counted if n_counted > n + n // 4 else 0)


@inlined
def prediction_moved(fits, pair, action, at, tolerance):
    """Put what the fit predicts into ``fits.row`` if that differs from before by more than ``tolerance``; whether it does."""
    d = len(at)
    row, outcome = fits.row[pair], fits.outcome[pair]
    reward, end = mean_outcome(outcome, fits.prior[pair], fits.claimed[pair] and not fits.known[pair])
    moved = abs(reward - row[d]) > tolerance * abs(reward) or abs(end - row[d + 1]) > tolerance
    for k in range(d):
        apart = abs(mean_effect(fits, pair, action, at, k) - row[k])
        moved = moved or apart > tolerance * fits.effect_scale[action, k]
    if moved:
        for k in range(d):
            row[k] = mean_effect(fits, pair, action, at, k)
        row[d] = reward
        row[d + 1] = end
    return moved


@inlined
def mean_outcome(outcome, prior, with_prior):
    """Reward and probability of termination from the narrower sums, and from the prior where these do not suffice."""
    d = len(prior) - 2
    weight = PRIOR_OUTCOME_WEIGHT if with_prior else 0.0
    total = outcome[0] + weight
    return (outcome[1] + weight * prior[d]) / total, (outcome[2] + weight * prior[d + 1]) / total


@inlined
def mean_effect(fits, pair, action, at, k):
    """Effect ``k`` that a pair's fit predicts at its point, within the range of the effects seen."""
    fit = fits.fit[pair]
    effect = fitted_effect(fit, at, k) + unexplained_effect(fit, fits.outcome[pair], k)
    if fits.claimed[pair]:
        effect *= fits.sums[pair, 0] / (fits.sums[pair, 0] + PRIOR_WEIGHT)
    effect += fits.prior[pair, k]
    return min(max(effect, fits.effect_range[0, action, k]), fits.effect_range[1, action, k])


@inner
def refit(fits, pair, action, grid, scratch, tolerance):
    """Solve the regression of a pair; whether its row is to be updated (see :func:`prediction_moved`)."""
    unit_coordinates_of(pair - action * grid.shape[0] * grid.strides[0], grid, scratch.at)
    solve_regression(fits.sums[pair], -RIDGE / fits.scale[pair], scratch.factor, fits.fit[pair])
    fits.unexplained[pair] = 0.0
    fits.refitted[pair] = True
    return prediction_moved(fits, pair, action, scratch.at, tolerance)


@inner
def narrow_and_refit(instances, fits, pair, action, kernel, grid, scratch):
    """:func:`refit` with a narrower kernel if too many instances count."""
    if fits.n_counted[pair] > fits.limit[pair]:
        unit_coordinates_of(pair - action * grid.shape[0] * grid.strides[0], grid, scratch.at)
        narrow(instances, fits, pair, action, kernel, np.int64(-1), scratch)
    return refit(fits, pair, action, grid, scratch, TOLERANCE)
