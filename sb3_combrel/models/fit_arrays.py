"""The arrays of the local linear model: what it has of each state-action pair of the grid."""

from typing import NamedTuple

import numpy as np


class LinearFits(NamedTuple):
    """The local linear fit of each pair of the grid (pair ``action * n_points + point``); float64 if nothing else is said."""

    sums: np.ndarray  # (n_pairs, n_products): see common.linear_regression
    # Sums of narrower weights, and of these times reward, termination, state and effect.
    outcome: np.ndarray  # (n_pairs, 3 + 2 * n_variables)
    fit: np.ndarray  # (n_pairs, n_variables + n_variables ** 2): intercept and slopes
    row: np.ndarray  # (n_pairs, n_variables + 2): effect, reward and probability of termination in the pair's row
    # By how much instances that came after the fit may change its prediction; inf without a fit.
    unexplained: np.ndarray  # (n_pairs,)
    reach: np.ndarray  # (n_pairs,): squared distance up to which instances count
    scale: np.ndarray  # (n_pairs,): -1 / breadth ** 2 of the pair's kernel
    n_counted: np.ndarray  # int32, (n_pairs,): instances that count
    n_ended: np.ndarray  # int32, (n_pairs,): how many of them ended an episode
    limit: np.ndarray  # int32, (n_pairs,): more than this, and the kernel narrows
    total: np.ndarray  # (n_pairs,): sum of the weights (of breadth model_breadth) of all that counted
    last_total: np.ndarray  # (n_pairs,): what total was when the pair's row was updated
    refitted: np.ndarray  # bool, (n_pairs,): the pair has been fitted again since its row was written
    clipped: np.ndarray  # bool, (n_pairs,): the pair's row would be another one if the range of effects were larger
    known: np.ndarray  # bool, (n_pairs,)
    claimed: np.ndarray  # bool, (n_pairs,): the prior suffices for a model
    target: np.ndarray  # (n_actions, capacity, n_variables): effect of each instance less the prior's
    # Effect, reward and probability of termination that the prior predicts; 0 without one.
    prior: np.ndarray  # (n_pairs, n_variables + 2)
    # Least and largest effect of the instances and of the prior on the grid; sum of the sizes of those of the instances.
    effect_range: np.ndarray  # (3, n_actions, n_variables)
    effect_scale: np.ndarray  # (n_actions, n_variables): what a difference of effects is measured by


class FitScratch(NamedTuple):
    """Work space for fits; float64 where nothing else is said."""

    at: np.ndarray  # (n_variables,): unit coordinates of a pair's point
    state: np.ndarray  # (n_variables,): where an instance is that comes or goes
    counted: np.ndarray  # (n_variables,): where an instance is that is counted anew
    away: np.ndarray  # (n_variables,): displacement by several steps
    step: np.ndarray  # (n_variables,): the effect of a step
    products: np.ndarray  # (2, n_products): of an instance that comes or goes, and of one that is counted anew
    factor: np.ndarray  # (n_variables, n_variables)
    item: np.ndarray  # int32, (n_neighbors,): nearest instances
    nearest: np.ndarray  # (n_neighbors,): their squared distances
    along: np.ndarray  # (n_variables, largest axis of the grid): squared distances along one variable
    span: np.ndarray  # int64, (3, n_variables): first grid coordinate within reach, one past the last, the present one
    point: np.ndarray  # int64, (n_points,): points within reach
    distance: np.ndarray  # (n_points,): their squared distances
    full_reach: np.ndarray  # (n_points,): the squared reach of a kernel that is not narrowed


class Kernel(NamedTuple):
    """What decides the weights of instances."""

    scale: float  # -1 / model_breadth ** 2
    reach: float  # squared distance at which an instance weighs min_weight
    outcome_scale: float  # -1 / outcome_breadth ** 2, for rewards and ends
    n_neighbors: int  # instances that a fit is made to
    counting_scale: float  # the scale of the weights that decide what is known, no broader
