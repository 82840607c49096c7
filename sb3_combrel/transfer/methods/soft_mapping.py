"""Stochastic mappings of target to source states: their parameters, fitted by gradient descent, and what they predict."""

from __future__ import annotations

from itertools import permutations, product
from math import perm
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_combrel.transfer.prior.copies import Predicted, distinct_rows
from sb3_combrel.transfer.source_model import SourceModel

LOGIT_DEVIATION = 3.0  # logits have a normal prior of this standard deviation: a few transitions do not make anything certain
N_STEPS, STEP_SIZE = 200, 0.1
NOTHING = -1
BATCH = 4096  # pairs that are predicted at once


class Readings(NamedTuple):
    """Deterministic mappings: each source variable reads a target variable of its own, or none (its mean)."""

    variable: np.ndarray  # int64, shape (n_mappings, n_source_variables): target variable that is read, -1 for none
    sign: np.ndarray  # float64, same shape: -1 where it is mirrored
    number: np.ndarray  # int64, same shape: column of the logits; of a mirrored variable, n_target_variables further on


def count_mappings(n_source: int, n_target: int, mirrored: bool) -> int:
    """Return how many mappings :func:`all_readings` lists."""
    n_read = min(n_source, n_target)
    return perm(max(n_source, n_target), n_read) * (2**n_read if mirrored else 1)


def all_readings(n_source: int, n_target: int, mirrored: bool) -> Readings:
    """List the deterministic mappings of states; ``mirrored``: target variables may be read mirrored as well."""
    orders = sorted(set(permutations([*range(n_target), *([NOTHING] * max(0, n_source - n_target))], n_source)))
    choices = [[(1.0, -1.0) if mirrored and v != NOTHING else (1.0,) for v in order] for order in orders]
    rows = [(order, signs) for order, each in zip(orders, choices, strict=True) for signs in product(*each)]
    variable = np.array([order for order, _ in rows], dtype=np.int64)
    sign = np.array([signs for _, signs in rows], dtype=np.float64)
    number = np.where(sign < 0.0, variable + n_target, variable)
    number[variable == NOTHING] = n_target * (2 if mirrored else 1)
    return Readings(variable, sign, number)


def to_source(states: np.ndarray, readings: Readings, mapping: np.ndarray | int, mean: np.ndarray) -> np.ndarray:
    """Return target states as mappings (one, or one of each) have them in the source; what reads nothing is at ``mean``."""
    variable, sign = (np.broadcast_to(array[mapping], (len(states), len(mean))) for array in readings[:2])
    read = np.take_along_axis(states, np.maximum(variable, 0), axis=1)
    return np.where(variable == NOTHING, mean, np.where(sign < 0.0, 1.0 - read, read))


def to_target(effects: np.ndarray, readings: Readings, mapping: np.ndarray | int, n_target: int) -> np.ndarray:
    """Return the source's effects in target coordinates, shape (n, n_target); 0 for variables that are not read."""
    variable, sign = readings.variable[mapping], readings.sign[mapping]
    return np.column_stack([np.where(variable == v, sign * effects, 0.0).sum(axis=-1) for v in range(n_target)])


class Logits(NamedTuple):
    """Parameters of several stochastic mappings that together make up a target task, one for each copy of the source."""

    state: np.ndarray  # float64, shape (n_copies, n_source_variables, n_readings): softmax over what is read
    action: np.ndarray  # float64, shape (n_copies, n_target_actions, n_source_actions): softmax over source actions


def probabilities(logits: Logits, readings: Readings) -> tuple[np.ndarray, np.ndarray]:
    """Return probabilities of mappings, shape (n_copies, n_mappings), products over their readings, and of source actions."""
    state, action = _log_probabilities(th.from_numpy(logits.state), th.from_numpy(logits.action), readings.number)
    return state.exp().numpy(), action.exp().numpy()


def _log_probabilities(state: th.Tensor, action: th.Tensor, number: np.ndarray) -> tuple[th.Tensor, th.Tensor]:
    each = [state[..., k, :][..., th.from_numpy(column)] for k, column in enumerate(number.T)]
    return th.log_softmax(th.stack(each).sum(dim=0), dim=-1), th.log_softmax(action, dim=-1)


class FitData(NamedTuple):
    """Target transitions, actions and effects, and what every deterministic mapping predicts of them."""

    predicted: np.ndarray  # effects, float64, shape (n, n_mappings, n_source_actions, n_target_variables)
    action: np.ndarray
    effect: np.ndarray
    scale: np.ndarray  # float64, shape (n_target_variables,), above 0: errors are measured in it


def loss(state: th.Tensor, action: th.Tensor, readings: Readings, data: FitData) -> th.Tensor:
    """Compute the error of mixtures, to be minimised, shape (n_starts,); differentiable.

    Of a transition, the sum over variables of sqrt(1 + (error / scale)^2) - 1, so that a few large effects do not decide
    alone. Added is the negative logarithm of the logits' normal prior. Logits have one axis more, the starts, in front.
    """
    of_mapping, of_action = (each.exp() for each in _log_probabilities(state, action, readings.number))
    n, m, b, d = data.predicted.shape
    by_mapping = th.from_numpy(np.ascontiguousarray(data.predicted.transpose(0, 2, 3, 1)).reshape(n * b * d, m))
    s, c = of_mapping.shape[:2]
    mixed = (by_mapping @ of_mapping.reshape(s * c, m).T).reshape(n, b, d, s, c)
    mean = th.einsum("nbdsc,scnb->snd", mixed, of_action[:, :, th.from_numpy(data.action)])
    error = (mean - th.from_numpy(data.effect)) / th.from_numpy(data.scale)
    squares = (state**2).sum(dim=(1, 2, 3)) + (action**2).sum(dim=(1, 2, 3))
    return (th.sqrt(1.0 + error**2) - 1.0).sum(dim=(1, 2)) + squares / (2.0 * LOGIT_DEVIATION**2)


