"""Compiled predictions of target states and actions by copies of sources."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import entry_point, inlined
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


@inlined
def see_state(table, copy, state, at):
    """Write to ``at`` a target state as ``copy`` has it: the mean where several target variables are one of its own."""
    at[:] = 0.0
    for v in range(len(state)):
        k = table.variable[copy, v]
        if k >= 0:
            at[k] += table.share[copy, k] * (1.0 - state[v] if table.sign[copy, v] < 0.0 else state[v])


@entry_point
def predict_pairs(source, table, uses, pairs, predicted, scratch):
    """Predict target states and actions, ``pairs``, see :func:`join_copies`; the structures are plain tuples.

    :param scratch: work space: a state as a copy has it; of each use its number, whether it has predicted the present state,
        and what: effects, shape (n_uses, n_source_variables), rewards and weights, shape (n_uses, 2)
    """
    instances, kernel, fit, away = source_arrays(source)
    table, uses = CopyTable(*table), Uses(*uses)
    states, actions = pairs
    at, row, done, effects, outcomes = scratch
    before = 0
    done[:] = False
    for i in range(len(actions)):
        for v in range(states.shape[1]):
            if states[i, v] != states[before, v]:
                done[:] = False
        before = i
        for c in range(uses.of_action.shape[1]):
            use = uses.of_action[actions[i], c]
            if use >= 0 and not done[use]:
                see_state(table, uses.copy[use], states[i], at)
                found = predict_source(instances, kernel, fit, away, uses.action[use], at, effects[use])
                outcomes[use, 0], _, outcomes[use, 1] = found
                done[use] = True
        join_copies(table, uses, actions[i], i, row, effects, outcomes, predicted)


@inlined
def join_copies(table, uses, action, i, row, effects, outcomes, predicted):
    """Write to ``predicted``, see ``Copies.predict``, what all copies predict of pair ``i``.

    ``row`` is the place of each use in ``effects`` and ``outcomes``.
    """
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
        total += outcomes[row[use], 0]
        least = min(least, outcomes[row[use], 1])
        for v in range(effect.shape[1]):
            k = table.variable[uses.copy[use], v]
            if k >= 0:
                effect[i, v] = table.sign[uses.copy[use], v] * effects[row[use], k]
    reward[i] = total / n if n > 0 else 0.0
    weight[i] = least if n > 0 and uses.complete[action] else 0.0


@entry_point
def join_many(table, uses, actions, found, predicted):
    """:func:`join_copies` for many pairs.

    :param found: of each pair and use the number of its prediction, int64, shape (n, n_uses); effects and outcomes of these,
        shape (n_predictions, ...)
    """
    table, uses = CopyTable(*table), Uses(*uses)
    rows, effects, outcomes = found
    for i in range(len(actions)):
        join_copies(table, uses, actions[i], i, rows[i], effects, outcomes, predicted)
