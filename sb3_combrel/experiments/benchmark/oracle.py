"""The known mapping from several sources: each of some copies in the target is of one of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel import TIMBREL, FactoredMapping
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import SourceLike, load_sources
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.prior_choice import Choice
from sb3_combrel.transfer.prior.source_prior import SourcePrior


class KnownCopies(TIMBREL):
    """TIMBREL with priors from several sources, each through a factored mapping; no two have a target variable in common."""

    def __init__(self, source: SourceLike, mapping: Sequence[FactoredMapping]):
        super().__init__(source, FactoredMapping(tuple(copy for each in mapping for copy in each.copies)), use="prior")
        self.by_source = tuple(mapping)

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        sources = load_sources(self.source)
        for source, mapping in zip(sources, self.by_source, strict=True):
            mapping.check(
                n_source_variables=source.n_variables,
                n_target_variables=task.n_variables,
                n_source_actions=source.n_actions,
                n_target_actions=task.n_actions,
            )
        copies = [copy for mapping in self.by_source for copy in mapping.copies]
        numbers = np.repeat(np.arange(len(sources)), [len(mapping.copies) for mapping in self.by_source])
        state, sign = (np.array([getattr(copy, name) for copy in copies]) for name in ("state_index", "state_sign"))
        actions = np.array([copy.action for copy in copies], dtype=np.int64).T.copy()
        choice = Choice(np.tile(np.arange(len(copies)), (task.n_actions, 1)), actions)
        made = Copies(sources, numbers, state, sign, float(self.source_breadth))
        return SourcePrior(
            made, task, choice, whole=False, max_transitions=0, transfer_terminals=bool(self.transfer_terminals)
        )