def fit(before: Logits | None, shape: Logits, readings: Readings, data: FitData, n_starts: int, seed: int) -> Logits:
    """Fit the parameters (like ``shape``) by Adam from ``n_starts`` random starts and those of ``before``; return the best."""
    generator = th.Generator().manual_seed(seed)
    starts = []
    for k, like in enumerate(shape):
        drawn = th.randn((n_starts, *like.shape), generator=generator, dtype=th.float64)
        kept = [] if before is None else [th.from_numpy(before[k].copy())[None]]
        starts.append(th.cat([*kept, drawn]).requires_grad_())
    optimizer = th.optim.Adam(starts, lr=STEP_SIZE)
    for _ in range(N_STEPS):
        optimizer.zero_grad()
        loss(starts[0], starts[1], readings, data).sum().backward()
        optimizer.step()
    with th.no_grad():
        best = int(loss(starts[0], starts[1], readings, data).argmin())
    return Logits(*(found[best].detach().numpy().copy() for found in starts))


class Terms(NamedTuple):
    """The most probable parts of the mixture, listed by target action and copy."""

    first: np.ndarray  # int64, shape (n_target_actions + 1,): those of action a are first[a] to first[a + 1]
    copy: np.ndarray  # int64, shape (n_terms,), as the next two
    mapping: np.ndarray  # row of Readings
    action: np.ndarray  # of the source
    share: np.ndarray  # float64, same shape: probability; those of a copy under an action add up to 1


def most_probable(of_mapping: np.ndarray, of_action: np.ndarray, max_terms: int, mass: float) -> Terms:
    """List a copy's parts under an action by falling probability, until they have ``mass`` together or are ``max_terms``."""
    first, rows = [0], []
    for a in range(of_action.shape[1]):
        for c, (mappings, actions) in enumerate(zip(of_mapping, of_action[:, a], strict=True)):
            joint = np.outer(mappings, actions)
            order = np.argsort(-joint, axis=None, kind="stable")[:max_terms]
            share = joint.ravel()[order]
            n = 1 + int(np.searchsorted(np.cumsum(share), mass))
            share = share[:n] / share[:n].sum()
            rows += [(c, *np.unravel_index(i, joint.shape), p) for i, p in zip(order[:n], share, strict=True)]
        first.append(len(rows))
    copy, mapping, action = (np.array([row[k] for row in rows], dtype=np.int64) for k in range(3))
    return Terms(np.array(first, dtype=np.int64), copy, mapping, action, np.array([row[3] for row in rows]))


class MixturePredictions:
    """Predicts by the mean over a mixture: of copies the sum of effects, mean reward, least weight."""

    terms: Terms

    def __init__(self, model: SourceModel, readings: Readings, mean: np.ndarray):
        self.model, self.readings, self.mean = model, readings, mean

    def set_terms(self, terms: Terms) -> None:
        """Use this mixture from now on."""
        self.terms = terms
        self.n_copies = 1 + int(terms.copy.max())

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """Return effects, shape (n, n_target_variables); rewards and weights, shape (n,)."""
        n, d = states.shape
        found = np.zeros((n, d)), np.zeros(n), np.zeros(n)
        for first in range(0, n, BATCH):
            rows = slice(first, first + BATCH)
            for array, part in zip(found, self._predict_some(states[rows], actions[rows]), strict=True):
                array[rows] = part
        return found

    def predict_each(self, states: np.ndarray) -> np.ndarray:
        """Return what each mapping with each source action predicts, shape as of :attr:`FitData.predicted`."""
        n, m, d = len(states), len(self.readings.variable), states.shape[1]
        mapping = np.tile(np.arange(m), n)
        at = to_source(np.repeat(states, m, axis=0), self.readings, mapping, self.mean)
        found = np.empty((n, m, len(self.model.instances.size), d))
        for b in range(found.shape[2]):
            effects = self.model.predict(at, np.full(len(at), b, dtype=np.int64)).effect
            found[:, :, b] = to_target(effects, self.readings, mapping, d).reshape(n, m, d)
        return found

    def _predict_some(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        terms, (n, d) = self.terms, states.shape
        count = np.diff(terms.first)[actions]
        row = np.repeat(np.arange(n), count)
        term = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(terms.first[actions], count)
        mapping, share, place = terms.mapping[term], terms.share[term], row * self.n_copies + terms.copy[term]
        at, action = to_source(states[row], self.readings, mapping, self.mean), terms.action[term]
        # Many states of the target are one state of the source, which is predicted once.
        chosen, kind = distinct_rows(np.column_stack([at, action]))
        predicted = self.model.predict(at[chosen], action[chosen])
        effects = share[:, None] * to_target(predicted.effect[kind], self.readings, mapping, d)
        effect = np.column_stack([np.bincount(row, effects[:, v], n) for v in range(d)])
        outcomes = predicted.reward[kind], predicted.weight[kind]
        reward, weight = (np.bincount(place, share * each, n * self.n_copies).reshape(n, -1) for each in outcomes)
        return effect, reward.mean(axis=1), weight.min(axis=1)
