"""Sums over a target's transitions: how well copies of sources predict them, by target action and source action."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import entry_point, inlined
from sb3_combrel.common.kernels import squared_distance
from sb3_combrel.transfer.prior.copy_predictions import CopyTable, Uses, see_state
from sb3_combrel.transfer.prior.evidence import SMALLEST_ERROR
from sb3_combrel.transfer.source_model import predict_effect, source_arrays

# In parts of a distance.
ROUNDING = 1e-9


class CopySums(NamedTuple):
    """Sums over the target's transitions, by target action, float64.

    "Of copies" is shape (n_copies, n_target_actions, most source actions, n_target_variables).
    """

    n: np.ndarray  # shape (n_target_actions,): transitions
    size: np.ndarray  # shape (n_target_actions, n_target_variables): sizes of effects
    effect: np.ndarray  # same shape: squared effects
    error: np.ndarray  # of copies: squared errors
    gain: np.ndarray  # of copies: evidence, in nats, that they are better than "it stays" (``equations.evidence``)

    @classmethod
    def zero(cls, n_copies: int, n_source_actions: int, n_actions: int, n_variables: int) -> CopySums:
        """Sums over no transitions."""
        of_copies = n_copies, n_actions, n_source_actions, n_variables
        of_variables = n_actions, n_variables
        return cls(np.zeros(n_actions), *(np.zeros(shape) for shape in (of_variables, of_variables, of_copies, of_copies)))

    def excluding(self, copy: Any, action: Any, used: Any) -> CopySums:
        """The same, with the worst there can be for some copies, target actions and source actions; any index of each."""
        gain, error = self.gain.copy(), self.error.copy()
        gain[copy, action, used] = -np.inf
        error[copy, action, used] = np.inf
        return self._replace(gain=gain, error=error)


@inlined
def add_effect(sums, action, effect, scale):
    """Add the effect of a target transition to the sums that do not depend on copies; write squared scales to ``scale``.

    A variable's errors are measured by the mean size of its effects so far.
    """
    sums.n[action] += 1.0
    n = sums.n.sum()
    for v in range(len(effect)):
        sums.size[action, v] += abs(effect[v])
        sums.effect[action, v] += effect[v] * effect[v]
        scale[v] = max(SMALLEST_ERROR, sums.size[:, v].sum() / n) ** 2


@inlined
def add_prediction(sums, at, effect, predicted, scale, weight):
    """Add what a copy predicts of one variable, with data of that weight; ``at``: its place in the sums of copies."""
    error = (effect - predicted) ** 2
    sums.error[at] += error
    sums.gain[at] += weight / (1.0 + weight) * np.log((effect * effect + scale) / (error + scale))


@entry_point
def add_transition(source, table, transition, sums, scratch):
    """Add one target transition (state, action, effect) to the sums, for all copies and source actions; plain tuples.

    :param scratch: work space: a state as a copy has it, and what the source predicts there, shape (n_source_variables,);
        shape (n_target_variables,); the state of the transition before, and how far from it lists of near instances reached,
        shape (n_copies, most source actions), infinite at first
    """
    instances, kernel, fit, away = source_arrays(source)
    table, sums = CopyTable(*table), CopySums(*sums)
    state, action, effect = transition
    at, predicted, scale, last, radius = scratch
    add_effect(sums, action, effect, scale)
    moved = np.sqrt(squared_distance(state, last, instances.periodic, False))
    for v in range(len(state)):
        last[v] = state[v]
    for copy in range(len(table.first)):
        see_state(table, copy, state, at)
        for u in range(table.n_actions[copy]):
            # No state has moved farther as a copy has it than in the target, and no list reaches farther than it did by more.
            farthest = ((radius[copy, u] + moved) * (1.0 + ROUNDING)) ** 2
            of_source = table.first[copy] + u
            length, weight = predict_effect(instances, kernel, fit, away, of_source, at, predicted, farthest)
            radius[copy, u] = np.sqrt(fit.distance[length - 1]) if length > 0 else np.inf
            for v in range(len(state)):
                k = table.variable[copy, v]
                if k >= 0:
                    of_copy = table.sign[copy, v] * predicted[k]
                    add_prediction(sums, (copy, action, u, v), effect[v], of_copy, scale[v], weight)


@entry_point
def add_used(table, uses, transition, sums, scale):
    """Add one target transition to the sums, for what makes up its action alone.

    :param transition: (action, effect, predicted effect, weight of the source's data)
    :param scale: work space, shape (n_target_variables,)
    """
    table, uses, sums = CopyTable(*table), Uses(*uses), CopySums(*sums)
    action, effect, predicted, weight = transition
    add_effect(sums, action, effect, scale)
    for c in range(uses.of_action.shape[1]):
        use = uses.of_action[action, c]
        if use >= 0:
            copy = uses.copy[use]
            u = uses.action[use] - table.first[copy]
            for v in range(len(effect)):
                if table.variable[copy, v] >= 0:
                    add_prediction(sums, (copy, action, u, v), effect[v], predicted[v], scale[v], weight)
