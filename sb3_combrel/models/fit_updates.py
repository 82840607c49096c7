"""Compiled loops of the local linear model: what an instance that comes or goes changes in the fits of the grid."""

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, part
from sb3_combrel.common.instances import Instances, put_instance
from sb3_combrel.common.kernels import any_periodic
from sb3_combrel.common.linear_regression import fitted_effect, products_of
from sb3_combrel.common.periodic import bring_near, difference
from sb3_combrel.models.fit_arrays import FitScratch, Kernel, LinearFits
from sb3_combrel.models.linear_fits import count_instance, narrow, narrow_and_refit, prediction_moved, recount, refit
from sb3_combrel.planning.grid import GridArrays, unit_coordinates_of

# Within an episode a pair is fitted again once new instances may move its prediction by this part of the action's effects.
MAX_UNEXPLAINED = 0.2
# Where less narrower weight than this is left, and more was subtracted, rounding decides: the sums are computed anew.
MUCH_ROUNDED = 1e-6
# A variable that hardly ever changes is measured by this part of a cell.
LEAST_SCALE = 0.02


@part
def points_within(state, reach, widest, grid, scratch):
    """How many grid points have a squared distance to ``state`` up to ``reach``, shape (n_points,), and up to ``widest``.

    They are written to ``scratch.point``, their squared distances to ``scratch.distance``.
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
def contradiction(fits, pair, instances, action, slot, state, shares):
    """By how much an instance, at ``state``, may change what its pair predicts; ``shares``: see :func:`count_instance`."""
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


@compiled
def enter(instances, fits, grid, kernel, thresholds, transition, prior, scratch):
    """Write an instance to its slot, and count it for all pairs that it reaches; plain tuples.

    :param thresholds: (weight that makes a pair known, change of that of another pair that has its row updated, 0: never)
    :param transition: (action, slot, state, next_state, reward, terminated)
    :param prior: effect that the prior predicts of it
    :return: of how many pairs the rows are to be updated; their points are moved to the front of ``scratch.point``
    """
    instances, fits, grid = Instances(*instances), LinearFits(*fits), GridArrays(*grid)
    kernel, scratch = Kernel(*kernel), FitScratch(*scratch)
    threshold, min_change = thresholds
    action, slot, _, _, reward, terminated = transition
    n_points = grid.shape[0] * grid.strides[0]
    first_pair = action * n_points
    put_instance(instances, transition)
    state = scratch.state
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
        fits.total[pair] += np.exp(distance * kernel.counting_scale)
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


@part
def count_without(instances, fits, pair, action, slot, kernel, scratch):
    """Bring a pair that has lost an instance in order; whether its row is to be updated.

    A narrow kernel with less than half of ``n_neighbors`` left is as broad again as these allow.
    """
    if fits.n_counted[pair] > 0 and (2 * fits.n_counted[pair] >= kernel.n_neighbors or fits.reach[pair] >= kernel.reach):
        return False
    fits.reach[pair] = kernel.reach
    narrow(instances, fits, pair, action, kernel, slot, scratch)
    if fits.n_counted[pair] == 0:
        fits.sums[pair, :] = 0.0
        fits.outcome[pair, :] = 0.0
        fits.n_ended[pair] = 0
        fits.total[pair] = 0.0
        fits.known[pair] = False
    fits.unexplained[pair] = np.inf
    return True


@compiled
def leave(instances, fits, grid, kernel, action, slot, scratch):
    """Take an instance out of the sums of the pairs for which it counts, before another is entered in its place.

    Of how many pairs the rows are to be updated at once; their points are moved to the front of ``scratch.point``.
    """
    n_points = grid.shape[0] * grid.strides[0]
    first_pair = action * n_points
    state = scratch.state
    reward, terminated = instances.reward[action, slot], instances.terminated[action, slot]
    for k in range(len(state)):
        fits.effect_range[2, action, k] -= abs(instances.effect[action, slot, k])
    products = scratch.products[0]
    reach = fits.reach[first_pair : first_pair + n_points]
    n_found = points_within(instances.state[action, slot], reach, kernel.reach, grid, scratch)
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
def refit_changed(fits, grid, scratch, range_has_changed, changed):
    """Fit all pairs again that have had instances since the last time; how many rows are to be updated, in ``changed``."""
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
        # The prediction at the point may be as before, and that on the way not.
        if moved or fits.refitted[pair] or (fits.clipped[pair] and range_has_changed[action]):
            changed[n] = pair
            n += 1
    return n


@compiled
def recount_pairs(instances, fits, grid, kernel, threshold, scratch):
    """Compute sums and fits of all pairs from the instances and from ``reach``; what was known stays known."""
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


@compiled
def recount_totals(instances, fits, grid, kernel, scratch):
    """Compute the weights that decide what is known anew, from all instances that a kernel may reach at all."""
    n_points = grid.shape[0] * grid.strides[0]
    fits.total[:] = 0.0
    for action in range(len(instances.size)):
        total = fits.total[action * n_points : (action + 1) * n_points]
        for i in range(instances.size[action]):
            n_found = points_within(instances.state[action, i], scratch.full_reach, kernel.reach, grid, scratch)
            for f in range(n_found):
                total[scratch.point[f]] += np.exp(scratch.distance[f] * kernel.counting_scale)
