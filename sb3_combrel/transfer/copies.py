"""Copies of sources in a target: compiled predictions of a source seen through state mappings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.periodic import differences
from sb3_combrel.models.fit_arrays import Kernel
from sb3_combrel.models.linear_prediction import NearestLists
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import SourceModel, predict_source

# The smallest scale that compliance is measured by, squared unit coordinates: a variable that never moves.
SMALLEST_SCALE = 1e-12
# Errors are compared with effects of at least this fraction of a typical one of the source.
LEAST_EFFECT = 0.25
# And count as at most this many times as large, squared: a bound of 1 would find noise to explain something.
LARGEST_MISS = 2.0
# From so many pairs on the different states of each copy are predicted once.
MANY = 256


class CopyTable(NamedTuple):
    """Copies of sources for compiled code, one a row.

    :param variable: int64, shape (n_copies, n_target_variables): source variable that a target variable is, -1: none
    :param sign: float64, same shape: -1 where it is mirrored
    :param share: float64, shape (n_copies, n_source_variables): 1 / number of target variables that a variable of the copy has
    :param least: float64, shape (n_copies, n_target_variables): squared effect that errors are compared with at least
    :param first: int64, shape (n_copies,): the model's number of the source's first action; ``n_actions``: same shape
    """

    variable: np.ndarray
    sign: np.ndarray
    share: np.ndarray
    least: np.ndarray
    first: np.ndarray
    n_actions: np.ndarray


class CopySums(NamedTuple):
    """Sums over the target's transitions, by target action.

    :param n: float64, shape (n_target_actions,): transitions
    :param size: float64, shape (n_target_actions, n_target_variables): sizes of effects
    :param effect: float64, same shape: squared effects
    :param moved: float64, same shape: transitions in which the variable moved at all
    :param stay: float64, same shape: compliances of each variable with "it stays as it is"
    :param compliance: float64, shape (n_copies, n_target_actions, most source actions): compliances of each copy
    :param error: float64, shape (n_copies, n_target_actions, most source actions, n_target_variables): squared errors
    :param missed: float64, same shape: squared errors in parts of the squared effects, each at most
        ``LARGEST_MISS``, where the source has data: times how much of the threshold its weight reaches, at most 1
    :param founded: float64, shape (n_copies, n_target_actions, most source actions): sums of these factors
    """

    n: np.ndarray
    size: np.ndarray
    effect: np.ndarray
    moved: np.ndarray
    stay: np.ndarray
    compliance: np.ndarray
    error: np.ndarray
    missed: np.ndarray
    founded: np.ndarray

    @classmethod
    def zero(cls, n_copies: int, n_source_actions: int, n_actions: int, n_variables: int) -> CopySums:
        """Sums over no transitions."""
        return cls(
            n=np.zeros(n_actions),
            size=np.zeros((n_actions, n_variables)),
            effect=np.zeros((n_actions, n_variables)),
            moved=np.zeros((n_actions, n_variables)),
            stay=np.zeros((n_actions, n_variables)),
            compliance=np.zeros((n_copies, n_actions, n_source_actions)),
            error=np.zeros((n_copies, n_actions, n_source_actions, n_variables)),
            missed=np.zeros((n_copies, n_actions, n_source_actions, n_variables)),
            founded=np.zeros((n_copies, n_actions, n_source_actions)),
        )


class CopyScratch(NamedTuple):
    """Work space.

    :param at: float64, shape (n_source_variables,): a state as the copy has it; ``effect``: what the source predicts there
    :param scale: float64, shape (n_target_variables,): what squared errors are compared with in compliance
    """

    at: np.ndarray
    effect: np.ndarray
    scale: np.ndarray


class Uses(NamedTuple):
    """The copies and source actions that make up each target action, each pair of them once.

    :param copy: int64, shape (n_uses,): copy; ``action``: the model's number of the source action
    :param of_action: int64, shape (n_target_actions, most copies): uses of each target action, -1 for none
    :param complete: bool, shape (n_target_actions,): whether every copy of the action has a source action
    """

    copy: np.ndarray
    action: np.ndarray
    of_action: np.ndarray
    complete: np.ndarray


class UsePredictions(NamedTuple):
    """What each use predicts at one state: work space of :func:`predict_pairs`.

    :param done: bool, shape (n_uses,); ``effect``: float64, shape (n_uses, n_source_variables)
    :param outcome: float64, shape (n_uses, 3): reward, probability of termination, weight
    """

    done: np.ndarray
    effect: np.ndarray
    outcome: np.ndarray


@inlined
def see_state(table, copy, state, at):
    """Write to ``at`` a target state as ``copy`` has it: the mean where several target variables are one of its own."""
    at[:] = 0.0
    for v in range(len(state)):
        k = table.variable[copy, v]
        if k >= 0:
            at[k] += table.share[copy, k] * (1.0 - state[v] if table.sign[copy, v] < 0.0 else state[v])


@inlined
def add_effect(sums, action, effect):
    """Add the effect of a target transition to the sums that do not depend on copies, but for compliances."""
    sums.n[action] += 1.0
    for v in range(len(effect)):
        sums.size[action, v] += abs(effect[v])
        sums.effect[action, v] += effect[v] * effect[v]
        if effect[v] * effect[v] > SMALLEST_SCALE:
            sums.moved[action, v] += 1.0


@inlined
def add_error(table, sums, at, effect, predicted, founded):
    """Add the error of one variable to the sums; its square.

    :param at: (copy, target action, source action, target variable)
    """
    copy, action, u, v = at
    error = (effect - predicted) ** 2
    sums.error[copy, action, u, v] += error
    compared = max(effect * effect, table.least[copy, v])
    sums.missed[copy, action, u, v] += founded * min(LARGEST_MISS, error / max(compared, 1e-300))
    return error


@compiled
def measure_plain(source, table, rules, transition, sums, scratch):
    """Add one target transition to the sums: errors and compliances of all copies and source actions.

    The scale of compliance, of each variable, is the square of the mean size of its effects so far. (The mean of their
    squares would be that of a few large ones, such as those of a car that hits the wall, beside which nothing counts.)

    :param source: SourceArrays; ``table``: CopyTable; ``sums``: CopySums; ``scratch``: CopyScratch; plain tuples
    :param rules: (whole: compliance is over all target variables, those that a copy does not have stay; else over its own;
        weight from which on the source has data)
    :param transition: (state, action, effect), unit coordinates
    """
    instances, effect_range, kernel, near = source
    instances, kernel, near = Instances(*instances), Kernel(*kernel), NearestLists(*near)
    table, sums, scratch = CopyTable(*table), CopySums(*sums), CopyScratch(*scratch)
    whole, threshold = rules
    state, action, effect = transition
    n_variables = len(state)
    add_effect(sums, action, effect)
    n = sums.n.sum()
    for v in range(n_variables):
        scratch.scale[v] = max(SMALLEST_SCALE, (sums.size[:, v].sum() / n) ** 2)
        sums.stay[action, v] += np.exp(-effect[v] * effect[v] / scratch.scale[v])
    for copy in range(len(table.first)):
        see_state(table, copy, state, scratch.at)
        for u in range(table.n_actions[copy]):
            source_action = table.first[copy] + u
            _, _, weight = predict_source(instances, effect_range, kernel, near, source_action, scratch.at, scratch.effect)
            founded = min(1.0, weight / threshold)
            sums.founded[copy, action, u] += founded
            missed = 0.0
            for v in range(n_variables):
                k = table.variable[copy, v]
                if k >= 0:
                    predicted = table.sign[copy, v] * scratch.effect[k]
                    error = add_error(table, sums, (copy, action, u, v), effect[v], predicted, founded)
                    missed += error / scratch.scale[v]
                elif whole:
                    missed += effect[v] * effect[v] / scratch.scale[v]
            sums.compliance[copy, action, u] += np.exp(-missed)


@compiled
def follow_plain(table, uses, transition, sums):
    """Add one target transition to the sums, with the errors of what makes up its action alone, and no compliances.

    :param transition: (action, effect, predicted effect, weight of the prediction in parts of the threshold, at most 1)
    """
    table, uses, sums = CopyTable(*table), Uses(*uses), CopySums(*sums)
    action, effect, predicted, founded = transition
    add_effect(sums, action, effect)
    for c in range(uses.of_action.shape[1]):
        use = uses.of_action[action, c]
        if use >= 0:
            copy = uses.copy[use]
            u = uses.action[use] - table.first[copy]
            sums.founded[copy, action, u] += founded
            for v in range(len(effect)):
                if table.variable[copy, v] >= 0:
                    add_error(table, sums, (copy, action, u, v), effect[v], predicted[v], founded)


@compiled
def predict_pairs_plain(source, table, uses, pairs, predicted, found):
    """Predict target states and actions.

    :param source: SourceArrays; ``table``: CopyTable; plain tuples
    :param uses: Uses; ``found``: UsePredictions; plain tuples
    :param pairs: (states, actions)
    :param predicted: receives effects, rewards, probabilities of termination, and weights: the least of all copies'
    """
    instances, effect_range, kernel, near = source
    instances, kernel, near = Instances(*instances), Kernel(*kernel), NearestLists(*near)
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
                outcome[0], outcome[1], outcome[2] = predict_source(
                    instances, effect_range, kernel, near, uses.action[use], at, effect
                )
                found.done[use] = True
        join_copies(table, uses, actions[i], i, found.effect, found.outcome, predicted)


@inlined
def join_copies(table, uses, action, i, effects, outcomes, predicted):
    """Write what all copies predict of pair ``i``.

    :param effects: float64, shape (n_uses, n_source_variables): of each use; ``outcomes``: float64, shape (n_uses, 3)
    """
    effect, reward, end, weight = predicted
    effect[i, :] = 0.0
    n = 0
    total = 0.0
    ends = 1.0
    least = np.inf
    for c in range(uses.of_action.shape[1]):
        use = uses.of_action[action, c]
        if use < 0:
            continue
        n += 1
        total += outcomes[use, 0]
        ends *= outcomes[use, 1]
        least = min(least, outcomes[use, 2])
        for v in range(effect.shape[1]):
            k = table.variable[uses.copy[use], v]
            if k >= 0:
                effect[i, v] = table.sign[uses.copy[use], v] * effects[use, k]
    reward[i] = total / n if n > 0 else 0.0
    end[i] = ends if n > 0 else 0.0
    weight[i] = least if n > 0 and uses.complete[action] else 0.0


@compiled
def join_many_plain(table, uses, actions, found, predicted):
    """:func:`join_copies` for many pairs.

    :param found: for each use and pair, the number of its prediction, int64, shape (n_uses, n); and these predictions,
        float64, shape (n_predictions, n_source_variables) and (n_predictions, 3)
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
                for k in range(3):
                    outcome_here[use, k] = outcomes[row, k]
        join_copies(table, uses, actions[i], i, effect_here, outcome_here, predicted)


