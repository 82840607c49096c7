"""Sums over a target's transitions: how well copies of sources predict them, by target action and source action."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined
from sb3_combrel.transfer.prior.copy_predictions import CopyTable, Uses, see_state
from sb3_combrel.transfer.source_model import predict_source, source_arrays

# The smallest scale that compliance is measured by, squared unit coordinates: a variable that never moves.
SMALLEST_SCALE = 1e-12
# Errors are compared with effects of at least this fraction of a typical one.
LEAST_EFFECT = 0.25
# Squared errors count as at most this many times the squared effect: a bound of 1 would find noise to explain something.
LARGEST_MISS = 2.0


class CopySums(NamedTuple):
    """Sums over the target's transitions, by target action, float64.

    "Of copies" is shape (n_copies, n_target_actions, most source actions).
    """

    n: np.ndarray  # shape (n_target_actions,): transitions
    size: np.ndarray  # shape (n_target_actions, n_target_variables): sizes of effects
    effect: np.ndarray  # same shape: squared effects
    stay: np.ndarray  # same shape: compliances of each variable with "it stays as it is"
    compliance: np.ndarray  # of copies: compliances of each copy
    error: np.ndarray  # of copies, and (n_target_variables,) last: squared errors
    # Same shape: squared errors in parts of the squared effects, each at most LARGEST_MISS, times how much of the threshold
    # the weight of the source's data reaches, at most 1; and, of copies, the sums of these factors.
    unexplained: np.ndarray
    n_covered: np.ndarray

    @classmethod
    def zero(cls, n_copies: int, n_source_actions: int, n_actions: int, n_variables: int) -> CopySums:
        """Sums over no transitions."""
        of_variables, of_copies = (n_actions, n_variables), (n_copies, n_actions, n_source_actions)
        of_both = (*of_copies, n_variables)
        shapes = (n_actions,), of_variables, of_variables, of_variables, of_copies, of_both, of_both, of_copies
        return cls(*map(np.zeros, shapes))

    def excluding(self, copy: Any, action: Any, used: Any) -> CopySums:
        """The same, with the worst there can be for some copies, target actions and source actions; any index of each."""
        compliance, error = self.compliance.copy(), self.error.copy()
        compliance[copy, action, used] = -np.inf
        error[copy, action, used] = np.inf
        return self._replace(compliance=compliance, error=error)


class CopyScratch(NamedTuple):
    """Work space, float64."""

    at: np.ndarray  # shape (n_source_variables,): a state as the copy has it
    effect: np.ndarray  # same shape: what the source predicts there
    scale: np.ndarray  # shape (n_target_variables,): what squared errors are compared with in compliance
    motion: np.ndarray  # same shape: see squared_motion


@inlined
def squared_motion(sums, v):
    """The square of ``LEAST_EFFECT`` of how much a variable moves under the action that moves it most, in the mean."""
    largest = 0.0
    for action in range(len(sums.n)):
        largest = max(largest, sums.size[action, v] / max(1.0, sums.n[action]))
    return (LEAST_EFFECT * largest) ** 2


@inlined
def add_effect(sums, action, effect):
    """Add the effect of a target transition to the sums that do not depend on copies, but for compliances."""
    sums.n[action] += 1.0
    for v in range(len(effect)):
        sums.size[action, v] += abs(effect[v])
        sums.effect[action, v] += effect[v] * effect[v]


@inlined
def add_error(table, sums, at, effect, predicted, covered, motion):
    """Add the error of one variable, ``at`` (copy, target action, source action, target variable), to the sums; its square."""
    copy, action, u, v = at
    error = (effect - predicted) ** 2
    sums.error[copy, action, u, v] += error
    compared = max(effect * effect, min(max(motion, table.least[copy, v]), table.most[copy, v]))
    sums.unexplained[copy, action, u, v] += covered * min(LARGEST_MISS, error / max(compared, 1e-300))
    return error


@compiled
def add_transition(source, table, rules, transition, sums, scratch):
    """Add one target transition (state, action, effect) to the sums: errors and compliances of all copies and source actions.

    The scale of compliance is that of ``equations.running_scales``. The structures are plain tuples.

    :param rules: (whole, see ``Copies.measure``; weight from which on the source has data)
    """
    instances, kernel, fit, away = source_arrays(source)
    table, sums, scratch = CopyTable(*table), CopySums(*sums), CopyScratch(*scratch)
    whole, threshold = rules
    state, action, effect = transition
    n_variables = len(state)
    add_effect(sums, action, effect)
    n = sums.n.sum()
    for v in range(n_variables):
        scratch.scale[v] = max(SMALLEST_SCALE, (sums.size[:, v].sum() / n) ** 2)
        sums.stay[action, v] += np.exp(-effect[v] * effect[v] / scratch.scale[v])
        scratch.motion[v] = squared_motion(sums, v)
    for copy in range(len(table.first)):
        see_state(table, copy, state, scratch.at)
        for u in range(table.n_actions[copy]):
            source_action = table.first[copy] + u
            _, _, weight = predict_source(instances, kernel, fit, away, source_action, scratch.at, scratch.effect)
            covered = min(1.0, weight / threshold)
            sums.n_covered[copy, action, u] += covered
            missed = 0.0
            for v in range(n_variables):
                k = table.variable[copy, v]
                if k >= 0:
                    predicted = table.sign[copy, v] * scratch.effect[k]
                    at = copy, action, u, v
                    error = add_error(table, sums, at, effect[v], predicted, covered, scratch.motion[v])
                    missed += error / scratch.scale[v]
                elif whole:
                    missed += effect[v] * effect[v] / scratch.scale[v]
            sums.compliance[copy, action, u] += np.exp(-missed)


@compiled
def add_used(table, uses, transition, sums):
    """Add one target transition to the sums, with the errors of what makes up its action alone, and no compliances.

    :param transition: (action, effect, predicted effect, weight of the prediction in parts of the threshold, at most 1)
    """
    table, uses, sums = CopyTable(*table), Uses(*uses), CopySums(*sums)
    action, effect, predicted, covered = transition
    add_effect(sums, action, effect)
    for c in range(uses.of_action.shape[1]):
        use = uses.of_action[action, c]
        if use >= 0:
            copy = uses.copy[use]
            u = uses.action[use] - table.first[copy]
            sums.n_covered[copy, action, u] += covered
            for v in range(len(effect)):
                if table.variable[copy, v] >= 0:
                    motion = squared_motion(sums, v)
                    add_error(table, sums, (copy, action, u, v), effect[v], predicted[v], covered, motion)
