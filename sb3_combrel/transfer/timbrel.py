"""TIMBREL: transfer of instances through a mapping that is given (Taylor, Jong & Stone 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_combrel.common.transferred import Supply
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.mapping_transfer import (
    DEFAULT_BREADTH,
    DEFAULT_FADING,
    MappingsLike,
    SourceLike,
    VirtualSourceTransfer,
)

RELEVANCE_RENEWAL = 1.2


class TIMBREL(VirtualSourceTransfer):
    """
    Where the target has too few instances, source instances are translated by a given mapping and join the model.

    Paper: Taylor, Jong & Stone, "Transferring instances for model-based reinforcement learning" (ECML 2008). The
    nearest translated instances come first, until they and the target's own reach the threshold that makes a
    state-action pair known; if they cannot, nothing is transferred. A pair whose own instances suffice uses none.

    :param source: source instances, a path to them, or a list of several
    :param mapping: one mapping; a sequence with one mapping for each target action; "random" for a mapping of
        ``mappings`` drawn anew with each transition (the baseline of the iCub experiment); or "pool" for the translations
        by all of ``mappings`` in one pool (Figure 3)
    :param mappings: the set that "random" and "pool" draw from: "injective", "surjective", "all", "balanced", the
        paper's sets, a list of mappings or a ``MappingSet``
    :param breadth: kernel breadth of transferred instances, in unit coordinates. The paper names none; it needs to be
        wide enough for 1000 instances to cover the source.
    :param fading: factor on ``breadth`` for each episode that runs into its time limit (the paper: none, 1). Whatever
        the source, pairs that it settled wrongly are explored in the end.
    :param believe_terminal: whether a source instance that ended its episode ends the target's too. The paper does not
        say. What is wrong with it the target's own transitions soon tell; without it nothing leads to an end at first.
    :param relevance: order the instances by relevance (Eq. 7) to the target's transitions, not by distance. The paper
        finds it harmful.
    :param relevance_fraction: mu of Eq. 4: the part of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of relevance; None: from the data
    :raises ValueError: if an argument is out of range; when learning starts, if source or mapping do not fit the target
    """

    def __init__(
        self,
        source: SourceLike,
        mapping: str | InterTaskMapping | Sequence[InterTaskMapping] | dict[str, Any] = "random",
        *,
        mappings: MappingsLike = "injective",
        breadth: float = DEFAULT_BREADTH,
        fading: float = DEFAULT_FADING,
        believe_terminal: bool = True,
        relevance: bool = False,
        relevance_fraction: float = 0.5,
        bandwidths: tuple[float, float, float] | None = None,
    ):
        if isinstance(mapping, str) and mapping not in ("random", "pool"):
            raise ValueError(f'mapping must be an InterTaskMapping, one for each action, "random" or "pool", got {mapping!r}')
        super().__init__(
            source,
            mappings if isinstance(mapping, str) else mapping,
            breadth=breadth,
            fading=fading,
            believe_terminal=believe_terminal,
            relevance=relevance,
            relevance_fraction=relevance_fraction,
            bandwidths=bandwidths,
        )
        self.mapping = mapping

    def bind(self, target: TargetTask, rng: np.random.Generator) -> None:
        super().bind(target, rng)
        given = [self.mapping] if isinstance(self.mapping, InterTaskMapping | dict) else self.mapping
        if not isinstance(given, str) and len(given) not in (1, target.n_actions):
            raise ValueError(
                f"mapping must be one mapping or one for each of the {target.n_actions} target actions, got {len(given)}"
            )
        self._fixed = None if isinstance(given, str) else self._candidate_of_each_action(len(given))
        self._span_at = self._span(np.arange(target.n_actions))
        self._all_renewed = True

    def _candidate_of_each_action(self, n_given: int) -> np.ndarray:
        """The candidate that the mapping given for each action amounts to there (of the first source)."""
        assert self.target is not None
        chosen = np.empty(self.target.n_actions, dtype=np.int64)
        mappings: MappingSet = self._sets[0]
        for a in range(self.target.n_actions):
            mapping = mappings[a if n_given > 1 else 0]
            chosen[a] = next(
                c
                for c in range(self._ways.first[a], self._ways.first[a + 1])
                if np.array_equal(self._table.index[self._ways.row[c]], mapping.state_index)
                and np.array_equal(self._table.sign[self._ways.row[c]], mapping.state_sign)
                and self._ways.action[c] == mapping.action[a]
            )
        return chosen

    @property
    def makes_choices(self) -> bool:
        return not isinstance(self.mapping, str)

    def choices(self) -> np.ndarray:
        if self._fixed is None:
            return super().choices()
        assert self.target is not None
        return np.repeat(self._fixed, len(self.target.sample_states))

    def _most_ways_at_once(self) -> int:
        return int(np.diff(self._ways.first).max()) if self.mapping == "pool" else 1

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        # Random ones anew with each transition, not with each question: a prediction asked for twice is the same, and
        # leaves no trace.
        if self.mapping == "random":
            self._span_at = self._span(np.arange(len(self._span_at[0])))
        if not self.relevance:
            return
        self._seen.add(state, action, reward, next_state - state)
        if self._seen.n >= max(50, RELEVANCE_RENEWAL * self._merit_of):
            self._renew_relevance()

    def _span(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The candidates from which each pair may draw."""
        first, last = self._ways.first[actions], self._ways.first[actions + 1]
        if self.mapping == "pool":
            return first, last
        chosen = self._rng.integers(first, last) if self._fixed is None else self._fixed[actions]
        return chosen, chosen + 1

    def supply(self, pairs: np.ndarray, own_weight: np.ndarray, known: np.ndarray) -> Supply:
        assert self.target is not None
        n_points = len(self.target.sample_states)
        first, last = self._span(pairs // n_points)
        states = self.target.sample_states[pairs % n_points]
        self._supply = self._draw(states, own_weight, first, np.where(known, first, last), self._supply)
        return self._supply

    def supply_at(self, state: np.ndarray, own_weight: np.ndarray) -> Supply:
        if (own_weight >= self._rules.threshold).all():
            return self._nothing_for(len(own_weight))
        return self._draw_at(state, own_weight, *self._span_at)
