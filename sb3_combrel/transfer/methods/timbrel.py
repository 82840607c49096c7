"""TIMBREL: transfer of instances through a mapping that is given (Taylor, Jong & Stone 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import MappingsLike, SourceLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.selectors import FixedSelector, PooledSelector, RandomSelector, Selector, SelectorParts
from sb3_combrel.transfer.methods.mapping_transfer import (
    DEFAULT_BREADTH,
    DEFAULT_BREADTH_DECAY,
    MappingTransfer,
)
from sb3_combrel.transfer.prior.prior_sets import make_prior
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH


class TIMBREL(MappingTransfer):
    """
    Where the target has too few instances, source instances translated by a given mapping are added to the model's.

    Paper: Taylor, Jong & Stone, "Transferring instances for model-based reinforcement learning" (ECML 2008). The
    nearest translated instances come first, until they and the target's own reach the threshold that makes a
    state-action pair known; if they cannot, nothing is transferred. A pair whose own instances suffice uses none.

    With ``use="prior"`` the source's own local linear model, seen through the mapping, is the prior of the target's model: the
    target's own instances are fitted to what it leaves over. What it claims to know without them is said in
    :class:`~sb3_combrel.transfer.prior.claims.Claims`. It needs ``FittedRMax(degree=1)``.

    ::

        right = {"Neutral": "Neutral", "West": "Left", "East": "Right", "South": "Neutral", "North": "Neutral"}
        along_x = InterTaskMapping(state={"x": "x", "vx": "v"}, action=right)
        model = FittedRMax("combrel/MountainCar4D-v0", transfer=TIMBREL(source, along_x), seed=0).learn(total_timesteps=5_000)

    :param source: source instances, a path to them, or a list of several; or the id of an
        environment, "MountainCar-v0", which is then learned by Q-learning (30,000 steps, 1000 instances) when it is first
        needed, and kept in a file; or a recipe, ``{"env": "MountainCar-v0", "total_timesteps": 50_000}``, see
        :func:`~sb3_combrel.sources.recipes.find_source`
    :param mapping: one mapping; a sequence with one mapping for each target action; "random" for a mapping of
        ``mappings`` drawn state by state (the baseline of the iCub experiment): for a state of the finite sample whenever
        it is asked for, elsewhere with each transition; or "pool" for the translations by all of ``mappings`` in one pool
        (Figure 3). With ``use="prior"`` also a ``FactoredMapping``; and "random" is drawn once, for the whole run
    :param mappings: the set that "random" and "pool" draw from: "factored" and "signed_factored" (``use="prior"`` only: of
        as many variables as possible, in as few copies as possible), "injective", "surjective", "all", "balanced", the
        paper's sets, a list of mappings or a ``MappingSet``
    :param breadth: kernel breadth of transferred instances, in unit coordinates. The paper names none; it needs to be
        wide enough for 1000 instances to cover the source.
    :param breadth_decay: factor on ``breadth`` for each episode that reaches its time limit after new evidence against what
        was transferred (the paper: none, 1): the target's own transitions were predicted worse than by "no change", or ends
        were predicted that never came, or there was nothing left to find out (see
        :class:`~sb3_combrel.transfer.instances.instances_check.InstancesCheck`). So pairs for which the source is wrong are
        explored in the end, whatever the source. A point robot among walls, from two to three dimensions by a mapping made by
        hand (``degree=0``), with a model breadth of 0.05 reached its goal in 284, 290 and 282 of 300 episodes; with a decay at
        every time limit in 175, 159 and 159, without any in 284, 288 and 282. With the default model breadth, where episodes
        seldom reach the limit, the three are alike (265 to 291).
    :param transfer_terminals: whether a source instance that ended its episode ends the target's too. The paper does not
        say. Where this is wrong the target's own transitions correct it; without it no path leads to an end at first.
    :param relevance: True: order the instances by relevance (Eq. 7) to the target's transitions, not by distance. The paper
        finds it harmful: it favours instances that are far from these. "near": by a relevance that does not, times the
        weight; see ``equations.near_relevances``
    :param relevance_fraction: mu of Eq. 4: the fraction of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of relevance; None: from the data
    :param use: "instances": translated instances fill what the target's own lack; or "prior", see above. ``breadth``,
        ``breadth_decay``, relevance and its arguments have no meaning then
    :param source_breadth: with ``use="prior"``: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if source or mapping do not fit the target
    """

    def __init__(
        self,
        source: SourceLike,
        mapping: str | InterTaskMapping | FactoredMapping | Sequence[InterTaskMapping] | dict[str, Any] = "random",
        *,
        mappings: MappingsLike = "injective",
        breadth: float = DEFAULT_BREADTH,
        breadth_decay: float = DEFAULT_BREADTH_DECAY,
        transfer_terminals: bool = True,
        relevance: bool | str = False,
        relevance_fraction: float = 0.5,
        bandwidths: tuple[float, float, float] | None = None,
        use: str = "instances",
        source_breadth: float = DEFAULT_SOURCE_BREADTH,
    ):
        if isinstance(mapping, str) and mapping not in ("random", "pool"):
            raise ValueError(f'mapping must be an InterTaskMapping, one for each action, "random" or "pool", got {mapping!r}')
        super().__init__(
            source,
            mappings if isinstance(mapping, str) else mapping,
            breadth=breadth,
            breadth_decay=breadth_decay,
            transfer_terminals=transfer_terminals,
            relevance=relevance,
            relevance_fraction=relevance_fraction,
            bandwidths=bandwidths,
            use=use,
            source_breadth=source_breadth,
        )
        if use == "prior" and isinstance(mapping, str) and mapping == "pool":
            raise ValueError('mapping must be a mapping or "random" with use="prior", got "pool"')
        self.mapping = mapping

    def arguments(self) -> dict[str, Any]:
        given = super().arguments()
        # The set has no meaning for a mapping that is given.
        return given if isinstance(self.mapping, str) else {name: each for name, each in given.items() if name != "mappings"}

    def _replace_names(self, sources: Sequence[SourceInstances], task: TargetTask) -> None:
        super()._replace_names(sources, task)
        if not isinstance(self.mapping, str):
            self.mapping = self.mappings  # type: ignore[assignment]

    def _make_selector(self, parts: SelectorParts, bandwidths: CandidateBandwidths) -> Selector:
        if isinstance(self.mapping, str):
            return PooledSelector(parts) if self.mapping == "pool" else RandomSelector(parts)
        n_given = 1 if isinstance(self.mapping, InterTaskMapping | FactoredMapping | dict) else len(self.mapping)
        n_actions = parts.task.n_actions
        if n_given not in (1, n_actions):
            raise ValueError(f"mapping must be one mapping or one for each of the {n_actions} target actions, got {n_given}")
        given = parts.candidates.sets[0]
        fixed = [parts.candidates.find(a, given[a if n_given > 1 else 0]) for a in range(n_actions)]
        return FixedSelector(parts, fixed=np.array(fixed, dtype=np.int64))

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        return make_prior(
            self.source,
            self.mappings,
            task,
            breadth=float(self.source_breadth),
            given=not isinstance(self.mapping, str),
            drawn=self.rng if isinstance(self.mapping, str) else None,
            max_transitions=0,
            transfer_terminals=self.transfer_terminals,
        )
