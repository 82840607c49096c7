"""Compiled loops of the local linear model: the fit of each state-action pair of the grid, instance by instance."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, inner, part
from sb3_combrel.common.instances import BLOCK, Instances, put_instance
from sb3_combrel.common.kernels import any_periodic, measure_gaps, squared_distance
from sb3_combrel.common.linear_regression import add_products, fitted_effect, products_of, solve_regression
from sb3_combrel.common.periodic import bring_near, difference
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.kernel_refill import unit_coordinates_of
from sb3_combrel.planning.grid import GridArrays
from sb3_combrel.planning.mdp import RowScratch, add_successor, as_mdp, coordinates_of, finish_row, set_modelled

# The kernel of a pair is so broad that the farthest of its instances weighs this, and no broader than ``model_breadth``.
LAST_WEIGHT = 0.05
PER_BREADTH = -np.log(LAST_WEIGHT)
# No narrower than this fraction of ``model_breadth``: all instances may be at the very same state.
NARROWEST = 0.02
RIDGE = 0.01
# What the linear fit leaves unexplained of the instances nearest to a state, as at a wall, is added to its prediction, as if
# there were so much weight of instances besides that it explains.
EXPLAINED_WEIGHT = 0.5
# A prior's prediction counts as so much weight of instances that agree with it, and for rewards and ends as so much weight of
# the narrower kernel.
PRIOR_WEIGHT = 0.5
PRIOR_OUTCOME_WEIGHT = 0.1
# Within an episode a pair is fitted again once what new instances leave unexplained may move its prediction by the first,
# and its row is written again when the prediction has moved by the second; in parts of the size of the action's effects.
MAX_UNEXPLAINED = 0.2
TOLERANCE = 0.1
# The narrower weight of an instance is no less than this: where all are far away their mean is still a quotient.
LEAST_WEIGHT = 1e-200
# Narrower weights differ by many orders of magnitude, and subtracting a large one leaves nothing but rounding of small ones:
# where less than this is left, and more than that was subtracted, the sums are computed anew.
MUCH_ROUNDED = 1e-6
# A variable that hardly ever changes is measured by this part of a cell.
LEAST_SCALE = 0.02


class LinearFits(NamedTuple):
    """The local linear fit of each pair of the grid (pair ``action * n_points + point``).

    :param sums: float64, shape (n_pairs, n_products): see ``common.linear_regression``
    :param outcome: float64, shape (n_pairs, 3 + 2 * n_variables): sums of narrower weights, and of these times reward,
        termination, state and effect
    :param fit: float64, shape (n_pairs, n_variables + n_variables ** 2): intercept and slopes
    :param row: float64, shape (n_pairs, n_variables + 2): effect, reward and probability of termination in the pair's row
    :param unexplained: float64, shape (n_pairs,): by how much instances that came after the fit may change its prediction;
        inf without a fit
    :param reach: float64, shape (n_pairs,): squared distance up to which instances count
    :param scale: float64, shape (n_pairs,): -1 / breadth ** 2 of the pair's kernel
    :param n_counted: int32, shape (n_pairs,): instances that count
    :param limit: int32, shape (n_pairs,): more than this, and the kernel narrows
    :param total: float64, shape (n_pairs,): sum of the weights (of breadth ``model_breadth``) of all that counted
    :param last_total: float64, shape (n_pairs,): what ``total`` was when the pair's row was updated
    :param known: bool, shape (n_pairs,)
    :param claimed: bool, shape (n_pairs,): the prior suffices for a model
    :param target: float64, shape (n_actions, capacity, n_variables): effect of each instance less the prior's
    :param prior: float64, shape (n_pairs, n_variables + 2): effect, reward and probability of termination that the prior
        predicts; 0 without one
    :param effect_range: float64, shape (3, n_actions, n_variables): least and largest effect of the instances and of the
        prior on the grid; and the sum of the sizes of those of the instances
    :param effect_scale: float64, shape (n_actions, n_variables): what a difference of effects is measured by
    """

    sums: np.ndarray
    outcome: np.ndarray
    fit: np.ndarray
    row: np.ndarray
    unexplained: np.ndarray
    reach: np.ndarray
    scale: np.ndarray
    n_counted: np.ndarray
    limit: np.ndarray
    total: np.ndarray
    last_total: np.ndarray
    known: np.ndarray
    claimed: np.ndarray
    target: np.ndarray
    prior: np.ndarray
    effect_range: np.ndarray
    effect_scale: np.ndarray


class FitScratch(NamedTuple):
    """Work space for fits.

    :param at: float64, shape (n_variables,): unit coordinates of a pair's point
    :param entering: float64, same shape: where an instance is that comes or goes; ``state``: one that is counted anew
    :param products: float64, shape (2, n_products): of an instance that comes or goes, and of one that is counted anew
    :param factor: float64, shape (n_variables, n_variables)
    :param nearest: float64, shape (n_neighbors,): squared distances
    :param along: float64, shape (n_variables, largest axis of the grid): squared distances along one variable
    :param span: int64, shape (3, n_variables): first grid coordinate within reach, one past the last, the present one
    :param point: int64, shape (n_points,): points within reach; ``distance``: float64, same shape: squared distances
    """

    at: np.ndarray
    entering: np.ndarray
    state: np.ndarray
    products: np.ndarray
    factor: np.ndarray
    nearest: np.ndarray
    along: np.ndarray
    span: np.ndarray
    point: np.ndarray
    distance: np.ndarray


class Kernel(NamedTuple):
    """What decides the weights of instances.

    :param scale: -1 / model_breadth ** 2
    :param reach: squared distance at which an instance weighs ``min_weight``
    :param outcome_scale: -1 / outcome_breadth ** 2, for rewards and ends
    :param n_neighbors: instances that a fit is made to
    """

    scale: float
    reach: float
    outcome_scale: float
    n_neighbors: int


@inlined
def narrowed(reach, kernel):
    """The scale, -1 / breadth ** 2, of a kernel for instances up to a squared distance of ``reach``."""
    if reach >= kernel.reach:
        return kernel.scale
    return max(min(kernel.scale, -PER_BREADTH / max(reach, 1e-300)), kernel.scale / (NARROWEST * NARROWEST))


@part
def points_within(state, reach, widest, grid, scratch):
    """Grid points to which ``state`` is at most as near as ``reach`` says, and their squared distances.

    :param reach: float64, shape (n_points,): squared distances; none is above ``widest``
    :return: how many; they are in ``scratch.point`` and ``scratch.distance``
    """
    first, last, at = scratch.span[0], scratch.span[1], scratch.span[2]
    d = len(state)
    radius = np.sqrt(widest) * (1 + 1e-12)
    for k in range(d):
        if grid.periodic[k]:
            first[k] = 0
            last[k] = grid.shape[k]
        else:
            first[k] = max(0, int(np.ceil((state[k] - radius) * grid.cells[k] + grid.margin[k])))
            beyond = int(np.floor((state[k] + radius) * grid.cells[k] + grid.margin[k])) + 1
            last[k] = min(grid.shape[k], beyond)
        if first[k] >= last[k]:
            return 0
        for j in range(first[k], last[k]):
            apart = difference((j - grid.margin[k]) / grid.cells[k], state[k], grid.periodic[k])
            scratch.along[k, j] = apart * apart
        at[k] = first[k]
    found = 0
    inner = d - 1
    while True:
        outer = 0.0
        base = 0
        for k in range(inner):
            outer += scratch.along[k, at[k]]
            base += at[k] * grid.strides[k]
        if outer <= widest:
            for j in range(first[inner], last[inner]):
                distance = outer + scratch.along[inner, j]
                if distance <= reach[base + j]:
                    scratch.point[found] = base + j
                    scratch.distance[found] = distance
                    found += 1
        k = inner - 1
        while k >= 0:
            at[k] += 1
            if at[k] < last[k]:
                break
            at[k] = first[k]
            k -= 1
        if k < 0:
            return found


@inlined
def count_instance(fits, pair, distance, products, reward, terminated, kernel, sign):
    """Add an instance to a pair's sums, or take it out of them (``sign`` -1).

    :param distance: from the pair's point, squared
    :param products: of the instance
    :return: by how much the two sums of weights have grown, in parts of them
    """
    weight = sign * np.exp(distance * fits.scale[pair])
    sums = fits.sums[pair]
    add_products(sums, weight, products)
    near = sign * max(LEAST_WEIGHT, np.exp(distance * kernel.outcome_scale))
    outcome = fits.outcome[pair]
    outcome[0] += near
    outcome[1] += near * reward
    if terminated:
        outcome[2] += near
    d = (len(outcome) - 3) // 2
    effects = 1 + d + d * (d + 1) // 2
    for k in range(d):
        outcome[3 + k] += near * products[1 + k]
        outcome[3 + d + k] += near * products[effects + k]
    return weight / sums[0], near / outcome[0]


@inlined
def unexplained_effect(fit, outcome, k):
    """The part of effect ``k`` that a linear fit leaves unexplained of the instances nearest to a state.

    :param outcome: as in :class:`LinearFits`
    """
    d = (len(outcome) - 3) // 2
    effect = outcome[3 + d + k] - fit[k] * outcome[0]
    for j in range(d):
        effect -= fit[d + j * d + k] * outcome[3 + j]
    return effect / (outcome[0] + EXPLAINED_WEIGHT)


@inlined
def contradiction(fits, pair, instances, action, slot, state, shares):
    """By how much an instance may change what its pair predicts.

    :param state: where it is, near the pair's point (see ``bring_near``)
    :param shares: the fraction of the pair's weight that it has, and of the pair's narrower weight
    """
    d = len(state)
    most = 0.0
    for k in range(d):
        apart = abs(fits.target[action, slot, k] - fitted_effect(fits.fit[pair], state, k))
        most = max(most, apart / fits.effect_scale[action, k])
    reward, end = fits.row[pair, d], fits.row[pair, d + 1]
    seen = instances.reward[action, slot]
    of_reward = abs(seen - reward) / max(1e-12, abs(seen) + abs(reward))
    of_end = abs((1.0 if instances.terminated[action, slot] else 0.0) - end)
    # Above 0 in any case: the fit is no longer that of all instances.
    return max(1e-12, shares[0] * most + shares[1] * max(of_reward, of_end))


@inner
def recount(instances, fits, pair, action, kernel, left_out, scratch):
    """Compute a pair's sums anew from the instances that count, in their order.

    :param left_out: number of an instance that does not count; -1 for none
    :param scratch: ``at`` is where the pair's point is
    :return: the sum of their weights (of breadth ``model_breadth``)
    """
    fits.sums[pair, :] = 0.0
    fits.outcome[pair, :] = 0.0
    fits.scale[pair] = narrowed(fits.reach[pair], kernel)
    reach = fits.reach[pair]
    n_blocks = measure_blocks(instances, action, scratch.at)
    products = scratch.products[1]
    wraps = any_periodic(instances.periodic)
    count = np.int64(0)
    total = 0.0
    for block in range(n_blocks):
        if instances.gap[block] > reach * (1 + 1e-12):
            continue
        for i in range(block * BLOCK, min(instances.size[action], (block + 1) * BLOCK)):
            distance = squared_distance(scratch.at, instances.state[action, i], instances.periodic, wraps)
            if distance > reach or i == left_out:
                continue
            bring_near(instances.state[action, i], scratch.at, instances.periodic, scratch.state)
            products_of(scratch.state, fits.target[action, i], products)
            reward, terminated = instances.reward[action, i], instances.terminated[action, i]
            count_instance(fits, pair, distance, products, reward, terminated, kernel, 1.0)
            total += np.exp(distance * kernel.scale)
            count += 1
    fits.n_counted[pair] = count
    return total


@inlined
def measure_blocks(instances, action, at):
    """Measure how far the blocks of an action's instances are; how many blocks there are."""
    n_blocks = (instances.size[action] + BLOCK - 1) // BLOCK
    measure_gaps(at, instances.block_low[action], instances.block_high[action], instances.periodic, n_blocks, instances.gap)
    return n_blocks


