"""Copies of sources in a target: predictions of a source seen through state mappings, and how well they do."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from sb3_combrel.common.instances import Instances
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.prior.copy_predictions import CopyTable, Uses, join_many, predict_pairs
from sb3_combrel.transfer.prior.copy_sums import CopySums, add_transition, add_used
from sb3_combrel.transfer.source_model import SourceModel

# From so many pairs on the different states of each copy are predicted once.
MANY = 256

Predicted = tuple[np.ndarray, np.ndarray, np.ndarray]


class Copies:
    """Copies of sources in the target: each makes some target variables variables of a source.

    A copy that leaves out source variables is predicted by a local linear model of the others alone.

    :param source: number of each copy's source, int64, shape (n_copies,)
    :param state: source variable of each target variable, int64, shape (n_copies, n_target_variables), -1: not in the copy
    :param sign: -1 where a target variable is mirrored, same shape
    :param breadth: kernel breadth of the sources' models, in unit coordinates of the sources
    """

    def __init__(
        self, sources: Sequence[SourceInstances], source: np.ndarray, state: np.ndarray, sign: np.ndarray, breadth: float
    ):
        self.breadth = float(breadth)
        self.sources = sources
        self.source = source
        self.state = np.ascontiguousarray(state, dtype=np.int64)
        self.sign = np.ascontiguousarray(sign, dtype=np.float64)
        # Copies with the same variables of the same source have its actions in common.
        parts = [(s, tuple(np.unique(row[row >= 0]).tolist())) for s, row in zip(source.tolist(), state, strict=True)]
        different = list(dict.fromkeys(parts))
        first = dict(zip(different, accumulate((sources[s].n_actions for s, _ in different), initial=0), strict=False))
        self.model = SourceModel(_seen_through(sources, different), breadth)
        n_variables = self.model.n_variables
        count = (state[:, :, None] == np.arange(n_variables)).sum(axis=1)
        self.table = CopyTable(
            variable=self.state,
            sign=self.sign,
            share=1.0 / np.maximum(count, 1),
            first=np.array([first[part] for part in parts], dtype=np.int64),
            n_actions=np.array([sources[s].n_actions for s in source], dtype=np.int64),
        )
        self._plain_table = tuple(self.table)
        #: Number of actions of the source that has most.
        self.most_actions = int(self.table.n_actions.max())
        #: Whether each copy has all variables of its source, bool, shape (n_copies,).
        self.whole = np.array([len(used) == sources[s].n_variables for s, used in parts])
        #: Actions that some instance of each copy's source has taken, bool, shape (n_copies, most_actions).
        self.taken = np.array([np.isin(np.arange(self.most_actions), each.actions) for each in sources])[source]
        at, predicted = np.empty(n_variables), np.empty(n_variables)
        scale, last = np.empty(state.shape[1]), np.zeros(state.shape[1])
        self._scratch = at, predicted, scale, last, np.full((len(source), self.most_actions), np.inf)

    def __len__(self) -> int:
        return len(self.source)

    def measure(self, state: np.ndarray, action: int, effect: np.ndarray, sums: CopySums) -> None:
        """Add a target transition to the sums."""
        add_transition.call(self.model.plain, self._plain_table, (state, action, effect), tuple(sums), self._scratch)

    def measure_used(self, uses: Uses, action: int, effect: np.ndarray, predicted: Predicted, sums: CopySums) -> None:
        """Add a target transition to the sums, for what makes up its action alone; ``predicted``: by :meth:`predict`."""
        effects, _, [weight] = predicted
        transition = action, effect, effects[0], float(weight)
        add_used.call(self._plain_table, tuple(uses), transition, tuple(sums), np.empty(len(effect)))

    def uses(self, copies: np.ndarray, actions: np.ndarray) -> Uses:
        """List what makes up each target action; ``copies`` and ``actions`` as of ``Choice``."""
        number: dict[tuple[int, int], int] = {}
        of_action = np.full(copies.shape, -1, dtype=np.int64)
        for a, c in np.argwhere((copies >= 0) & (actions >= 0)):
            copy = int(copies[a, c])
            of_action[a, c] = number.setdefault((copy, int(self.table.first[copy] + actions[a, c])), len(number))
        pairs = np.array(list(number), dtype=np.int64).reshape(-1, 2)
        complete = np.logical_and((copies >= 0).any(axis=1), ((copies < 0) | (actions >= 0)).all(axis=1))
        return Uses(pairs[:, 0].copy(), pairs[:, 1].copy(), of_action, np.asarray(complete))

    def predict(self, uses: Uses, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """Predict pairs of the target.

        :return: effects, shape (n, n_target_variables), 0 for variables in no copy; mean rewards; and the least weights of all
            copies, 0 for actions that are not complete
        """
        n, d = states.shape
        predicted = np.empty((n, d)), np.empty(n), np.empty(n)
        if n < MANY:
            n_uses, k = len(uses.copy), self.model.n_variables
            row, done = np.arange(n_uses), np.empty(n_uses, dtype=np.bool_)
            scratch = np.empty(k), row, done, np.empty((n_uses, k)), np.empty((n_uses, 2))
            predict_pairs.call(self.model.plain, self._plain_table, tuple(uses), (states, actions), predicted, scratch)
        else:
            found = self._predict_distinct(uses, states, actions)
            join_many.call(self._plain_table, tuple(uses), actions, found, predicted)
        return predicted

    def _predict_distinct(
        self, uses: Uses, states: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predict each different state of each use once; the number of each pair's predictions, and the predictions."""
        rows = np.zeros((len(actions), len(uses.copy)), dtype=np.int64)
        effects, outcomes, n = [np.empty((0, self.model.n_variables))], [np.empty((0, 2))], 0
        for use, (copy, action) in enumerate(zip(uses.copy.tolist(), uses.action.tolist(), strict=True)):
            asked = np.flatnonzero((uses.of_action == use).any(axis=1)[actions])
            variables = np.flatnonzero(self.state[copy] >= 0)
            chosen, inverse = distinct_rows(states[np.ix_(asked, variables)])
            at = self.as_copy(copy, states[asked[chosen]])
            found = self.model.predict(at, np.full(len(at), action, dtype=np.int64))
            rows[asked, use] = n + inverse
            effects.append(found.effect)
            outcomes.append(np.column_stack([found.reward, found.weight]))
            n += len(at)
        return rows, np.concatenate(effects), np.concatenate(outcomes)

    def as_copy(self, copy: int, states: np.ndarray) -> np.ndarray:
        """Return target states as a copy has them, shape (n, most source variables); 0 for variables that it does not have."""
        at = np.zeros((len(states), self.model.n_variables))
        for v in np.flatnonzero(self.state[copy] >= 0):
            k = self.state[copy, v]
            side = 1.0 - states[:, v] if self.sign[copy, v] < 0.0 else states[:, v]
            at[:, k] += self.table.share[copy, k] * side
        return at

    def mapping(self, copy: int, task: TargetTask, action: tuple[int, ...]) -> InterTaskMapping:
        """Return a copy as an inter-task mapping, with names; ``action``: source action of each target action."""
        source = self.sources[self.source[copy]]
        state = tuple(None if k < 0 else k for k in self.state[copy].tolist())
        sign = tuple(int(s) for s in np.where(self.sign[copy] < 0, -1, 1))
        mapping = InterTaskMapping(state, action, sign)
        return mapping.with_names(source.state_names, task.state_names, source.action_names, task.action_names)


def distinct_rows(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of one row of each kind, and the kind of each row; quicker than sorting rows as ``np.unique`` does."""
    kind = np.zeros(len(values), dtype=np.int64)
    for column in values.T:
        different, inverse = np.unique(column, return_inverse=True)
        _, kind = np.unique(kind * len(different) + inverse, return_inverse=True)
    n = int(kind.max()) + 1 if len(kind) else 0
    one_of = np.empty(n, dtype=np.int64)
    one_of[kind] = np.arange(len(kind))
    return one_of, kind


def _seen_through(sources: Sequence[SourceInstances], parts: Sequence[tuple[int, tuple[int, ...]]]) -> Instances:
    """Instances of (source, variables) after (source, variables), their actions numbered on; other variables are 0."""
    chosen = []
    for number, used in parts:
        instances = sources[number]
        left_out = [k for k in range(instances.n_variables) if k not in used]
        low, states, next_states = (np.array(array) for array in (instances.low, instances.states, instances.next_states))
        states[:, left_out] = next_states[:, left_out] = low[left_out]
        chosen.append(dataclasses.replace(instances, states=states, next_states=next_states))
    return stacked_instances(chosen)
