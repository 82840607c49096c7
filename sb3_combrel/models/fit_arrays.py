"""The arrays of the local linear model: what it has of each state-action pair of the grid."""

from typing import NamedTuple

import numpy as np


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
    :param n_ended: int32, shape (n_pairs,): how many of them ended an episode
    :param limit: int32, shape (n_pairs,): more than this, and the kernel narrows
    :param total: float64, shape (n_pairs,): sum of the weights (of breadth ``model_breadth``) of all that counted
    :param last_total: float64, shape (n_pairs,): what ``total`` was when the pair's row was updated
    :param refitted: bool, shape (n_pairs,): the pair has been fitted again since its row was written
    :param clipped: bool, shape (n_pairs,): the pair's row would be another one if the range of effects were larger
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
    n_ended: np.ndarray
    limit: np.ndarray
    total: np.ndarray
    last_total: np.ndarray
    refitted: np.ndarray
    clipped: np.ndarray
    known: np.ndarray
    claimed: np.ndarray
    target: np.ndarray
    prior: np.ndarray
    effect_range: np.ndarray
    effect_scale: np.ndarray


class FitScratch(NamedTuple):
    """Work space for fits.

    :param at: float64, shape (n_variables,): unit coordinates of a pair's point
    :param entering: float64, same shape: where an instance is that comes or goes; ``state``: one that is counted anew, or
        where a pair's action has led to
    :param step: float64, same shape: the effect of a step
    :param products: float64, shape (2, n_products): of an instance that comes or goes, and of one that is counted anew
    :param factor: float64, shape (n_variables, n_variables)
    :param nearest: float64, shape (n_neighbors,): squared distances
    :param along: float64, shape (n_variables, largest axis of the grid): squared distances along one variable
    :param span: int64, shape (3, n_variables): first grid coordinate within reach, one past the last, the present one
    :param point: int64, shape (n_points,): points within reach; ``distance``: float64, same shape: squared distances
    :param full_reach: float64, shape (n_points,): the squared reach of a kernel that is not narrowed
    """

    at: np.ndarray
    entering: np.ndarray
    state: np.ndarray
    step: np.ndarray
    products: np.ndarray
    factor: np.ndarray
    nearest: np.ndarray
    along: np.ndarray
    span: np.ndarray
    point: np.ndarray
    distance: np.ndarray
    full_reach: np.ndarray


class Kernel(NamedTuple):
    """What decides the weights of instances.

    :param scale: -1 / model_breadth ** 2
    :param reach: squared distance at which an instance weighs ``min_weight``
    :param outcome_scale: -1 / outcome_breadth ** 2, for rewards and ends
    :param n_neighbors: instances that a fit is made to
    :param counting_scale: the scale of the weights that decide what is known, no broader
    """

    scale: float
    reach: float
    outcome_scale: float
    n_neighbors: int
    counting_scale: float