_measure, _follow = EntryPoint(measure_plain), EntryPoint(follow_plain)
_predict_pairs, _join_many = EntryPoint(predict_pairs_plain), EntryPoint(join_many_plain)

Predicted = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Copies:
    """
    Copies of sources in the target: each makes some target variables variables of a source.

    A copy that leaves out source variables is predicted by a local linear model of the others: their effects are fitted to
    them alone, over all that the instances have in those that are left out.

    :param sources: instances of each source task
    :param source: number of each copy's source, int64, shape (n_copies,)
    :param state: source variable of each target variable, int64, shape (n_copies, n_target_variables), -1: not in the copy
    :param sign: -1 where a target variable is mirrored, same shape
    :param breadth: kernel breadth of the sources' models, in unit coordinates of the sources
    :param threshold: weight from which on a source has data
    """

    def __init__(
        self,
        sources: Sequence[SourceInstances],
        source: np.ndarray,
        state: np.ndarray,
        sign: np.ndarray,
        breadth: float,
        threshold: float,
    ):
        self.threshold = float(threshold)
        self.sources = sources
        self.source = source
        self.state = state
        self.sign = sign
        used = [tuple(np.unique(row[row >= 0]).tolist()) for row in state]
        first: dict[tuple[int, tuple[int, ...]], int] = {}
        n_actions = 0
        for key in zip(source.tolist(), used, strict=True):
            if key not in first:
                first[key] = n_actions
                n_actions += sources[key[0]].n_actions
        self.model = SourceModel(_seen_through(sources, list(first)), breadth)
        n_variables = self.model.n_variables
        count = (state[:, :, None] == np.arange(n_variables)).sum(axis=1)
        self.table = CopyTable(
            variable=np.ascontiguousarray(state, dtype=np.int64),
            sign=np.ascontiguousarray(sign, dtype=np.float64),
            share=1.0 / np.maximum(count, 1),
            least=(LEAST_EFFECT * self._typical_effects()) ** 2,
            first=np.array([first[key] for key in zip(source.tolist(), used, strict=True)], dtype=np.int64),
            n_actions=np.array([sources[s].n_actions for s in source], dtype=np.int64),
        )
        self._plain_table = tuple(self.table)
        d = state.shape[1]
        self._scratch = tuple(CopyScratch(np.empty(n_variables), np.empty(n_variables), np.empty(d)))

    def __len__(self) -> int:
        return len(self.source)

    @property
    def most_actions(self) -> int:
        """Number of actions of the source that has most."""
        return int(self.table.n_actions.max())

    def measure(self, state: np.ndarray, action: int, effect: np.ndarray, sums: CopySums, whole: bool) -> None:
        """
        Add a target transition to the sums.

        :param state: unit coordinates, shape (n_target_variables,); ``effect``: next state minus state
        :param whole: whether compliance is over all target variables; those that a copy does not have stay. Otherwise over
            its own
        """
        rules = whole, self.threshold
        _measure.call(self.model.plain, self._plain_table, rules, (state, action, effect), tuple(sums), self._scratch)

    def follow(self, uses: Uses, action: int, effect: np.ndarray, predicted: Predicted, sums: CopySums) -> None:
        """
        Add a target transition to the sums, for what makes up its action alone.

        :param effect: next state minus state, shape (n_target_variables,)
        :param predicted: what :meth:`predict` says of it
        """
        founded = min(1.0, float(predicted[3][0]) / self.threshold)
        _follow.call(self._plain_table, tuple(uses), (action, effect, predicted[0][0], founded), tuple(sums))

    def uses(self, copies: np.ndarray, actions: np.ndarray) -> Uses:
        """
        List what makes up each target action.

        :param copies: int64, shape (n_target_actions, n): copies, -1 for none
        :param actions: same shape: the source action of each, -1 for none
        """
        number: dict[tuple[int, int], int] = {}
        of_action = np.full(copies.shape, -1, dtype=np.int64)
        for a, c in np.argwhere((copies >= 0) & (actions >= 0)):
            copy = int(copies[a, c])
            of_action[a, c] = number.setdefault((copy, int(self.table.first[copy] + actions[a, c])), len(number))
        pairs = np.array(list(number), dtype=np.int64).reshape(-1, 2)
        complete = np.logical_and((copies >= 0).any(axis=1), ((copies < 0) | (actions >= 0)).all(axis=1))
        return Uses(pairs[:, 0].copy(), pairs[:, 1].copy(), of_action, np.asarray(complete))

    def work_space(self, uses: Uses) -> UsePredictions:
        """Make the work space of :meth:`predict`."""
        n = len(uses.copy)
        # The last row is for a state as a copy has it.
        return UsePredictions(np.zeros(n, dtype=np.bool_), np.empty((n + 1, self.model.n_variables)), np.empty((n + 1, 3)))

    def predict(self, uses: Uses, found: UsePredictions, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """
        Predict pairs of the target.

        :param uses: of each target action
        :param found: from :meth:`work_space`
        :param states: unit coordinates of the target, float64, shape (n, n_target_variables)
        :param actions: target actions, int64, shape (n,)
        :return: effects, shape (n, n_target_variables): 0 for variables in no copy; rewards, the mean of all copies';
            probabilities of termination, their product; and weights, the least of theirs, 0 for actions that are not complete
        """
        n, d = states.shape
        predicted = np.empty((n, d)), np.empty(n), np.empty(n), np.empty(n)
        plain_uses = tuple(uses)
        if n < MANY:
            _predict_pairs.call(self.model.plain, self._plain_table, plain_uses, (states, actions), predicted, tuple(found))
        else:
            rows, effects, outcomes = self._predict_distinct(uses, states, actions)
            here = rows, effects, outcomes, found.effect, found.outcome
            _join_many.call(self._plain_table, plain_uses, actions, here, predicted)
        return predicted

    def _predict_distinct(
        self, uses: Uses, states: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predict each different state of each use once; the number of each pair's prediction, and the predictions."""
        rows = np.zeros((len(uses.copy), len(actions)), dtype=np.int64)
        effects, outcomes, n = [np.empty((0, self.model.n_variables))], [np.empty((0, 3))], 0
        for use, (copy, action) in enumerate(zip(uses.copy.tolist(), uses.action.tolist(), strict=True)):
            asked = np.flatnonzero((uses.of_action == use).any(axis=1)[actions])
            variables = np.flatnonzero(self.table.variable[copy] >= 0)
            chosen, inverse = distinct_rows(states[np.ix_(asked, variables)])
            at = self._as_copy(copy, states[asked[chosen]])
            found = self.model.predict(at, np.full(len(at), action, dtype=np.int64))
            rows[use, asked] = n + inverse
            effects.append(found.effect)
            outcomes.append(np.column_stack([found.reward, found.end, found.weight]))
            n += len(at)
        return rows, np.concatenate(effects), np.concatenate(outcomes)

    def _as_copy(self, copy: int, states: np.ndarray) -> np.ndarray:
        """Target states as a copy has them, shape (n, n_source_variables)."""
        at = np.zeros((len(states), self.model.n_variables))
        for v in np.flatnonzero(self.table.variable[copy] >= 0):
            k = self.table.variable[copy, v]
            side = 1.0 - states[:, v] if self.table.sign[copy, v] < 0.0 else states[:, v]
            at[:, k] += self.table.share[copy, k] * side
        return at

    def _typical_effects(self) -> np.ndarray:
        """How much each source moves what a copy makes of it.

        :return: median size of the effects (or their mean, if most are 0) on the source variable of each target variable, unit
            coordinates, shape (n_copies, n_target_variables); 0 for variables that are not in the copy
        """
        typical = []
        for source in self.sources:
            to_unit = source.scaling.to_unit
            size = np.abs(differences(to_unit(source.next_states), to_unit(source.states), np.array(source.periodic)))
            median = np.median(size, axis=0)
            typical.append(np.where(median > 0.0, median, size.mean(axis=0)))
        found = np.zeros(self.state.shape)
        for copy, (number, row) in enumerate(zip(self.source.tolist(), self.state, strict=True)):
            found[copy, row >= 0] = typical[number][row[row >= 0]]
        return found


def distinct_rows(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Find the different rows of an array, column by column: quicker than sorting rows.

    :param values: float64, shape (n, n_columns)
    :return: the number of one row of each kind, and the kind of each row, int64, shape (n,)
    """
    kind = np.zeros(len(values), dtype=np.int64)
    for column in values.T:
        different, inverse = np.unique(column, return_inverse=True)
        _, kind = np.unique(kind * len(different) + inverse, return_inverse=True)
    n = int(kind.max()) + 1 if len(kind) else 0
    one_of = np.empty(n, dtype=np.int64)
    one_of[kind] = np.arange(len(kind))
    return one_of, kind


def _seen_through(sources: Sequence[SourceInstances], parts: Sequence[tuple[int, tuple[int, ...]]]) -> Instances:
    """
    Instances of (source, variables) after (source, variables), their actions numbered on.

    All other variables are 0, so that they make no difference.
    """
    chosen = []
    for number, used in parts:
        instances = sources[number]
        left_out = [k for k in range(instances.n_variables) if k not in used]
        low, states, next_states = (np.array(array) for array in (instances.low, instances.states, instances.next_states))
        states[:, left_out] = next_states[:, left_out] = low[left_out]
        chosen.append(dataclasses.replace(instances, states=states, next_states=next_states))
    return stacked_instances(chosen)
