"""The mapping whose predicted effects have the least mean squared error on transitions of the target (MASTER)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.mappings.action_mappings import ActionMappings, AllActionMappings
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.transfer.instances.selectors import Ranges, Selector, SelectorParts
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_choice import Choice

# Action mappings that are restricted as a whole are compared one by one.
MAX_ACTION_MAPPINGS = 100_000


def check_action_mappings(sets: Sequence[MappingSet]) -> None:
    """
    Check that the mappings of these sets can be compared.

    :raises ValueError: if there are too many
    """
    for mappings in sets:
        one_by_one = mappings.pairs is None and not isinstance(mappings.actions, AllActionMappings)
        if one_by_one and mappings.n_action_mappings > MAX_ACTION_MAPPINGS:
            raise ValueError(
                f"mappings must have at most {MAX_ACTION_MAPPINGS:,} action mappings, or all there are, whose source "
                f'actions are chosen one by one ("injective"), got {mappings.n_action_mappings:,}'
            )


def squared_errors(copies: Copies, sums: CopySums) -> np.ndarray:
    """
    Return the squared errors of the predicted effects, added up over the transitions of each target action.

    :param copies: one for each state mapping; variables that it does not map are predicted to stay as they are
    :param sums: over the target's transitions
    :return: unit coordinates of the target, shape (n_copies, n_target_actions, most source actions)
    """
    left_out = (copies.state < 0).astype(np.float64)
    found: np.ndarray = sums.error.sum(axis=3) + (left_out @ sums.effect.T)[:, :, None]
    return found


def least_error_member(errors: np.ndarray, mappings: MappingSet) -> tuple[float, int, np.ndarray]:
    """
    Find the mapping of a set with the least error, the first of equal ones.

    :param errors: of each state mapping, target action and source action, shape (n_state_mappings, n_target_actions,
        n_source_actions)
    :param mappings: the set
    :return: the error of all target actions together, the state mapping, and the source action of each target action
    """
    pairs, each_action = mappings.pairs, np.arange(errors.shape[1])
    if pairs is None and isinstance(mappings.actions, AllActionMappings):
        # Every combination is in the set: the best source action of each target action can be found on its own.
        of_row = errors.min(axis=2).sum(axis=1)
        row = int(of_row.argmin())
        return float(of_row[row]), row, errors[row].argmin(axis=1)
    if pairs is not None:
        actions = action_table(mappings.actions, pairs[:, 1].tolist())
        of_member = errors[pairs[:, :1], each_action, actions].sum(axis=1)
        best = int(of_member.argmin())
        return float(of_member[best]), int(pairs[best, 0]), actions[best]
    actions = action_table(mappings.actions, range(mappings.n_action_mappings))
    totals = np.array([of_row[each_action, actions].sum(axis=1) for of_row in errors])
    row, number = divmod(int(totals.argmin()), totals.shape[1])
    return float(totals[row, number]), row, actions[number]


def action_table(actions: ActionMappings, numbers: Sequence[int]) -> np.ndarray:
    """Return some action mappings, one a row: source action of each target action, int64, shape (n, n_target_actions)."""
    return np.array([actions[number] for number in numbers], dtype=np.int64)


def choose_least_error(copies: Copies, sets: Sequence[MappingSet], sums: CopySums) -> Choice:
    """
    Choose the mapping with the least mean squared error of the predicted effects, of all sources.

    :param copies: the state mappings of all sets, one below the other
    :param sets: the mappings to each source
    :param sums: over the target's transitions
    """
    errors, first, found = squared_errors(copies, sums), 0, []
    for number, mappings in enumerate(sets):
        rows = slice(first, first + mappings.n_state_mappings)
        error, row, actions = least_error_member(errors[rows, :, : copies.sources[number].n_actions], mappings)
        found.append((error, first + row, actions))
        first += mappings.n_state_mappings
    _, row, actions = min(found, key=lambda one: one[0])
    return Choice(np.full((len(actions), 1), row, dtype=np.int64), actions[:, None].copy())


class LeastErrorSelector(Selector):
    """
    Selects nothing until it has seen so many transitions; then, for good, the mapping that predicted their effects best.

    :param copies: the candidates' state mappings with the sources' models
    :param n_transitions: transitions by which is chosen
    """

    makes_choices = True
    needs_transitions = True

    def __init__(self, parts: SelectorParts, copies: Copies, n_transitions: int):
        super().__init__(parts)
        task, self.copies, self.n_transitions = self.task, copies, n_transitions
        self.sums = CopySums.zero(len(copies), copies.most_actions, task.n_actions, task.n_variables)
        #: The mapping that was chosen, None before.
        self.choice: Choice | None = None
        self._candidate = np.full(task.n_actions, -1, dtype=np.int64)
        self._just_chosen = False

    def takes_transitions(self) -> bool:
        return self.transitions.n < self.n_transitions

    def add_transition(self, i: int) -> None:
        seen = self.transitions
        self.copies.measure(seen.states[i], int(seen.actions[i]), seen.effects[i], self.sums, True)
        if i + 1 == self.n_transitions:
            self.choice = choose_least_error(self.copies, self.candidates.sets, self.sums)
            for action, (row, source_action) in enumerate(np.hstack(self.choice).tolist()):
                self._candidate[action] = self._find(action, row, source_action)
            self._just_chosen = True

    def _find(self, action: int, row: int, source_action: int) -> int:
        """The candidate of a target action with a state mapping, or an equal one, and a source action of its source."""
        arrays, table = self.candidates.arrays, self.candidates.table
        first, last = arrays.first[action], arrays.first[action + 1]
        same = (table.variable == table.variable[row]) & (table.sign == table.sign[row])
        # Actions are numbered on from source to source.
        number = source_action + sum(source.n_actions for source in self.candidates.sources[: self.copies.source[row]])
        fits = same.all(axis=1)[arrays.row[first:last]] & (arrays.action[first:last] == number)
        return int(first + np.flatnonzero(fits)[0])

    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        chosen = self._candidate[actions]
        return np.maximum(chosen, 0), chosen + 1

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        just_chosen, self._just_chosen = self._just_chosen, False
        return just_chosen

    def choices(self) -> np.ndarray:
        return np.repeat(self._candidate, len(self.task.sample_states))

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        for i in range(min(self.transitions.n, self.n_transitions)):
            self.add_transition(i)
        self._just_chosen = False
