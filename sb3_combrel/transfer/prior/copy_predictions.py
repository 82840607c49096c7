"""Compiled predictions of target states and actions by copies of sources."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inlined
from sb3_combrel.transfer.source_model import predict_source, source_arrays


class CopyTable(NamedTuple):
    """Copies of sources for compiled code, one a row."""

    variable: np.ndarray  # int64, shape (n_copies, n_target_variables): source variable that a target variable is, -1: none
    sign: np.ndarray  # float64, same shape: -1 where it is mirrored
    share: np.ndarray  # float64, shape (n_copies, n_source_variables): 1 / number of target variables that it has
    first: np.ndarray  # int64, shape (n_copies,): the model's number of the source's first action
    n_actions: np.ndarray  # int64, same shape


class Uses(NamedTuple):
    """The copies and source actions that make up each target action, each pair of them once."""

    copy: np.ndarray  # int64, shape (n_uses,)
    action: np.ndarray  # int64, same shape: the model's number of the source action
    of_action: np.ndarray  # int64, shape (n_target_actions, most copies): uses of each target action, -1 for none
    complete: np.ndarray  # bool, shape (n_target_actions,): whether every copy of the action has a source action


class UsePredictions(NamedTuple):
    """What each use predicts at one state: work space of :func:`predict_pairs`."""

    done: np.ndarray  # bool, shape (n_uses,)
    effect: np.ndarray  # float64, shape (n_uses + 1, n_source_variables): the last row is for a state as a copy has it
    outcome: np.ndarray  # float64, shape (n_uses + 1, 2): reward, weight


@inlined
def see_state(table, copy, state, at):
    """Write to ``at`` a target state as ``copy`` has it: the mean where several target variables are one of its own."""
    at[:] = 0.0
    for v in range(len(state)):
        k = table.variable[copy, v]
        if k >= 0:
            at[k] += table.share[copy, k] * (1.0 - state[v] if table.sign[copy, v] < 0.0 else state[v])


@compiled
def predict_pairs(source, table, uses, pairs, predicted, found):
    """Predict target states and actions, ``pairs``, see :func:`join_copies`; the structures are plain tuples."""
    instances, kernel, fit, away = source_arrays(source)
    table, uses, found = CopyTable(*table), Uses(*uses), UsePredictions(*found)
    states, actions = pairs
    at = found.effect[len(uses.copy)]
    before = 0
    found.done[:] = False
    for i in range(len(actions)):
        for v in range(states.shape[1]):
            if states[i, v] != states[before, v]:
                found.done[:] = False
        before = i
        for c in range(uses.of_action.shape[1]):
            use = uses.of_action[actions[i], c]
            if use >= 0 and not found.done[use]:
                copy = uses.copy[use]
                see_state(table, copy, states[i], at)
                effect, outcome = found.effect[use], found.outcome[use]
                outcome[0], _, outcome[1] = predict_source(instances, kernel, fit, away, uses.action[use], at, effect)
                found.done[use] = True
        join_copies(table, uses, actions[i], i, found.effect, found.outcome, predicted)


@inlined
def join_copies(table, uses, action, i, effects, outcomes, predicted):
    """Write to ``predicted``, see ``Copies.predict``, what all copies predict of pair ``i``; the others: of each use."""
    effect, reward, weight = predicted
    effect[i, :] = 0.0
    n = 0
    total = 0.0
    least = np.inf
    for c in range(uses.of_action.shape[1]):
        use = uses.of_action[action, c]
        if use < 0:
            continue
        n += 1
        total += outcomes[use, 0]
        least = min(least, outcomes[use, 1])
        for v in range(effect.shape[1]):
            k = table.variable[uses.copy[use], v]
            if k >= 0:
                effect[i, v] = table.sign[uses.copy[use], v] * effects[use, k]
    reward[i] = total / n if n > 0 else 0.0
    weight[i] = least if n > 0 and uses.complete[action] else 0.0


@compiled
def join_many(table, uses, actions, found, predicted):
    """:func:`join_copies` for many pairs.

    :param found: of each use and pair the number of its prediction, int64, shape (n_uses, n); effects and outcomes of these,
        shape (n_predictions, ...); and room for those of one pair
    """
    table, uses = CopyTable(*table), Uses(*uses)
    rows, effects, outcomes, effect_here, outcome_here = found
    for i in range(len(actions)):
        for c in range(uses.of_action.shape[1]):
            use = uses.of_action[actions[i], c]
            if use >= 0:
                row = rows[use, i]
                for k in range(effects.shape[1]):
                    effect_here[use, k] = effects[row, k]
                for k in range(2):
                    outcome_here[use, k] = outcomes[row, k]
        join_copies(table, uses, actions[i], i, effect_here, outcome_here, predicted)
