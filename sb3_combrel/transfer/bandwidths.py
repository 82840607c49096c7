"""Kernel bandwidths of compliance and relevance, chosen from a source's instances."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.instances import Instances
from sb3_combrel.transfer.candidates import Candidates

# So many instances are to share in a prediction, typically.
N_SHARING = 20


class Bandwidths(NamedTuple):
    """
    Bandwidths delta of phi(x) = exp(-x^2 / delta), in unit coordinates (reward: raw).

    :param start: of the distance between the states where two transitions start (delta_sa)
    :param outcome: of the distance between outcomes (delta_s')
    :param reward: of the difference of rewards (delta_r)
    """

    start: float
    outcome: float
    reward: float


def default_bandwidths(source: Instances) -> Bandwidths:
    """
    Choose bandwidths from a source's instances.

    The start bandwidth is the squared distance to about the 20th instance of the same action (their median): that many
    share in the prediction. The outcome bandwidth is the mean squared effect: an outcome missed by as much as things
    usually move counts as 1/e. The reward bandwidth is the rewards' variance; 1 where they are all alike.
    """
    from scipy.spatial import cKDTree

    distances, effects, rewards = [], [], []
    for action, n in enumerate(source.size):
        if n > 1:
            states = source.state[action, :n]
            nth = min(N_SHARING, n - 1) + 1
            distances.append(cKDTree(states).query(states, k=[nth])[0].ravel())
        effects.append((source.effect[action, :n] ** 2).sum(axis=1))
        rewards.append(source.reward[action, :n])
    start = float(np.median(np.concatenate(distances))) ** 2 if distances else 0.02
    variance = float(np.concatenate(rewards).var())
    return Bandwidths(
        start=max(start, 1e-6),
        outcome=max(float(np.concatenate(effects).mean()), 1e-9),
        reward=variance if variance > 1e-12 else 1.0,
    )


def start_bandwidths(candidates: Candidates, start: float) -> np.ndarray:
    """
    Choose the start bandwidth of every state mapping, by the variables that it compares.

    A distance over three or four variables is longer than one over two, so with the same bandwidth a mapping of more
    variables would have less evidence, for no other reason. ``start`` is for mappings that use every source variable once;
    others get as many times more or less as their squared distance to the 20th instance is (the median again). Distances
    are from states that are like the target's: a variable that is used once more varies independently of the others, so it
    is taken from another of the source's instances.

    :param candidates: the candidates, with all state mappings
    :param start: start bandwidth for mappings that use every source variable once
    :return: float64, shape (n_state_mappings,)
    """
    found, row, action = np.full(len(candidates.table.variable), start), 0, 0
    for source, mappings in zip(candidates.sources, candidates.sets, strict=True):
        actions = range(action, action + source.n_actions)
        states = [candidates.instances.state[a, : candidates.instances.size[a]] for a in actions]
        usual = _squared_distance(states, (1,) * source.n_variables)
        ratios: dict[tuple[int, ...], float] = {}
        for index in mappings.state_mappings:
            counts = tuple(np.bincount(index[index >= 0], minlength=source.n_variables).tolist())
            if counts not in ratios:
                ratios[counts] = _squared_distance(states, counts) / usual if usual > 0.0 and set(counts) != {1} else 1.0
            # Instances that are all alike in the variables compared have no distance.
            found[row] = max(start * ratios[counts], 1e-6)
            row += 1
        action += source.n_actions
    return found


def _squared_distance(states: list[np.ndarray], counts: tuple[int, ...]) -> float:
    """
    Return the median squared distance to the 20th instance of the same action; 0 if no action has two.

    :param states: states of the instances of each action
    :param counts: how often each source variable is used
    """
    from scipy.spatial import cKDTree

    columns = np.repeat(np.arange(len(counts)), counts)
    copy = np.concatenate([np.arange(n) for n in counts])
    rng = np.random.default_rng(0)
    distances = []
    for of_action in states:
        n = len(of_action)
        if n > 1:
            others = [np.arange(n), *(rng.permutation(n) for _ in range(1, max(counts)))]
            queries = np.column_stack([of_action[others[c], k] for k, c in zip(columns, copy, strict=True)])
            # With repeated variables no instance is at a distance of 0; without, each is its own nearest.
            nth = min(N_SHARING, n - 1) + (max(counts) == 1)
            distances.append(cKDTree(of_action[:, columns]).query(queries, k=[nth])[0].ravel())
    return float(np.median(np.concatenate(distances))) ** 2 if distances else 0.0
