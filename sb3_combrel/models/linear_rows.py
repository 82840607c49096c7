"""Compiled loops of the local linear model: predictions at exact states, and the rows of grid pairs."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.common.constants import MAX_MODEL_STEPS
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.kernels import any_periodic, nearest_instances, squared_distance
from sb3_combrel.common.regression import (
    GROUP,
    Kernel,
    LocalFit,
    ends_by_action,
    fit_around,
    join_prior,
    known_weight,
    largest_residual,
    leverage_of,
    number_at,
    write_noise,
)
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.ends import (
    Ends,
    distance_of_nearest,
    end_at,
    none_decides,
    squared_distance_of_end,
    weigh_ends,
)
from sb3_combrel.models.grid_model import add_to_row, total_weight
from sb3_combrel.models.grid_points import PairArrays, note_fit
from sb3_combrel.planning.grid import (
    GridArrays,
    cell_width,
    coordinates_of,
    corners_of,
    grid_coordinates,
    unit_coordinates_of,
    unit_of_line,
)
from sb3_combrel.planning.mdp import MDPArrays, RowScratch, add_successor, finish_row, set_modelled
from sb3_combrel.planning.q_values import Prediction

# In parts of a cell: an effect of less is none.
STAYS = 1e-6
ROUNDING = 1e-9


class LinearArrays(NamedTuple):
    """What the local linear model has besides instances and pairs."""

    prior: np.ndarray  # float64, (n_pairs, 2 * n_variables): effects that a prior predicts, and their weights; 0 without one
    last: np.ndarray  # float64, (n_variables,): the exact state that was asked for last
    radius: np.ndarray  # float64, (n_actions,): how far from it a full list of near instances reaches; infinite without one


class LinearScratch(NamedTuple):
    """Work space; float64."""

    at: np.ndarray  # (n_variables,): unit coordinates of a pair's point
    away: np.ndarray  # (n_variables,): displacement by several steps
    step: np.ndarray  # (n_variables,): the effect of a step
    to: np.ndarray  # (n_variables,): where it leads
    end: np.ndarray  # (2,): probability of an end there, and what it pays
    prior: np.ndarray  # (2 * n_variables,): what a prior says at a state, between the grid points multilinear


class Around(NamedTuple):
    """What is known of arrivals and ends around the state of a fit."""

    length: int  # instances of the fit
    near: float  # how far the nearest of them has led
    of_end: float  # how far the nearest end is; infinite without any
    noise: float  # no noise of an effect is larger


@compiled
def look_around(at, action, length, experience, kernel, fit):
    """:class:`Around` of the state of a fit, which a prior may have joined."""
    _, arrivals, ends = experience
    of_end = squared_distance_of_end(at, ends, arrivals.periodic)
    if of_end == np.inf:
        return Around(length, 0.0, np.inf, 0.0)
    near = squared_distance(at, arrivals.state[action, fit.item[0]], arrivals.periodic, True)
    fit.noisy[0] = np.nan
    return Around(length, np.sqrt(near), np.sqrt(of_end), np.sqrt(2.0 * largest_residual(length, kernel, fit)))


@inlined
def outcome_of(fit, away, to, moved, around, experience, kernel, end):
    """Expected reward of a step from ``away`` of a fit's state to ``to``; writes to ``end`` the probability that it ends.

    :param moved: how far ``to`` is from the fit's state
    """
    reward = number_at(fit, len(to), away)
    if ends_by_action(fit):
        end[0] = number_at(fit, len(to) + 1, away)
        return reward
    end[0], end[1] = 0.0, 0.0
    # Where even the nearest end there could be is too far to decide, none is searched for.
    near = moved + around.near
    if not none_decides(around.of_end - moved, near, around.noise, kernel.outcome_breadth):
        mean_end(fit, to, near, around, experience, kernel, end)
    return (1.0 - end[0]) * reward + end[0] * end[1]


@compiled
def mean_end(fit, to, near, around, experience, kernel, end):
    """Write to ``end`` what arriving at ``to`` means, or, with noise, around it (see ``models.ends``).

    :param near: how far some arrival is, no more
    """
    _, arrivals, ends = experience
    noise, breadth = around.noise, kernel.outcome_breadth
    of_end, most = squared_distance_of_end(to, ends, arrivals.periodic), noise * noise
    if none_decides(np.sqrt(of_end), near, noise, breadth):
        return
    nearest = distance_of_nearest(to, max(most, near * near), of_end, noise, breadth, arrivals, ends.hint)
    if none_decides(np.sqrt(of_end), np.sqrt(nearest), noise, breadth):
        return
    if nearest < most and np.isnan(fit.noisy[0]):
        write_noise(around.length, kernel, fit)
    # Where no arrival is as near as the noise is large, the mean effect says where one arrives.
    if nearest >= most or fit.noisy[0] <= nearest:
        weigh_ends(to, of_end, nearest, breadth, arrivals, end)
        return
    total, ended, paid = 0.0, 0.0, 0.0
    for k in range(around.length):
        square = 0.0
        for v in range(len(to)):
            square += fit.noise[k, v] * fit.noise[k, v]
            to[v] += fit.noise[k, v]
        end_at(to, (np.sqrt(nearest) + np.sqrt(square)) ** 2, breadth, arrivals, ends, end)
        for v in range(len(to)):
            to[v] -= fit.noise[k, v]
        weight = fit.weighted[0, k // GROUP, k % GROUP]
        total += weight
        ended += weight * end[0]
        paid += weight * end[0] * end[1]
    end[0], end[1] = ended / total, paid / ended if ended > 0.0 else 0.0


@entry_point
def predict_own(experience, linear, grid, has_prior, state, kernel, threshold, fit, scratch, corners, prediction):
    """Predict every action at ``state`` from the instances nearest to it, and from the prior; the least weight one has.

    :param experience: (instances, arrivals, ends); plain tuples all of them
    :param corners: work space: position, corner_index and corner_weight of ``RowScratch``
    """
    instances = Instances(*experience[0])
    experience = instances, Instances(*experience[1]), Ends(*experience[2])
    linear, kernel, fit = LinearArrays(*linear), Kernel(*kernel), LocalFit(*fit)
    scratch, prediction, grid = LinearScratch(*scratch), Prediction(*prediction), GridArrays(*grid)
    position, corner, corner_weight = corners
    d = len(state)
    least = np.inf
    n_corners = 0
    if has_prior:
        grid_coordinates(state, grid, position)
        n_corners = corners_of(position, grid, corner, corner_weight)
    apart = np.sqrt(squared_distance(state, linear.last, instances.periodic, True))
    for v in range(d):
        linear.last[v] = state[v]
    for action in range(len(linear.radius)):
        # A full list around the last state lies within its radius, and as far again as that state is.
        farthest = min(kernel.reach, (linear.radius[action] + apart) ** 2 * (1.0 + ROUNDING))
        length = nearest_instances(instances, action, state, farthest, fit.item, fit.distance)
        linear.radius[action] = np.sqrt(fit.distance[length - 1]) if length == kernel.n_neighbors else np.inf
        weight = known_weight(fit, length, kernel)
        prediction.weight[action], prediction.modelled[action] = weight, weight >= threshold
        least = min(least, weight)
        prediction.reward[action], prediction.length[action] = 0.0, 0
        if length == 0:
            continue
        fit_around(state, action, length, instances, kernel, fit)
        if has_prior:
            # Finer effects would be confirmed by instances at a wall, but not at the grid points beside, which lead through.
            first = action * grid.shape[0] * grid.strides[0]
            scratch.prior[:] = 0.0
            for c in range(n_corners):
                for k in range(2 * d):
                    scratch.prior[k] += corner_weight[c] * linear.prior[first + corner[c], k]
            join_prior(scratch.prior, kernel, length, fit)
        around = look_around(state, action, length, experience, kernel, fit)
        scratch.away[:] = 0.0
        moved = 0.0
        for v in range(d):
            effect = number_at(fit, v, scratch.away)
            prediction.effect[action, 0, v] = effect
            scratch.to[v] = state[v] + effect
            moved += effect * effect
        reward = outcome_of(fit, scratch.away, scratch.to, np.sqrt(moved), around, experience, kernel, scratch.end)
        end = scratch.end[0]
        prediction.reward[action], prediction.length[action] = reward, 1 if end < 1.0 else 0
        prediction.probability[action, 0] = 1.0 - end
    return least


@entry_point
def predict_alone(instances, kernel, state, action, fit, scratch, effect):
    """Write to ``effect`` what the instances alone predict of an action, without a prior; plain tuples.

    :return: the fit's leverage, by which the variance of one instance is multiplied; 0 without any instance near the state
    """
    instances, kernel, fit, scratch = Instances(*instances), Kernel(*kernel), LocalFit(*fit), LinearScratch(*scratch)
    length = nearest_instances(instances, action, state, kernel.reach, fit.item, fit.distance)
    if length == 0:
        return 0.0
    fit_around(state, action, length, instances, kernel, fit)
    scratch.away[:] = 0.0
    for v in range(len(state)):
        effect[v] = number_at(fit, v, scratch.away)
    return leverage_of(fit, length, kernel)


@inlined
def take_step(fit, grid, at, scratch):
    """Write the effect of the next step to ``scratch.step``, within the grid; the part of it until the cell is left."""
    away, step = scratch.away, scratch.step
    inside = 1.0
    moved = False
    for k in range(len(at)):
        here = away[k]
        there = here + number_at(fit, k, away)
        if not grid.periodic[k]:
            first, last = unit_of_line(0, k, grid) - scratch.at[k], unit_of_line(grid.shape[k] - 1, k, grid) - scratch.at[k]
            there = min(max(there, first), last)
        moved = moved or abs(there - here) * grid.cells[k] > STAYS
        width = cell_width(at[k], there > 0.0, k, grid)
        if abs(there) > width:
            inside = min(inside, ((width if there > 0.0 else -width) - here) / (there - here))
        step[k] = there - here
        scratch.to[k] = scratch.at[k] + away[k] + step[k]
    return inside if moved else 0.0


@inlined
def follow(fit, around, experience, kernel, grid, at, planned, scratch):
    """Follow a fit around a grid point, the action held, until a variable has changed by a cell, or the episode ends.

    :param at: grid coordinates of the point; ``planned``: (gamma, most steps)
    :return: discounted reward, probability that the episode goes on, discount; ``scratch.away`` receives the displacement
    """
    d = len(at)
    gamma, max_steps = planned
    away = scratch.away
    away[:] = 0.0
    total, goes_on, discount = 0.0, 1.0, 1.0
    for n in range(max_steps):
        inside = take_step(fit, grid, at, scratch)
        moved = 0.0
        for k in range(d):
            moved += (away[k] + scratch.step[k]) ** 2
        reward = outcome_of(fit, away, scratch.to, np.sqrt(moved), around, experience, kernel, scratch.end)
        end = scratch.end[0]
        # The first step is never cut short, nor one that may end the episode.
        taken = 1.0 if n == 0 or end > 0.0 or inside == 0.0 else inside
        total += discount * goes_on * taken * reward
        goes_on *= 1.0 - end
        if gamma < 1.0:
            discount *= gamma**taken
        left = False
        for k in range(d):
            away[k] += taken * scratch.step[k]
            left = left or abs(away[k]) >= cell_width(at[k], away[k] > 0.0, k, grid)
        if inside == 0.0 or taken < 1.0 or left or end > 0.5:
            break
    return total, goes_on, discount


@inlined
def recall_instances(pair, at, action, instances, pairs, fit):
    """Write the instances that a pair was fitted to, and their distances; how many these are."""
    wraps = any_periodic(instances.periodic)
    for k in range(pairs.length[pair]):
        fit.item[k] = pairs.item[pair, k]
        fit.distance[k] = squared_distance(at, instances.state[action, fit.item[k]], instances.periodic, wraps)
    return pairs.length[pair]


@entry_point
def update_rows(experience, linear, pairs, mdp, grid, kernel, planned, which, transferred, row_scratch, fit, scratch):
    """Fit pairs anew, and write their rows, with transferred instances for what is not known; how many are done.

    :param planned: (gamma, threshold, whether there is a prior, transitions so far); the rest as in ``kernel_average``
    """
    instances = Instances(*experience[0])
    experience = instances, Instances(*experience[1]), Ends(*experience[2])
    linear, pairs, kernel = LinearArrays(*linear), PairArrays(*pairs), Kernel(*kernel)
    mdp, grid = MDPArrays(*mdp), GridArrays(*grid)
    transferred, row_scratch = TransferredInstances(*transferred), RowScratch(*row_scratch)
    fit, scratch = LocalFit(*fit), LinearScratch(*scratch)
    gamma, threshold, has_prior, transitions = planned
    which, done = which
    n_points = len(mdp.n_optimistic)
    while done < len(which):
        pair = which[done]
        point = pair % n_points
        action = pair // n_points
        coordinates_of(point, grid, row_scratch.at)
        unit_coordinates_of(row_scratch.at, grid, scratch.at)
        if has_prior and pairs.known[pair] and pairs.n_new[pair] == 0 and pairs.length[pair] > 0:
            length, weight = recall_instances(pair, scratch.at, action, instances, pairs, fit), pairs.weight[pair]
        else:
            # Instances only come nearer, but for those that are removed (see grid_points.look_at).
            length = nearest_instances(instances, action, scratch.at, pairs.reach[pair], fit.item, fit.distance)
            weight = known_weight(fit, length, kernel)
            pairs.reach[pair] = fit.distance[length - 1] if length == kernel.n_neighbors else kernel.reach
        known = note_fit(pair, length, weight, threshold, transitions, pairs)
        joined = not known and transferred.length[done] > 0
        if known or joined:
            total = total_weight(weight, transferred, done) if joined else weight
            reward, discount, n_touched = 0.0, gamma, np.int64(0)
            if length > 0:
                fit_around(scratch.at, action, length, instances, kernel, fit)
                if has_prior:
                    for k in range(length):
                        pairs.item[pair, k] = fit.item[k]
                    join_prior(linear.prior[pair], kernel, length, fit)
                around = look_around(scratch.at, action, length, experience, kernel, fit)
                for p in range(pairs.fit.shape[1]):
                    for v in range(pairs.fit.shape[2]):
                        pairs.fit[pair, p, v] = fit.solution[p, v]
                how = gamma, 1 if joined else MAX_MODEL_STEPS
                reward, goes_on, discount = follow(fit, around, experience, kernel, grid, row_scratch.at, how, scratch)
                if goes_on < 1.0:
                    # Near an end every arrival matters.
                    pairs.surprise[pair] = np.inf
                reward *= weight / total
                if goes_on > 0.0:
                    n_touched = add_successor(goes_on * (weight / total), scratch.away, row_scratch, grid, n_touched)
            if joined:
                reward, n_touched = add_to_row(reward, n_touched, transferred, done, total, row_scratch, grid)
            if not finish_row(mdp, discount, pair, point, reward, n_touched, row_scratch):
                return done
        set_modelled(mdp, pair, known or joined)
        done += 1
    return done
