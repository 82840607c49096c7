"""Compliance, relevance and the choice of a mapping (Eqs. 1-7 and Algorithm 1 of the COMBREL paper) in plain NumPy.

This is the specification: one function an equation, written to be read and compared with, not to be fast. The compiled
code of this package computes the same.

Index i runs over target transitions, j over source instances; t and m are their numbers, d is the number of target variables.
States are unit coordinates (:class:`~sb3_combrel.common.scaling.StateScaling`), an *effect* is next state minus state, rewards
are raw. Two transitions with different actions are infinitely far apart, so a target transition is compared only with the
source instances whose action its own is mapped to ("only to the target task instances that apply action a", Section 5.1).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

ROUNDING = 1e-12
"""Sums of normalised weights that differ by at most this are taken for equal."""


class Transitions(NamedTuple):
    """Experience of one task: the tuples (s, a, r, s') of the paper, one a row."""

    state: Floats  #: unit coordinates of that task, shape (n, n_variables)
    action: Ints  #: int64, shape (n,)
    effect: Floats  #: s' - s, shape (n, n_variables)
    reward: Floats  #: raw, shape (n,)
    terminated: Bools  #: bool, shape (n,): whether s' is terminal (not by a time limit)

    def with_action(self, action: int) -> "Transitions":
        """Select the transitions with one action, in their order."""
        rows = self.action == action
        return Transitions(*(column[rows] for column in self))


class Bandwidths(NamedTuple):
    """Bandwidths delta of the kernel :func:`phi`, in squared units of the distances: unit coordinates, rewards raw."""

    start: float  #: delta_sa, of the distance between the states where two transitions start
    outcome: float  #: delta_s', of the distance between an outcome and the predicted one
    reward: float  #: delta_r, of the difference of two raw rewards


class VirtualSource(NamedTuple):
    """Source instances of one target action, translated to the target task and seen from t target states.

    A target variable mapped to None has the value of the state from which an instance is seen, and so adds nothing to any
    distance; it is predicted not to change.
    """

    start: Floats  #: where each instance starts, shape (t, m, d)
    effect: Floats  #: s'_j - s_j, shape (m, d); 0 for variables mapped to None
    reward: Floats  #: shape (m,)
    terminated: Bools  #: bool, shape (m,)


class TransferRules(NamedTuple):
    """When the model knows a state-action pair, and which instances count (the parameters of Table 1)."""

    breadth: float  #: b, kernel breadth of transferred instances in unit coordinates
    threshold: float  #: sum of weights from which on a pair is known
    min_weight: float  #: an instance that weighs less does not count
    min_fraction: float  #: nor does one, nearest first, with less than this fraction of the weight before it


def phi(x: Floats, delta: float) -> Floats:
    """Evaluate the Gaussian kernel phi(x) = exp(-x^2 / delta) of Section 2.3.

    :param x: distances, any shape
    :param delta: bandwidth, in squared units of ``x``
    """
    return np.exp(-(x**2) / delta)


def virtual_source(source: Transitions, mapping: InterTaskMapping, action: int, states: Floats) -> VirtualSource:
    """Translate the source instances that ``mapping`` gives to a target action (lines 4-5 of Algorithm 1).

    :param source: in the source's unit coordinates
    :param action: target action
    :param states: target states from which the instances are seen, shape (t, d)
    """
    chosen = source.with_action(mapping.source_action(action))
    return VirtualSource(
        start=mapping.source_to_target(chosen.state, states[:, None, :]),
        effect=mapping.displacement_to_target(chosen.effect),
        reward=chosen.reward,
        terminated=chosen.terminated,
    )


def start_distances(states: Floats, virtual: VirtualSource) -> Floats:
    """Measure d(<s_i, a_i>, <s_j, a_j>) of transitions with the same action, over the mapped variables, shape (t, m)."""
    return np.linalg.norm(states[:, None, :] - virtual.start, axis=2)


def normalized_weights(distances: Floats, delta: float, axis: int = 1) -> Floats:
    """Compute w_ij of Eq. 2: the kernel of the distance, normalised over the source instances j.

    :param distances: of where transitions and instances start, shape (t, m)
    :param axis: over which the weights add up to 1: 1 for the source instances (compliance), 0 for the target
        transitions (w_ji, relevance)
    :return: shape (t, m); 0 where all kernels are 0 to machine precision
    """
    kernels = phi(distances, delta)
    total = kernels.sum(axis=axis, keepdims=True)
    return np.divide(kernels, total, out=np.zeros_like(kernels), where=total > 0.0)


def transition_compliances(weights: Floats, effects: Floats, virtual: VirtualSource, delta: float) -> Floats:
    """Compute lambda^P_ij = w_ij phi(d(s'_i, s_i + (s'_j - s_j))), Eq. 2, shape (t, m).

    The distance between the outcome and the predicted one is that between the two effects.

    :param effects: s'_i - s_i of the target transitions, shape (t, d)
    """
    return weights * phi(np.linalg.norm(effects[:, None, :] - virtual.effect, axis=2), delta)


def reward_compliances(weights: Floats, rewards: Floats, virtual: VirtualSource, delta: float) -> Floats:
    """Compute ``lambda^R_ij = w_ij phi(|r_i - r_j|)``, the formula below Eq. 2, shape (t, m); ``rewards``: r_i, shape (t,)."""
    return weights * phi(np.abs(rewards[:, None] - virtual.reward), delta)


def compliance(of_transitions: Floats, of_rewards: Floats, axis: int = 1) -> Floats:
    """Compute lambda_i = (sum_j lambda^P_ij) (sum_j lambda^R_ij), Eqs. 1, 3 and 5 without Z^P and Z^R.

    Each sum is a mean weighted by w_ij, so a transition that the instances predict perfectly has 1. Z^P and Z^R, which all
    mappings must share, do not change which one is best; of each mapping on its own they would erase all differences.

    :param of_transitions: lambda^P_ij, shape (t, m); ``of_rewards``: lambda^R_ij, same shape
    :param axis: 1 to sum over source instances; 0 to sum over target transitions, for lambda_{T,sigma_j} of Eq. 7
    :return: values in [0, 1], shape (t,), or (m,) for ``axis=0``
    """
    return of_transitions.sum(axis=axis) * of_rewards.sum(axis=axis)


def sample_compliance(
    transitions: Transitions, source: Transitions, mapping: InterTaskMapping, bandwidths: Bandwidths, min_evidence: float = 0.0
) -> Floats:
    """Compute the compliance of each target transition with one virtual source task (Eq. 5; lines 9-13 of Algorithm 1).

    :param transitions: target sample, with any actions
    :param min_evidence: a transition for which sum_j phi(d_ij) with delta_sa is less has compliance 0: since weights are
        normalised, an instance far away would look as good as one near by. 0 is the paper
    :return: values in [0, 1], shape (t,)
    """
    found = np.zeros(len(transitions.reward))
    for action in np.unique(transitions.action):
        rows = transitions.action == action
        states, _, effects, rewards, _ = transitions.with_action(action)
        virtual = virtual_source(source, mapping, action, states)
        distances = start_distances(states, virtual)
        weights = normalized_weights(distances, bandwidths.start)
        of_transitions = transition_compliances(weights, effects, virtual, bandwidths.outcome)
        of_rewards = reward_compliances(weights, rewards, virtual, bandwidths.reward)
        evidence = phi(distances, bandwidths.start).sum(axis=1)
        found[rows] = np.where(evidence < min_evidence, 0.0, compliance(of_transitions, of_rewards))
    return found


def task_compliance(compliances: Floats, prior: float = 1.0) -> float:
    """Compute Lambda_X = (1 / t) sum_i lambda_{X,i} P(S_X), the compliance of the whole target sample (Eq. 6).

    :param compliances: :func:`sample_compliance` with one mapping, shape (t,), t > 0
    :param prior: P(S_X); 1 where all mappings are equally likely, and it would be a common factor
    """
    return float(compliances.mean() * prior)


def average_distance(distances: Floats, weights: Floats, mu: float) -> float:
    """Compute d_j of Eq. 4: the mean distance from a source instance to the h_j nearest target transitions.

    h_j is the largest number of transitions, nearest first, whose weights w_ji add up to less than mu; at least 1.

    :param distances: from the instance to the transitions, shape (t,), t > 0
    :param weights: w_ji, adding up to 1 over the transitions, same shape
    :raises ValueError: if ``mu`` is outside (0, 1]
    """
    if not 0.0 < mu <= 1.0:
        raise ValueError(f"mu must be above 0 and at most 1, got {mu!r}")
    nearest_first = np.argsort(distances, kind="stable")
    # Without the margin rounding would decide, for mu = 1, whether the farthest transition counts.
    n_below = int(np.sum(np.cumsum(weights[nearest_first]) < mu - ROUNDING))
    return float(distances[nearest_first[: max(n_below, 1)]].mean())


def relevance(with_target: float, distance: float) -> float:
    """Compute rho_j = exp(-((lambda_{T,sigma_j} - 1) / d_j)^2), Eq. 7.

    :param with_target: lambda_{T,sigma_j}; ``distance``: d_j
    :return: value in [0, 1]; for d_j = 0 the limit: 1 at perfect compliance, 0 otherwise
    """
    off, distance = float(with_target) - 1.0, float(distance)
    if abs(off) <= ROUNDING or distance == 0.0:
        return 1.0 if abs(off) <= ROUNDING else 0.0
    return math.exp(-(off / distance) * (off / distance))


def near_relevances(with_target: Floats, evidence: Floats) -> Floats:
    """Compute a relevance that does not favour distant instances (no equation; the paper names it as future work).

    rho_j = (e_j lambda_j + mean) / (e_j + 1), where mean = sum_j e_j lambda_j / sum_j e_j.

    Eq. 7 tends to 1 with the distance d_j whatever the compliance is. Here distance is lack of evidence and nothing else: the
    compliance of an instance is estimated from evidence e_j and the mean of all instances, which counts as one transition. So
    one without near transitions comes after those that are borne out and before those that are contradicted.

    :param with_target: lambda_{T,sigma_j}, shape (m,)
    :param evidence: e_j = sum_i phi(d_ij) with delta_sa, the weights w_ji before they are normalised, same shape
    :return: values in [0, 1], same shape; 1 for all where there is no evidence at all
    """
    total = evidence.sum()
    mean = (evidence * with_target).sum() / total if total > 0.0 else 1.0
    return (evidence * with_target + mean) / (evidence + 1.0)


def instance_compliances(
    source: Transitions, mapping: InterTaskMapping, action: int, transitions: Transitions, bandwidths: Bandwidths
) -> tuple[Floats, Floats, Floats]:
    """Compute d_ij and w_ji, shape (t, m), and lambda_{T,sigma_j}, shape (m,), of one target action's instances, for Eq. 7."""
    states, _, effects, rewards, _ = transitions.with_action(action)
    virtual = virtual_source(source, mapping, action, states)
    distances = start_distances(states, virtual)
    weights = normalized_weights(distances, bandwidths.start, axis=0)
    of_transitions = transition_compliances(weights, effects, virtual, bandwidths.outcome)
    of_rewards = reward_compliances(weights, rewards, virtual, bandwidths.reward)
    return distances, weights, compliance(of_transitions, of_rewards, axis=0)


def source_near_relevances(
    source: Transitions, mapping: InterTaskMapping, action: int, transitions: Transitions, bandwidths: Bandwidths
) -> Floats:
    """Compute :func:`near_relevances` of the source instances of one target action (see :func:`source_relevances`)."""
    distances, _, compliances = instance_compliances(source, mapping, action, transitions, bandwidths)
    return near_relevances(compliances, phi(distances, bandwidths.start).sum(axis=0))


def source_relevances(
    source: Transitions, mapping: InterTaskMapping, action: int, transitions: Transitions, bandwidths: Bandwidths, mu: float
) -> Floats:
    """Compute the relevance of the source instances of one target action to the target sample (Eq. 7; line 21).

    :param transitions: target sample; only its transitions with ``action`` count
    :param mu: see :func:`average_distance`
    :return: values in [0, 1], in the order of the instances of :func:`virtual_source`, shape (m,). An instance without a
        near transition (all kernels 0 to machine precision) has 1: there is no evidence against its transfer
    """
    distances, weights, compliances = instance_compliances(source, mapping, action, transitions, bandwidths)
    found = np.ones(len(compliances))
    for j in np.flatnonzero(weights.sum(axis=0) > 0.0):
        found[j] = relevance(compliances[j], average_distance(distances[:, j], weights[:, j], mu))
    return found


def nearest_transitions(
    state: Floats, action: int, transitions: Transitions, n_neighbors: int, action_distance: float = np.inf
) -> Ints:
    """Find the k target transitions nearest to a state and action (line 17 of Algorithm 1).

    :param n_neighbors: k
    :param action_distance: distance between two different actions, in unit coordinates. Infinity: only transitions with
        the same action are neighbours, and of an action mapping only this action matters. Finite: mappings that differ in
        other actions differ here too, as in Table 2
    :return: rows of ``transitions``, the nearest first, at most k
    """
    apart = np.where(transitions.action == action, 0.0, action_distance)
    distances = np.hypot(np.linalg.norm(transitions.state - state, axis=1), apart)
    order = np.argsort(distances, kind="stable")
    return order[np.isfinite(distances[order])][:n_neighbors]


def best_mapping(compliances: Floats, baseline: float = 0.0) -> int | None:
    """Choose the mapping with the highest mean compliance (lines 19-20 of Algorithm 1).

    :param compliances: of the k nearest transitions with every mapping, shape (k, n_mappings)
    :param baseline: what the mean must exceed; 0 is the paper, but that a mapping without any evidence is not chosen
    :return: the mapping's column, of equal ones the first; None if there is no transition, or no mean above ``baseline``
    """
    if not len(compliances):
        return None
    mean = compliances.mean(axis=0)
    best = int(np.argmax(mean))
    return best if mean[best] > baseline else None


def transferred_instances(
    state: Floats,
    own_weight: float,
    virtual: VirtualSource,
    rules: TransferRules,
    relevances: Sequence[float] | None = None,
    times_weight: bool = False,
) -> tuple[Ints, Floats]:
    """Choose the translated instances that complete the model at a state and action (lines 16, 18, 21 and 22).

    They are added in the order of their relevance or, without it, of their distance (as in TIMBREL), until their weights
    exp(-d^2 / b^2) and the weight of the target's own instances reach the threshold. If they cannot, nothing is transferred.

    :param state: unit coordinates, shape (d,)
    :param own_weight: sum of the weights of the target's own instances there
    :param virtual: instances seen from this state alone, ``start`` of shape (1, m, d); of several mappings for TIMBREL's pool
    :param relevances: shape (m,), or None for the order of distance, the only one to which ``min_fraction`` applies
    :param times_weight: in the order of relevance times weight, for :func:`near_relevances`
    :return: numbers of the instances, in the order in which they are added, int64, and their weights, same shape
    """
    [weights] = phi(start_distances(state[None, :], virtual), rules.breadth**2)
    ranks = weights if relevances is None else np.asarray(relevances) * (weights if times_weight else 1.0)
    order = np.argsort(-ranks, kind="stable")
    chosen: list[int] = []
    total = own_weight
    for j in order[weights[order] >= rules.min_weight]:
        if total >= rules.threshold or (relevances is None and weights[j] < rules.min_fraction * total):
            break
        chosen.append(int(j))
        total += weights[j]
    numbers = np.array(chosen if total >= rules.threshold else [], dtype=np.int64)
    return numbers, weights[numbers]


def prediction_compliances(effects: Floats, predicted: Floats, scales: Floats) -> Floats:
    """Compute the compliance of target transitions with what a source's model predicts of them through one mapping.

    The outcome's factor of Eq. 2, with one prediction in place of a weighted mean over instances, and a scale for each
    variable. A product over variables, it factorises over the copies of a factored mapping.

    :param effects: s'_i - s_i, shape (t, d), of the variables that count; ``predicted`` and ``scales``: the same shape
    :return: values in [0, 1], shape (t,); 1 where all is predicted exactly
    """
    return np.exp(-((effects - predicted) ** 2 / scales).sum(axis=1))


def running_scales(effects: Floats, smallest: float) -> Floats:
    """Compute what errors are measured by when the source's own model is judged (``use="prior"``; no equation).

    Of each variable the mean size of its effects so far. A root mean square would be that of a few large ones.

    :param effects: of the target's transitions, in the order in which they came, shape (t, d); so is what is returned
    :param smallest: the least scale
    """
    so_far = np.cumsum(np.abs(effects), axis=0) / np.arange(1, len(effects) + 1)[:, None]
    return np.maximum(so_far, smallest)


def evidence(effects: Floats, predicted: Floats, scales: Floats, weights: Floats) -> Floats:
    """Compute the evidence, in nats, that a prediction of target transitions is better than "nothing changes".

    The logarithm of the ratio of two densities, Student's t with one degree of freedom, of errors in parts of their scale: one
    that nothing foresaw, as at a wall, does not decide. A transition counts by w / (1 + w), where w is the weight of the
    source's data there. What compliance is in the form of a kernel, Eqs. 2 to 5, with one prediction in place of a weighted
    mean over instances; it factorises over variables.

    :param effects: s'_i - s_i, shape (t, d); ``predicted`` and ``scales``, see :func:`running_scales`: the same shape
    :param weights: shape (t,)
    :return: of each transition and variable, shape (t, d)
    """
    ratio = (effects**2 + scales**2) / ((effects - predicted) ** 2 + scales**2)
    return (weights / (1.0 + weights))[:, None] * np.log(ratio)


def foretold_ends(ends: Floats, weights: Floats, rate: float) -> Floats:
    """Compute how probable a source makes it that transitions end an episode.

    The mean of the beta distribution that starts out worth one transition and is as high as the source's rate of ends.

    :param ends: share of the source's instances near each transition that ended, shape (t,); ``weights``: of them, shape (t,)
    :param rate: share of all the source's instances that ended
    """
    return (weights * ends + rate) / (weights + 1.0)


def ends_evidence(ended: Bools, foretold: Floats) -> float:
    """Compute the logarithm of how probable it was that of t transitions those ended an episode that did, and no others.

    :param ended: shape (t,); ``foretold``: how probable it was of each, shape (t,), neither 0 nor 1
    """
    return float(np.log(np.where(ended, foretold, 1.0 - foretold)).sum())


def rewards_evidence(rewards: Floats, foretold: Floats, weights: Floats) -> float:
    """Compute the logarithm of how probable rewards were, up to a constant, under Student's t with one degree of freedom.

    Its scale is the mean size of the rewards, so that other rewards are told apart, and small differences are not.

    :param rewards: of t transitions, shape (t,); ``foretold``: by a source; ``weights``: of its data there, the same
    """
    errors = (rewards - foretold) / max(float(np.abs(rewards).mean()), 1e-9)
    return float(-(weights / (1.0 + weights) * np.log1p(errors**2)).sum())


def division_evidence(of_copies: Sequence[Floats], actions: Ints, n_source_actions: Sequence[int], n_copies: int) -> float:
    """Compute the evidence for a division of the target's variables into copies of the source, against "all of them stay".

    All copies are as probable beforehand, and so are all source actions for each target action that was taken: a further copy
    must be worth what it adds to choose from.

    :param of_copies: of each copy, with its best source action for each target action, :func:`evidence`, shape (t, d)
    :param actions: target action of each transition, shape (t,)
    :param n_source_actions: of each copy; ``n_copies``: among so many they were chosen
    """
    prior = sum(np.log(n_copies) + len(np.unique(actions)) * np.log(n) for n in n_source_actions)
    return float(sum(each.sum() for each in of_copies) - prior)
