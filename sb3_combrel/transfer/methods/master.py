"""MASTER: transfer through the one mapping that predicts random transitions of the target best (Taylor et al. 2008)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from sb3_combrel.common.checks import check_count
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike, SourceLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.selectors import SelectorParts
from sb3_combrel.transfer.methods.least_error import LeastErrorSelector, check_action_mappings, choose_least_error
from sb3_combrel.transfer.methods.mapping_transfer import DEFAULT_BREADTH, DEFAULT_BREADTH_DECAY, MappingTransfer
from sb3_combrel.transfer.prior.prior_sets import copies_of, is_factored
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH

DEFAULT_RANDOM_STEPS = 100


class MASTER(MappingTransfer):
    """
    Modeling Approximate State Transitions by Exploiting Regression: finds a mapping by random actions, then transfers.

    Paper: Taylor, Kuhlmann & Stone, "Autonomous transfer for reinforcement learning" (AAMAS 2008). The first
    ``n_random_steps`` actions in the target are drawn uniformly. The effects that the source's model predicts of these
    transitions through each mapping are compared with what happened. The one mapping, of the states and of the actions
    together, with the least mean squared error over all target variables (unit coordinates; a variable that it does not map is
    predicted to stay as it is) is transferred with for the rest of the run.

    What differs from the paper:

    - The paper fits a model to the few transitions of the target and tests it on the many of the source. Here the model is
      the source's, a local linear one (:class:`~sb3_combrel.transfer.source_model.SourceModel`), and is tested on the
      target's transitions: it has more data, and predicts in the same way as ``use="prior"`` does.
    - The paper's mappings give every target variable a source variable, as ``mappings="surjective"`` does. By default the
      variables that a mapping leaves out stay as they are, as in COMBREL.
    - The learner is Fitted R-Max, and what is transferred is what TIMBREL transfers through a mapping that is given.

    Cost: ``n_random_steps`` of the target, which are learned from as any others; until then nothing is transferred. In each of
    these steps the source predicts once for each state mapping and source action: Mountain Car 2D to 4D, 36 predictions, 0.1
    milliseconds. The number of action mappings does not matter where all of them are in the set. Which mapping is right there
    was found with 20 steps in 12 of 12 seeds: that of one of the two axes. Noisy tasks need more.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=MASTER(source, n_random_steps=20))
        model.learn(total_timesteps=5_000)

    :param source: source instances, a path to them, or a list of several, of which one mapping to one is chosen
    :param mappings: the mappings to choose from: the name of a set ("injective", "surjective", "all", "balanced"), one of the
        paper's sets, a list of mappings or a ``MappingSet``. Of mappings with the same error the first is chosen
    :param n_random_steps: random actions by which is chosen; with several environments all of them act randomly until there
        are so many transitions. A target action that was never drawn has no say
    :param breadth: kernel breadth of transferred instances, in unit coordinates
    :param breadth_decay: as of :class:`~sb3_combrel.transfer.methods.timbrel.TIMBREL`
    :param transfer_terminals: whether a source instance that ended its episode ends the target's too
    :param use: "instances": translated instances fill what the target's own lack; "prior": the source's own model, seen
        through the mapping, is the prior of the target's. None: "prior" where the target's model takes one
        (``FittedRMax(degree=1)``), unless ``breadth`` or ``breadth_decay``, which mean nothing then, differ from their
        defaults
    :param source_breadth: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike = "injective",
        *,
        n_random_steps: int = DEFAULT_RANDOM_STEPS,
        breadth: float = DEFAULT_BREADTH,
        breadth_decay: float = DEFAULT_BREADTH_DECAY,
        transfer_terminals: bool = True,
        use: str | None = None,
        source_breadth: float = DEFAULT_SOURCE_BREADTH,
    ):
        check_count("n_random_steps", n_random_steps)
        if is_factored(mappings):
            raise ValueError(f"mappings must be a set of which one mapping is chosen, no factored ones, got {mappings!r}")
        super().__init__(
            source,
            mappings,
            breadth=breadth,
            breadth_decay=breadth_decay,
            transfer_terminals=transfer_terminals,
            relevance=False,
            relevance_fraction=0.5,
            bandwidths=None,
            use="instances" if use is None else use,
            source_breadth=source_breadth,
        )
        self.n_random_steps = n_random_steps
        # With nothing given that says which, it depends on the target's model, and is decided when that is known.
        self._decides = use is None and breadth == DEFAULT_BREADTH and breadth_decay == DEFAULT_BREADTH_DECAY

    def arguments(self) -> dict[str, Any]:
        given = super().arguments()
        return {**given, "use": None} if self._decides else given

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        if self._decides:
            self.use = "prior" if task.takes_prior else "instances"
            self._decides = False
        super().bind(task, rng)

    def _make_selector(self, parts: SelectorParts, bandwidths: CandidateBandwidths) -> LeastErrorSelector:
        check_action_mappings(parts.candidates.sets)
        copies = copies_of(parts.candidates, parts.task, float(self.source_breadth))
        self._least_error = LeastErrorSelector(parts, copies, self.n_random_steps)
        return self._least_error

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        candidates = Candidates(self.source, self.mappings, task)
        check_action_mappings(candidates.sets)
        copies = copies_of(candidates, task, float(self.source_breadth))
        return SourcePrior(
            copies,
            task,
            partial(choose_least_error, copies, candidates.sets),
            whole=True,
            max_transitions=self.n_random_steps,
            transfer_terminals=self.transfer_terminals,
            first_renewal=self.n_random_steps,
        )

    @property
    def _n_seen(self) -> int:
        """Transitions by which is chosen that have been seen."""
        return min(self.n_random_steps, self._source_use.n_observed)

    def action(self, state: np.ndarray) -> int | None:
        if self._n_seen >= self.n_random_steps:
            return None
        assert self.task is not None
        return int(self.rng.integers(self.task.n_actions))

    def mapping_steps(self) -> int:
        """Return how many random steps of the target have been taken to find the mapping."""
        return self._n_seen

    @property
    def chosen(self) -> InterTaskMapping | None:
        """The mapping that was chosen, with names; None before."""
        assert self.task is not None
        made_by = self.source_prior if self.use == "prior" else self._least_error
        if made_by.choice is None:
            return None
        actions = tuple(made_by.choice.actions[:, 0].tolist())
        return made_by.copies.mapping(int(made_by.choice.copies[0, 0]), self.task, actions)

    def statistics(self) -> dict[str, float]:
        return {
            **super().statistics(),
            "transfer/steps_to_find_mapping": self.mapping_steps(),
            "transfer/mapping_found": float(self.chosen is not None),
        }
