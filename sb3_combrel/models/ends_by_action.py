"""What decides how an episode ends: where one arrives, or which action is taken where one is.

The former is learned from fewer instances, as the arrivals of all actions tell of it (see ``models.ends``), and is sharp at an
edge. But stopping, selling and choosing end an episode wherever that leads, and the last observations of some environments are
none. Then whether an episode ends, and what a step pays, are numbers that are fitted at the state and action.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.models.base import Transition


def evidence_for_action(transitions: Sequence[Transition]) -> float:
    """By how much better ends are foretold by the action than by where it leads, in standard errors.

    The outcome of each instance, an end and what that pays, is foretold to be that of another one: (1) of the nearest one of
    the same action; (2) of the one that arrived nearest to where the effect of the nearest one that went on would lead. The
    error is 1 if only one of both ended; if both did, how far apart their rewards are, in parts of the range of all. Distances
    do not wrap.

    :param transitions: state, action, reward, next state and terminated of each
    """
    state, action, reward, after, ended = map(np.array, zip(*transitions, strict=True))
    effect, number = after - state, np.arange(len(action))
    by_action, expected = np.full(len(action), -1), state.copy()
    for one in np.unique(action).tolist():
        own, going_on = number[action == one], number[(action == one) & ~ended]
        by_action[own] = nearest(state, own, state[own], own)
        near = nearest(state, going_on, state[own], own)
        expected[own[near >= 0]] += effect[near[near >= 0]]
    by_arrival = nearest(state + effect, number, expected, number)
    told, scale = (by_action >= 0) & (by_arrival >= 0), max(float(np.ptp(reward)), 1e-300)
    errors = []
    for other in (by_action[told], by_arrival[told]):
        apart = np.minimum(np.abs(reward[told] - reward[other]) / scale, 1.0)
        errors.append(np.where(ended[told] & ended[other], apart, ended[told] != ended[other]))
    better = errors[1] - errors[0]
    return float(better.sum() / max(np.sqrt((better**2).sum()), 1e-300))


def nearest(points: np.ndarray, among: np.ndarray, to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """For each place which of some points, ``among``, is the nearest, but for its own, ``of``; -1 without any."""
    # Takes half a second to import, which is not due before there is something to look at.
    from scipy.spatial import cKDTree

    if len(among) == 0:
        return np.full(len(of), -1)
    _, found = cKDTree(points[among]).query(to, k=[1, 2])
    found = np.append(among, -1)[found]
    chosen: np.ndarray = np.where(found[:, 0] == of, found[:, 1], found[:, 0])
    return chosen
