"""Compiled loops of the local linear model: the rows of state-action pairs, from their fits."""

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined, inner
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.compiled_model import add_to_row, total_weight
from sb3_combrel.models.fit_arrays import FitScratch, LinearFits
from sb3_combrel.models.linear_fits import PRIOR_WEIGHT, refit
from sb3_combrel.planning.grid import GridArrays
from sb3_combrel.planning.mdp import RowScratch, add_successor, as_mdp, coordinates_of, finish_row, set_modelled

# In parts of a cell: an effect of less is none.
STAYS = 1e-6


@inlined
def prior_change(fits, pair, k, grid, at, away):
    """By how much the prior's effect ``k`` changes from a pair's point to ``away`` from there, linear between grid points."""
    change = 0.0
    for j in range(len(at)):
        if away[j] == 0.0:
            continue
        side = 1 if away[j] > 0.0 else -1
        if not grid.periodic[j] and not 0 <= at[j] + side < grid.shape[j]:
            side = -side
        to = at[j] + side
        steps = (to % grid.shape[j]) - at[j]
        beside = pair + steps * grid.strides[j]
        if fits.claimed[beside] == fits.claimed[pair]:
            change += (fits.prior[beside, k] - fits.prior[pair, k]) * side * grid.cells[j] * away[j]
    return change


@inner
def follow(fits, pair, action, grid, at, limits, scratch):
    """Follow a pair's model, the action held, until a variable has changed by a cell of the grid; the number of steps.

    The effect of a step is that of the pair's fit where it begins, within the range of effects; the last step is cut short.

    :param at: grid coordinates of the point
    :param limits: (max_model_steps, whether there is a prior); ``scratch.away`` receives the displacement
    """
    max_steps, has_prior = limits
    d = len(at)
    away, step, fit = scratch.away, scratch.step, fits.fit[pair]
    fitted = fits.n_counted[pair] > 0
    share = fits.sums[pair, 0] / (fits.sums[pair, 0] + PRIOR_WEIGHT) if fits.claimed[pair] else 1.0
    low, high = fits.effect_range[0, action], fits.effect_range[1, action]
    away[:] = 0.0
    steps = 0.0
    fits.clipped[pair] = False
    while steps < max_steps:
        part_of_step = 1.0
        for k in range(d):
            effect = fits.row[pair, k]
            if fitted:
                for j in range(d):
                    effect += share * fit[d + j * d + k] * away[j]
            if has_prior:
                effect += prior_change(fits, pair, k, grid, at, away)
            if effect < low[k] or effect > high[k]:
                fits.clipped[pair] = True
                effect = min(max(effect, low[k]), high[k])
            cells = away[k] * grid.cells[k]
            after = cells + effect * grid.cells[k]
            if not grid.periodic[k]:
                after = min(max(after, -float(at[k])), float(grid.shape[k] - 1 - at[k]))
            if steps > 0.0 and abs(after) > 1.0:
                part_of_step = min(part_of_step, ((1.0 if after > 0.0 else -1.0) - cells) / (after - cells))
            step[k] = (after - cells) / grid.cells[k]
        farthest = 0.0
        for k in range(d):
            away[k] += part_of_step * step[k]
            farthest = max(farthest, abs(away[k]) * grid.cells[k])
        steps += part_of_step
        if part_of_step < 1.0 or farthest >= 1.0 or farthest < STAYS:
            break
    return steps


@inner
def write_row(fits, mdp, grid, gamma, pair, limits, scratch, fit_scratch):
    """Write the row of a pair whose model is its fit, the prior, or both; False if there is no room.

    Where none of the instances that count has ended an episode, the row leads as many steps ahead as it takes to leave the
    cell; otherwise one: how far away an end is matters there.
    """
    n_points = len(mdp.n_optimistic)
    point, action = pair % n_points, pair // n_points
    row = fits.row[pair]
    d = len(row) - 2
    reward, end, discount, steps = row[d], row[d + 1], gamma, 1.0
    n_touched = np.int64(0)
    if end == 0.0 and fits.n_ended[pair] == 0 and limits[0] > 1:
        steps = follow(fits, pair, action, grid, scratch.at, limits, fit_scratch)
        discount = gamma**steps
        reward *= steps if gamma == 1.0 else (1.0 - discount) / (1.0 - gamma)
        n_touched = add_successor(1.0, fit_scratch.away, scratch, grid, n_touched)
    elif end < 1.0:
        n_touched = add_successor(1.0 - end, row[:d], scratch, grid, n_touched)
    return finish_row(mdp, discount, pair, point, reward, n_touched, scratch)


@inner
def write_row_with_transferred(fits, mdp, grid, gamma, pair, transferred, asked, scratch):
    """Write the row of a pair that is not known from its own and transferred instances; False if there is no room."""
    own = fits.total[pair] if fits.n_counted[pair] > 0 else 0.0
    total = total_weight(own, transferred, asked)
    reward = 0.0
    n_touched = np.int64(0)
    if own > 0.0:
        row, d = fits.row[pair], len(grid.shape)
        reward = own / total * row[d]
        if row[d + 1] < 1.0:
            n_touched = add_successor(own / total * (1.0 - row[d + 1]), row[:d], scratch, grid, n_touched)
    reward, n_touched = add_to_row(reward, n_touched, transferred, asked, total, scratch, grid)
    return finish_row(mdp, gamma, pair, pair % len(mdp.n_optimistic), reward, n_touched, scratch)


@compiled
def update_rows(fits, mdp, grid, planned, pairs, transferred, scratch, fit_scratch):
    """Bring rows up to date with the pairs' fits and with transferred instances; how many are done.

    :param planned: (gamma, max_model_steps, whether there is a prior); plain tuples for the rest
    :param pairs: (pairs, how many of them are done)
    :param transferred: a row for each of them, which counts only while the pair is not known
    """
    fits, mdp, grid, transferred = LinearFits(*fits), as_mdp(mdp), GridArrays(*grid), TransferredInstances(*transferred)
    scratch, fit_scratch = RowScratch(*scratch), FitScratch(*fit_scratch)
    pairs, done = pairs
    gamma, max_steps, has_prior = planned
    n_points = len(mdp.n_optimistic)
    while done < len(pairs):
        pair = pairs[done]
        with_transferred = not fits.known[pair] and transferred.length[done] > 0
        modelled = fits.known[pair] or fits.claimed[pair] or with_transferred
        if modelled:
            coordinates_of(pair % n_points, grid, scratch.at)
            if fits.n_counted[pair] == 0:
                for k in range(fits.row.shape[1]):
                    fits.row[pair, k] = fits.prior[pair, k]
            elif fits.unexplained[pair] == np.inf:
                refit(fits, pair, pair // n_points, grid, fit_scratch, 0.0)
            if with_transferred:
                written = write_row_with_transferred(fits, mdp, grid, gamma, pair, transferred, done, scratch)
            else:
                written = write_row(fits, mdp, grid, gamma, pair, (max_steps, has_prior), scratch, fit_scratch)
            if not written:
                return done
        fits.refitted[pair] = False
        fits.last_total[pair] = fits.total[pair]
        set_modelled(mdp, pair, modelled)
        done += 1
    return done