@inner
def narrow(instances, fits, pair, action, kernel, left_out, scratch):
    """Let only the ``n_neighbors`` nearest instances of a pair count, and those as near as the last of them.

    :param left_out: as in :func:`recount`
    """
    reach = fits.reach[pair]
    n_blocks = measure_blocks(instances, action, scratch.at)
    nearest = scratch.nearest
    wraps = any_periodic(instances.periodic)
    length = 0
    for block in range(n_blocks):
        if instances.gap[block] > reach * (1 + 1e-12):
            continue
        for i in range(block * BLOCK, min(instances.size[action], (block + 1) * BLOCK)):
            distance = squared_distance(scratch.at, instances.state[action, i], instances.periodic, wraps)
            if distance > reach or i == left_out:
                continue
            k = length if length < kernel.n_neighbors else length - 1
            if length == kernel.n_neighbors:
                if distance >= nearest[k]:
                    continue
            else:
                length += 1
            while k > 0 and nearest[k - 1] > distance:
                nearest[k] = nearest[k - 1]
                k -= 1
            nearest[k] = distance
            if length == kernel.n_neighbors:
                reach = nearest[length - 1]
    fits.reach[pair] = reach
    recount(instances, fits, pair, action, kernel, left_out, scratch)
    # Many instances at one state: to look for narrower kernels again and again would be in vain.
    n, n_counted = kernel.n_neighbors, fits.n_counted[pair]
    fits.limit[pair] = max(n + n // 2, 2 * n_counted if n_counted > n + n // 4 else 0)


@inlined
def prediction_moved(fits, pair, action, at, tolerance):
    """Put what the fit predicts into ``fits.row`` if that differs from before by more than ``tolerance``; whether it does."""
    d = len(at)
    row, outcome = fits.row[pair], fits.outcome[pair]
    reward, end = mean_outcome(outcome, fits.prior[pair], fits.claimed[pair])
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
def mean_outcome(outcome, prior, claimed):
    """Reward and probability of termination from the narrower sums, and from the prior if it claims to know them."""
    d = len(prior) - 2
    weight = PRIOR_OUTCOME_WEIGHT if claimed else 0.0
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
    return prediction_moved(fits, pair, action, scratch.at, tolerance)


@inner
def narrow_and_refit(instances, fits, pair, action, kernel, grid, scratch):
    """:func:`refit` with a narrower kernel if too many instances count."""
    if fits.n_counted[pair] > fits.limit[pair]:
        unit_coordinates_of(pair - action * grid.shape[0] * grid.strides[0], grid, scratch.at)
        narrow(instances, fits, pair, action, kernel, np.int64(-1), scratch)
    return refit(fits, pair, action, grid, scratch, TOLERANCE)


@part
def enter(instances, fits, grid, kernel, thresholds, transition, prior, scratch):
    """Write an instance to its slot, and count it for all pairs that it reaches.

    :param prior: float64, shape (n_variables,): effect that the prior predicts of it
    :param thresholds: (weight that makes a pair known, min_change: change of the weight of another pair from which on its
        row is to be updated, 0: never)
    :param transition: (action, slot, state, next_state, reward, terminated)
    :return: of how many pairs the rows are to be updated; their points are moved to the front of ``scratch.point``
    """
    threshold, min_change = thresholds
    action, slot, _, _, reward, terminated = transition
    n_points = grid.shape[0] * grid.strides[0]
    first_pair = action * n_points
    put_instance(instances, transition)
    state = scratch.entering
    wraps = any_periodic(grid.periodic)
    for k in range(len(state)):
        state[k] = instances.state[action, slot, k]
    for k in range(len(state)):
        effect = instances.effect[action, slot, k]
        fits.target[action, slot, k] = effect - prior[k]
        fits.effect_range[0, action, k] = min(fits.effect_range[0, action, k], effect)
        fits.effect_range[1, action, k] = max(fits.effect_range[1, action, k], effect)
        fits.effect_range[2, action, k] += abs(effect)
        mean_size = fits.effect_range[2, action, k] / instances.size[action]
        fits.effect_scale[action, k] = max(2.0 * mean_size, LEAST_SCALE / grid.cells[k])
    products = scratch.products[0]
    products_of(state, fits.target[action, slot], products)
    n_found = points_within(state, fits.reach[first_pair : first_pair + n_points], kernel.reach, grid, scratch)
    changed = 0
    for f in range(n_found):
        point = scratch.point[f]
        pair = first_pair + point
        distance = scratch.distance[f]
        if wraps:
            unit_coordinates_of(point, grid, scratch.at)
            bring_near(instances.state[action, slot], scratch.at, grid.periodic, state)
            products_of(state, fits.target[action, slot], products)
        shares = count_instance(fits, pair, distance, products, reward, terminated, kernel, 1.0)
        fits.n_counted[pair] += 1
        fits.total[pair] += np.exp(distance * kernel.scale)
        if not fits.known[pair] and fits.total[pair] >= threshold:
            fits.known[pair] = True
            fits.unexplained[pair] = np.inf
        if fits.known[pair] or fits.claimed[pair]:
            fits.unexplained[pair] += contradiction(fits, pair, instances, action, slot, state, shares)
            if fits.unexplained[pair] <= MAX_UNEXPLAINED and fits.n_counted[pair] <= fits.limit[pair]:
                continue
            first = fits.unexplained[pair] == np.inf
            if not narrow_and_refit(instances, fits, pair, action, kernel, grid, scratch) and not first:
                continue
        else:
            fits.unexplained[pair] = np.inf
            if min_change == 0.0 or abs(fits.total[pair] - fits.last_total[pair]) < min_change:
                continue
        scratch.point[changed] = point
        changed += 1
    return changed


@compiled
def enter_plain(instances, fits, grid, kernel, thresholds, transition, prior, scratch):
    """:func:`enter` for callers from Python, with plain tuples."""
    instances, fits, grid = Instances(*instances), LinearFits(*fits), GridArrays(*grid)
    return enter(instances, fits, grid, Kernel(*kernel), thresholds, transition, prior, FitScratch(*scratch))


@part
def count_without(instances, fits, pair, action, slot, kernel, scratch):
    """Bring a pair that has lost an instance in order; whether its row is to be updated.

    A narrow kernel with less than half of ``n_neighbors`` left is as broad again as these allow.

    :param slot: the instance that is gone; ``scratch.at`` is where the pair's point is
    """
    if fits.n_counted[pair] > 0 and (2 * fits.n_counted[pair] >= kernel.n_neighbors or fits.reach[pair] >= kernel.reach):
        return False
    fits.reach[pair] = kernel.reach
    narrow(instances, fits, pair, action, kernel, slot, scratch)
    if fits.n_counted[pair] == 0:
        fits.sums[pair, :] = 0.0
        fits.outcome[pair, :] = 0.0
        fits.total[pair] = 0.0
        fits.known[pair] = False
    fits.unexplained[pair] = np.inf
    return True


@compiled
def leave(instances, fits, grid, kernel, action, slot, scratch):
    """Take an instance out of the sums of the pairs for which it counts; another is about to be entered in its place.

    :return: of how many pairs the rows are to be updated at once, as they have no instances left, or others than before;
        their points are moved to the front of ``scratch.point``
    """
    n_points = grid.shape[0] * grid.strides[0]
    first_pair = action * n_points
    state = scratch.entering
    reward, terminated = instances.reward[action, slot], instances.terminated[action, slot]
    for k in range(len(state)):
        fits.effect_range[2, action, k] -= abs(instances.effect[action, slot, k])
    products = scratch.products[0]
    n_found = points_within(
        instances.state[action, slot], fits.reach[first_pair : first_pair + n_points], kernel.reach, grid, scratch
    )
    changed = 0
    for f in range(n_found):
        pair = first_pair + scratch.point[f]
        unit_coordinates_of(scratch.point[f], grid, scratch.at)
        bring_near(instances.state[action, slot], scratch.at, grid.periodic, state)
        products_of(state, fits.target[action, slot], products)
        shares = count_instance(fits, pair, scratch.distance[f], products, reward, terminated, kernel, -1.0)
        fits.n_counted[pair] -= 1
        if count_without(instances, fits, pair, action, slot, kernel, scratch):
            scratch.point[changed] = scratch.point[f]
            changed += 1
            continue
        if fits.outcome[pair, 0] < MUCH_ROUNDED and not 0.0 <= -shares[1] <= 1.0:
            recount(instances, fits, pair, action, kernel, slot, scratch)
        # The fit is no longer that of the instances that are left.
        shares = min(1.0, abs(shares[0])), min(1.0, abs(shares[1]))
        fits.unexplained[pair] += contradiction(fits, pair, instances, action, slot, state, shares)
    return changed


@compiled
def refit_changed(fits, grid, scratch, changed):
    """Fit all pairs again that have had instances since the last time; how many rows are to be updated.

    All rows are looked at: the range that effects are kept within may have grown.

    :param changed: int64, shape (n_pairs,): receives these pairs
    """
    n_points = grid.shape[0] * grid.strides[0]
    n = 0
    for pair in range(len(fits.total)):
        # What has neither own nor the prior's model has a row, if any, from its last update with transferred instances.
        modelled = fits.known[pair] or fits.claimed[pair]
        if fits.n_counted[pair] == 0 or not (modelled or fits.unexplained[pair] < np.inf):
            continue
        action = pair // n_points
        if fits.unexplained[pair] > 0.0:
            moved = refit(fits, pair, action, grid, scratch, 0.0)
        else:
            unit_coordinates_of(pair - action * n_points, grid, scratch.at)
            moved = prediction_moved(fits, pair, action, scratch.at, 0.0)
        if moved:
            changed[n] = pair
            n += 1
    return n


@compiled
def recount_pairs(instances, fits, grid, kernel, threshold, scratch):
    """Compute sums and fits of all pairs from the instances and from ``reach``; what was known stays known.

    :param threshold: weight that makes a pair known
    """
    n_points = grid.shape[0] * grid.strides[0]
    for pair in range(len(fits.total)):
        action = pair // n_points
        unit_coordinates_of(pair - action * n_points, grid, scratch.at)
        total = recount(instances, fits, pair, action, kernel, np.int64(-1), scratch)
        # What a narrower kernel leaves out has counted.
        fits.total[pair] = max(fits.total[pair], total)
        if fits.total[pair] >= threshold:
            fits.known[pair] = True
        fits.unexplained[pair] = np.inf
        if fits.n_counted[pair] > 0 and (fits.known[pair] or fits.claimed[pair]):
            refit(fits, pair, action, grid, scratch, 0.0)


@inlined
def predict_from_prior(fits, pair):
    """Put what the prior predicts into ``fits.row``: no instance counts for the pair."""
    for k in range(fits.row.shape[1]):
        fits.row[pair, k] = fits.prior[pair, k]


@part
def update_rows(fits, mdp, grid, gamma, pairs, transferred, scratch, fit_scratch):
    """Bring the rows of ``pairs`` up to date with their fits and with transferred instances.

    :param pairs: (pairs, how many of them are done)
    :param transferred: a row for each of them, which counts only while the pair is not known
    :return: how many of them are done; fewer than all if there is no room in the MDP
    """
    pairs, done = pairs
    n_points = len(mdp.n_optimistic)
    d = len(grid.shape)
    while done < len(pairs):
        pair = pairs[done]
        n_transferred = 0 if fits.known[pair] else transferred.length[done]
        modelled = fits.known[pair] or fits.claimed[pair] or n_transferred > 0
        if modelled:
            point = pair % n_points
            coordinates_of(point, grid, scratch.at)
            own = fits.total[pair] if fits.n_counted[pair] > 0 else 0.0
            if own == 0.0 and fits.claimed[pair]:
                predict_from_prior(fits, pair)
                own = 1.0
            total = own
            for j in range(n_transferred):
                total += transferred.weight[done, j]
            reward = 0.0
            n_touched = np.int64(0)
            if own > 0.0:
                if fits.unexplained[pair] == np.inf and fits.n_counted[pair] > 0:
                    refit(fits, pair, pair // n_points, grid, fit_scratch, 0.0)
                row = fits.row[pair]
                reward = own / total * row[d]
                if row[d + 1] < 1.0:
                    n_touched = add_successor(own / total * (1.0 - row[d + 1]), row[:d], scratch, grid, n_touched)
            for j in range(n_transferred):
                p = transferred.weight[done, j] / total
                reward += p * transferred.reward[done, j]
                if not transferred.terminated[done, j]:
                    n_touched = add_successor(p, transferred.effect[done, j], scratch, grid, n_touched)
            if not finish_row(mdp, gamma, pair, point, reward, n_touched, scratch):
                return done
        fits.last_total[pair] = fits.total[pair]
        set_modelled(mdp, pair, modelled)
        done += 1
    return done


@compiled
def update_rows_plain(fits, mdp, grid, gamma, pairs, transferred, scratch, fit_scratch):
    """:func:`update_rows` for callers from Python, with plain tuples."""
    fits, grid, scratch, fit_scratch = LinearFits(*fits), GridArrays(*grid), RowScratch(*scratch), FitScratch(*fit_scratch)
    return update_rows(fits, as_mdp(mdp), grid, gamma, pairs, TransferredInstances(*transferred), scratch, fit_scratch)
