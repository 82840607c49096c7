"""TIMBREL: transfer of instances through a mapping that is given (Taylor, Jong & Stone 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.selectors import FixedSelector, PooledSelector, RandomSelector, Selector
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.prior.prior_sets import check_one_source, mapping_of_each_action
from sb3_combrel.transfer.prior.source_prior import SourcePrior


@dataclass(repr=False, eq=False)
class TIMBREL(MappingTransfer):
    """Where the target has too few instances, source instances translated by a given mapping are added to the model's.

    Paper: Taylor, Jong & Stone, "Transferring instances for model-based reinforcement learning" (ECML 2008). The nearest
    translated instances come first, until they and the target's own reach the threshold that makes a state-action pair known;
    if they cannot, nothing is transferred. A pair whose own instances suffice uses none.

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`.

    ::

        right = {"Neutral": "Neutral", "West": "Left", "East": "Right", "South": "Neutral", "North": "Neutral"}
        along_x = InterTaskMapping(state={"x": "x", "vx": "v"}, action=right)
        model = FittedRMax("combrel/MountainCar4D-v0", transfer=TIMBREL(source, along_x), seed=0).learn(total_timesteps=5_000)

    :param mapping: one mapping; a sequence with one mapping for each target action; "random" for a mapping of ``mappings``
        drawn state by state (the baseline of the iCub experiment): for a state of the finite sample whenever it is asked for,
        elsewhere with each transition; or "pool" for the translations by all of ``mappings`` in one pool (Figure 3). With
        ``use="prior"`` also a ``FactoredMapping``; and "random" is drawn once, for the whole run. None: "random", with a
        warning
    :param mappings: the set that "random" and "pool" draw from; also "factored" and "signed_factored" (``use="prior"`` only:
        of as many variables as possible, in as few copies as possible)
    :raises ValueError: if an argument is out of range; when learning starts, if source or mapping do not fit the target
    """

    of_prior: ClassVar[tuple[str, ...]] = (*MappingTransfer.of_prior, "mapping")

    mapping: str | InterTaskMapping | FactoredMapping | Sequence[InterTaskMapping] | dict[str, Any] | None = None
    mappings: MappingsLike = field(default="injective", kw_only=True)

    def __post_init__(self) -> None:
        if self.mapping is None:
            warn_user(
                "mapping is left out, and random ones are drawn, which is the control: give mapping=InterTaskMapping(...), or "
                '"random" where that is meant; COMBREL(source) finds a mapping itself'
            )
            self.mapping = "random"
        if isinstance(self.mapping, str):
            if self.mapping not in ("random", "pool"):
                message = 'mapping must be an InterTaskMapping, one for each action, "random" or "pool", got'
                raise ValueError(f"{message} {self.mapping!r}")
            if self.use == "prior" and self.mapping == "pool":
                raise ValueError('mapping must be a mapping or "random" with use="prior", got "pool"')
        else:
            self.mappings = self.mapping
        super().__post_init__()

    def arguments(self) -> dict[str, Any]:
        given = super().arguments()
        # The set has no meaning for a mapping that is given.
        return given if isinstance(self.mapping, str) else {name: each for name, each in given.items() if name != "mappings"}

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        drawn = None
        if self.task is not None and self.rng is rng and self.use == "prior" and isinstance(self.mapping, str):
            # The same agent in other unit coordinates: what was drawn for the whole run stays.
            drawn = self.source_prior.choice
        super().bind(task, rng)
        if drawn is not None:
            self.source_prior.set_choice(drawn)
        if not isinstance(self.mapping, str):
            # With numbers in place of names.
            self.mapping = self.mappings  # type: ignore[assignment]

    def _make_selector(self, candidates: Candidates, bandwidths: CandidateBandwidths) -> Selector:
        if isinstance(self.mapping, str):
            return PooledSelector(candidates) if self.mapping == "pool" else RandomSelector(candidates, self.rng)
        check_one_source(candidates.sources)
        each = mapping_of_each_action(candidates.sets[0], candidates.task.n_actions)
        fixed = [candidates.find(a, x.state_index, x.state_sign, x.action[a]) for a, x in enumerate(each)]
        return FixedSelector(candidates, fixed=np.array(fixed, dtype=np.int64))

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        is_given = not isinstance(self.mapping, str)
        return self._prior_of_set(task, given=is_given, drawn=None if is_given else self.rng)
