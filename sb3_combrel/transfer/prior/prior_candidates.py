"""What target actions are made of through a prior, by number and by name, and for how long each was in use."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sb3_combrel.mappings.factored_mapping import describe_both_sides, describe_copy
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidate, MappedVariables
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.prior_choice import Choice

# Of a choice, for one target action: the copies that it moves, and the source actions by which it does.
Moves = Sequence[tuple[int, int]]


class PriorCandidates:
    """The candidates of a prior: each a target action and what it was made of at some time, numbered as they come up.

    Methods of the same name mean what they do of ``Candidates``.
    """

    def __init__(self, copies: Copies, task: TargetTask):
        self.copies = copies
        self.task = task
        # By candidate, in the order of their numbers: for how many transitions it was in use.
        self._uses: dict[tuple[int, ...], int] = {}

    def note_use(self, action: int, moves: Moves) -> None:
        """Take in that a target action that is made of ``moves`` was in use for a transition."""
        self._uses[self._key(action, moves)] += 1

    def number(self, action: int, moves: Moves) -> int:
        """Return the number of a target action that is made of ``moves``."""
        key = self._key(action, moves)
        return list(self._uses).index(key)

    def _key(self, action: int, moves: Moves) -> tuple[int, ...]:
        key = (action, *(number for pair in moves for number in pair))
        self._uses.setdefault(key, 0)
        return key

    def made_of(self, candidate: int) -> tuple[int, Moves]:
        """Return a candidate's target action, and what it is made of."""
        action, *rest = list(self._uses)[candidate]
        return action, list(zip(rest[::2], rest[1::2], strict=True))

    def uses(self) -> dict[int, int]:
        """Return for how many of the target's transitions each candidate was in use."""
        return {number: n for number, n in enumerate(self._uses.values()) if n}

    def parts(self, candidate: int) -> Candidate:
        action, moves = self.made_of(candidate)
        names = " + ".join(self._action_name(copy, used) for copy, used in moves) or "nothing"
        return Candidate(action, names, " + ".join(describe_copy(self.mapping(copy)) for copy, _ in moves))

    def mapped_variables(self, candidate: int) -> MappedVariables:
        (action, moves), of = self.made_of(candidate), self.copies
        parts = [(int(of.source[copy]), of.state[copy], of.sign[copy], used) for copy, used in moves]
        return MappedVariables.of(action, parts, self.task.n_variables)

    def describe(self, candidate: int) -> str:
        parts = self.parts(candidate)
        return f"{self.task.action_names[parts.target_action]}<-{parts.source_action} with {parts.state_mapping}"

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions, or of several at once, of all candidates, each name once."""
        return list(dict.fromkeys(self.parts(number).source_action for number in range(len(self._uses))))

    def describe_choice(self, choice: Choice | None) -> str:
        """Say what each target action is made of: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v); ..."."""
        names = self.task.action_names
        moves = [[] if choice is None else choice.moves(a) for a in range(self.task.n_actions)]
        words = (self.describe_moves(of, describe_both_sides) for of in moves)
        return "; ".join(f"{name}: {of}" for name, of in zip(names, words, strict=True))

    def describe_moves(self, moves: Moves, variables_of: Callable[[InterTaskMapping], str] = describe_copy) -> str:
        """Say what a target action is made of: "Right on (x, vx), Neutral on (y, vy)", or "nothing"."""
        words = (f"{self._action_name(copy, used)} on {variables_of(self.mapping(copy))}" for copy, used in moves)
        return ", ".join(words) if moves else "nothing"

    def names(self) -> list[str]:
        """Return what :meth:`describe_moves` says of all candidates, each once, in the order in which they came up."""
        return list(dict.fromkeys(self.describe_moves(self.made_of(number)[1]) for number in range(len(self._uses))))

    def describe_copies(self, choice: Choice) -> str:
        """Name the copies of a choice: "(x, vx) and (y, vy)", or "no copy at all"."""
        copies = dict.fromkeys(choice.copies[choice.copies >= 0].tolist())
        return " and ".join(describe_copy(self.mapping(each)) + self._of_source(each) for each in copies) or "no copy at all"

    def mapping(self, copy: int) -> InterTaskMapping:
        """Return a copy as an inter-task mapping, with names, of which the states alone count."""
        return self.copies.mapping(copy, self.task, (0,) * self.task.n_actions)

    def _action_name(self, copy: int, used: int) -> str:
        return self.copies.sources[int(self.copies.source[copy])].action_names[used] + self._of_source(copy)

    def _of_source(self, copy: int) -> str:
        """Of several sources the number of a copy's, from 1 on."""
        return "" if len(self.copies.sources) == 1 else f" of source {int(self.copies.source[copy]) + 1}"

    def get_state(self) -> np.ndarray:
        """Return all candidates and their uses, one a row, float64, shape (n, 2 * n_variables + 2)."""
        d = self.task.n_variables
        rows = [[n, *key, *[-1] * (2 * d + 1 - len(key))] for key, n in self._uses.items()]
        return np.array(rows, dtype=np.float64).reshape(-1, 2 * d + 2)

    def set_state(self, rows: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        self._uses = {}
        for n, *key in rows.astype(np.int64).tolist():
            self._uses[tuple(number for number in key if number >= 0)] = n
