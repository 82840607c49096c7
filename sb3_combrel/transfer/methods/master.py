"""MASTER: transfer through the one mapping that predicts random transitions of the target best (Taylor et al. 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from sb3_combrel.common.checks import check_count
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.selectors import FixedSelector
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer, check_action_mappings
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_choice import Choice, Chooser
from sb3_combrel.transfer.prior.prior_sets import copies_of, is_factored
from sb3_combrel.transfer.prior.source_prior import SourcePrior

DEFAULT_RANDOM_STEPS = 100


@dataclass(repr=False, eq=False)
class MASTER(MappingTransfer):
    """Modeling Approximate State Transitions by Exploiting Regression: finds a mapping by random actions, then transfers.

    Paper: Taylor, Kuhlmann & Stone, "Autonomous transfer for reinforcement learning" (AAMAS 2008). The first
    ``n_random_steps`` actions in the target are drawn uniformly. The one mapping, of states and actions together, through
    which the source's model predicts these transitions' effects with the least mean squared error over all target variables
    (unit coordinates; a variable that it does not map is predicted to stay as it is) is transferred with for the rest of the
    run.

    What differs from the paper: it fits a model to the few transitions of the target and tests it on the many of the source;
    here the source's (:class:`~sb3_combrel.transfer.source_model.SourceModel`) is tested on the target's. Its mappings give
    every target variable a source variable, as ``mappings="surjective"`` does. The learner is Fitted R-Max, which transfers as
    with TIMBREL.

    The agent learns from the random steps too; until they are over nothing is transferred. From Mountain Car 2D to 4D 20 are
    enough; noisy tasks need more.

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`; it has
    neither ``relevance`` and its fraction nor ``bandwidths``.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=MASTER(source, n_random_steps=20))
        model.learn(total_timesteps=5_000)

    :param mappings: the mappings to choose from, a set as there. Of mappings with the same error the first is chosen
    :param n_random_steps: random actions by which is chosen, of all environments together. A target action that was never
        drawn has no say
    :param use: as there; None: "prior" where the target's model takes one (``FittedRMax(degree=1)``), unless ``breadth`` or
        ``breadth_decay``, which mean nothing then, differ from their defaults
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    of_prior: ClassVar[tuple[str, ...]] = (*MappingTransfer.of_prior, "n_random_steps")

    mappings: MappingsLike = "injective"
    _: KW_ONLY
    n_random_steps: int = DEFAULT_RANDOM_STEPS
    use: str | None = None  # type: ignore[assignment]
    relevance: bool | str = field(default=False, init=False)
    relevance_fraction: float = field(default=0.5, init=False)
    bandwidths: tuple[float, float, float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        check_count("n_random_steps", self.n_random_steps)
        if is_factored(self.mappings):
            raise ValueError(f"mappings must be a set of which one mapping is chosen, no factored ones, got {self.mappings!r}")
        if self.use is None:
            if not self._of_instances():
                self._left_open = {"use": None}
            self.use = "instances"
        super().__post_init__()

    def _make_selector(self, candidates: Candidates, bandwidths: CandidateBandwidths) -> LeastErrorSelector:
        check_action_mappings(candidates.sets)
        copies = copies_of(candidates, float(self.source_breadth))
        self._least_error = LeastErrorSelector(candidates, copies, self.n_random_steps)
        return self._least_error

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        candidates = Candidates(self.source, self.mappings, task)
        check_action_mappings(candidates.sets)
        copies = copies_of(candidates, float(self.source_breadth))
        choose = self._chooser(copies, candidates.sets)
        steps = {"max_transitions": self.n_random_steps, "first_renewal": self.n_random_steps}
        return SourcePrior(copies, task, choose, whole=True, transfer_terminals=self.transfer_terminals, **steps)

    def _chooser(self, copies: Copies, sets: Sequence[MappingSet]) -> Chooser:
        """What chooses for a prior. Another method that judges mappings by random transitions has another."""
        return partial(choose_least_error, copies, sets)

    def action(self, state: np.ndarray) -> int | None:
        if self.mapping_steps() >= self.n_random_steps:
            return None
        return int(self.rng.integers(self._bound_task.n_actions))

    def mapping_steps(self) -> int:
        """Return how many random steps of the target have been taken to find the mapping."""
        return min(self.n_random_steps, self._source_use.n_observed)

    @property
    def chosen(self) -> InterTaskMapping | None:
        """The mapping that was chosen, with names; None before."""
        made_by = self.source_prior if self.use == "prior" else self._least_error
        if made_by.choice is None:
            return None
        actions = tuple(made_by.choice.actions[:, 0].tolist())
        return made_by.copies.mapping(int(made_by.choice.copies[0, 0]), self._bound_task, actions)

    def statistics(self) -> dict[str, float]:
        found = float(self.chosen is not None)
        figures = {"transfer/steps_to_find_mapping": self.mapping_steps(), "transfer/mapping_found": found}
        return super().statistics() | figures


def squared_errors(copies: Copies, sums: CopySums) -> np.ndarray:
    """Return effects' squared errors, summed, unit coordinates, shape (n_copies, n_target_actions, most source actions).

    They are infinite for source actions that no instance has taken.
    """
    left_out = (copies.state < 0).astype(np.float64)
    errors = sums.error.sum(axis=3) + (left_out @ sums.effect.T)[:, :, None]
    return np.where(copies.taken[:, None], errors, np.inf)


def least_error_member(errors: np.ndarray, mappings: MappingSet) -> tuple[float, int, np.ndarray]:
    """Find the mapping with the least error, the first of equals: error, state mapping, each target action's source action."""
    if mappings.combines_freely:
        # Every combination is in the set: the best source action of each target action can be found on its own.
        of_row = errors.min(axis=2).sum(axis=1)
        row = int(of_row.argmin())
        return float(of_row[row]), row, errors[row].argmin(axis=1)
    found = []
    for rows, actions in mappings.members():
        of_member = errors[rows[:, None], np.arange(errors.shape[1]), actions].sum(axis=1)
        best = int(of_member.argmin())
        found.append((float(of_member[best]), int(rows[best]), actions[best]))
    return min(found, key=lambda one: one[0])


def choose_least_error(copies: Copies, sets: Sequence[MappingSet], sums: CopySums) -> Choice:
    """Choose the mapping with the least squared error of all sets, whose state mappings ``copies`` has in order."""
    return choose_least(squared_errors(copies, sums), copies, sets)


def choose_least(errors: np.ndarray, copies: Copies, sets: Sequence[MappingSet]) -> Choice:
    """Choose the mapping for which errors, of the shape of :func:`squared_errors`, add up to least."""
    first, found = 0, []
    for number, mappings in enumerate(sets):
        rows = slice(first, first + mappings.n_state_mappings)
        error, row, actions = least_error_member(errors[rows, :, : copies.sources[number].n_actions], mappings)
        found.append((error, first + row, actions))
        first += mappings.n_state_mappings
    _, row, actions = min(found, key=lambda one: one[0])
    return Choice(np.full((len(actions), 1), row, dtype=np.int64), actions[:, None].copy())


class LeastErrorSelector(FixedSelector):
    """Selects nothing until it has seen ``n_transitions``; then, for good, the mapping that predicted their effects best."""

    needs_transitions = True

    def __init__(self, candidates: Candidates, copies: Copies, n_transitions: int):
        task = candidates.task
        super().__init__(candidates, fixed=np.full(task.n_actions, -1, dtype=np.int64))
        self.copies, self.max_transitions = copies, n_transitions
        self.sums = CopySums.zero(len(copies), copies.most_actions, task.n_actions, task.n_variables)
        self.choice: Choice | None = None  #: the mapping that was chosen, None before
        self._just_chosen = False

    def add_transition(self, i: int) -> None:
        seen = self.transitions
        self.copies.measure(seen.states[i], int(seen.actions[i]), seen.effects[i], self.sums)
        if i + 1 == self.max_transitions:
            self.choice = choose_least_error(self.copies, self.candidates.sets, self.sums)
            table = self.candidates.table
            for action, (row, source_action) in enumerate(np.hstack(self.choice).tolist()):
                # The candidate with this state mapping, or an equal one.
                number = source_action + self.candidates.first_action[self.copies.source[row]]
                self.fixed[action] = self.candidates.find(action, table.variable[row], table.sign[row], number)
            self._just_chosen = True

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        just_chosen, self._just_chosen = self._just_chosen, False
        return just_chosen

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        super().set_state(state)
        self._just_chosen = False
