"""COMBREL's selector: Algorithm 1, for states of the sample and for exact states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.compliance import ComplianceTable
from sb3_combrel.transfer.instances.nearest_transitions import ComplianceCache, add_to_sample, choose, select
from sb3_combrel.transfer.instances.selectors import Ranges, Selector, ranges_of

# Within an episode choices are renewed whenever this many times as much has been recorded as at the last time: to plan again
# with every transition would cost more than all the rest.
CHOICE_GROWTH = 1.2
# The confidence in choices is averaged over so many states of the sample, at most, evenly spread.
MAX_COMPARED = 500
NO_DRAWS = np.empty(0)


@dataclass(frozen=True)
class SelectionOptions:
    """How candidates are selected by compliance; most are arguments of COMBREL."""

    bandwidths: CandidateBandwidths
    n_neighbors: int
    all_actions: bool  # transitions of all actions are neighbours, not those with the same action; for whole mappings
    neighbor_radius: float | None
    drawn: bool  # candidates are drawn in proportion to their mean compliance, instead of line 20
    online: bool  # transitions of all episodes are recorded and used at once, not those of the first after its end
    max_transitions: int
    min_evidence: float
    min_compliance: float


class ComplianceSelector(Selector):
    """Selects the candidate with the highest mean compliance with the nearest recorded transitions (Algorithm 1).

    The compliance of a transition (lines 9-13) is computed when a choice first needs it.
    """

    makes_choices = True
    needs_transitions = True

    def __init__(self, candidates: Candidates, options: SelectionOptions, rng: np.random.Generator):
        super().__init__(candidates)
        self.options, self.rng, self.max_transitions = options, rng, options.max_transitions
        n_actions, n_points = self.task.n_actions, len(self.task.sample_states)
        n_pairs, n_neighbors = n_actions * n_points, options.n_neighbors
        # An empty place counts as a neighbour at the limit: what is farther away does not enter.
        limit = np.inf if options.neighbor_radius is None else float(options.neighbor_radius) ** 2
        self._limits = float(self.task.exploration_threshold), limit
        self.first_episode = True
        self.n_switches = 0
        self._table = ComplianceTable(candidates, options.bandwidths, options.min_evidence)
        # Where in the table the candidates of each action stand.
        columns = candidates.arrays.row * len(candidates.instances.size) + candidates.arrays.action
        self._columns = np.split(columns, self.first[1:-1])
        self._cache = ComplianceCache.empty(int(np.diff(self.first).max()))
        self._listed = np.empty((n_actions, 64), dtype=np.int64)
        self._n_listed = np.zeros(n_actions, dtype=np.int64)
        # Variable by variable: the loop over all states reads them in a row.
        self._periodic = np.array(self.task.periodic)
        self._sample = np.ascontiguousarray(self.task.sample_states.T), self._periodic
        self._apart = np.empty(n_points)
        # Of the pairs of the sample: their nearest transitions, how far these are, what is chosen, and whether that is due.
        self._near = np.full((n_pairs, n_neighbors), -1, dtype=np.int64)
        self._distance = np.full((n_pairs, n_neighbors), limit)
        self._choice = np.full(n_pairs, -1, dtype=np.int64)
        self._due = np.zeros(n_pairs, dtype=np.bool_)
        self._renewal_due = 0.0
        # Nothing is asked before the first transition. To draw here would change what a loaded model draws.
        self._draws_at = np.zeros(n_actions) if options.drawn else NO_DRAWS

    def before_transition(self) -> None:
        # With each transition, not with each question: a prediction asked for twice is the same, and leaves no trace.
        self._draws_at = self._draws(self.task.n_actions)

    def takes_transitions(self) -> bool:
        return super().takes_transitions() and (self.first_episode or self.options.online)

    def add_transition(self, i: int) -> None:
        if self.options.online:
            self._use(i)

    def n_used(self) -> int:
        return self.transitions.n if self.options.online or not self.first_episode else 0

    def end_episode(self) -> bool:
        # At an episode's end there is time to renew all choices that are due.
        self._renewal_due = 0.0
        ends_recording = self.first_episode and not self.options.online
        if ends_recording:
            for i in range(self.transitions.n):
                self._use(i)
        self.first_episode = False
        return ends_recording

    def _measure(self, near: np.ndarray) -> None:
        """Compute the compliance with every candidate of those of these transitions that have not been measured yet."""
        near = near[near >= 0]
        for i in set(near[~self._cache.measured[near]].tolist()):
            self._table.measure(self.transitions, i)
            compliance = self._table.values.ravel()[self._columns[int(self.transitions.actions[i])]]
            self._cache.compliance[i, : len(compliance)] = compliance
            self._cache.required[i] = self.options.min_compliance * self._table.no_change(self.transitions, i)
            self._cache.measured[i] = True

    def select(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        n, n_neighbors = len(actions), self.options.n_neighbors
        near, distance = np.empty((n, n_neighbors), dtype=np.int64), np.empty((n, n_neighbors))
        ranges = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
        query = states, actions, own_weight
        recorded = self.transitions.states, self._listed, self._n_listed, self._periodic
        given = query, recorded, self._limits, tuple(self._cache), self.first, self._draws_at
        while not select.call(*given, (near, distance, *ranges)):
            self._measure(near)
        return ranges

    def select_at_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> Ranges:
        return ranges_of(self._choice[actions * len(self.task.sample_states) + points])

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        if self.transitions.n < self._renewal_due:
            return False
        self._renewal_due = CHOICE_GROWTH * self.transitions.n
        changed = np.zeros(known.shape, dtype=np.bool_)
        changed.ravel()[self._renew(np.flatnonzero(self._due & ~known.ravel()))] = True
        return changed

    def _use(self, i: int) -> None:
        """Make transition ``i`` a neighbour for its action, or for all, also of sample states."""
        if i >= len(self._cache.required):
            self._cache = self._cache.grown()
        for action in range(self.task.n_actions) if self.options.all_actions else [int(self.transitions.actions[i])]:
            n = self._n_listed[action]
            if n == self._listed.shape[1]:
                self._listed = np.concatenate([self._listed, np.empty_like(self._listed)], axis=1)
            self._listed[action, n] = i
            self._n_listed[action] += 1
            pairs = slice(action * len(self._apart), (action + 1) * len(self._apart))
            of_action = self._near[pairs], self._distance[pairs], self._due[pairs]
            add_to_sample.call(i, self.transitions.states[i], self._sample, *of_action, self._apart)

    def _renew(self, pairs: np.ndarray) -> np.ndarray:
        """Renew the choices of pairs of the sample; return those that changed."""
        self._measure(self._near[pairs])
        rows, actions = pairs.copy(), pairs // len(self.task.sample_states)
        draws = self._draws(len(pairs))
        n_changed = int(choose.call(rows, actions, self._near, tuple(self._cache), self.first, draws, self._choice))
        self._due[pairs] = False
        self.n_switches += n_changed
        return rows[:n_changed]

    def _draws(self, n: int) -> np.ndarray:
        """Draw random numbers for so many choices, if they are drawn."""
        return self.rng.random(n) if self.options.drawn else NO_DRAWS

    def choices(self) -> np.ndarray:
        return self._choice.copy()

    def mean_compliance(self, pairs: np.ndarray) -> np.ndarray:
        """Return the mean compliance of the chosen candidate of pairs of the sample (line 19); NaN where nothing is chosen."""
        near = self._near[pairs]
        self._measure(near)
        chosen = self._choice[pairs]
        counted = (near >= 0) & (chosen >= 0)[:, None]
        column = np.maximum(chosen - self.first[pairs // len(self.task.sample_states)], 0)
        compliance = self._cache.compliance[np.maximum(near, 0), column[:, None]]
        n_counted = counted.sum(axis=1)
        total = np.where(counted, compliance, 0.0).sum(axis=1)
        return np.where(n_counted > 0, total / np.maximum(n_counted, 1), np.nan)

    def confidence(self, action: int) -> dict[str, Any]:
        n_points = len(self.task.sample_states)
        pairs = action * n_points + np.arange(n_points)
        # What is known needs no choice any more, and its choice is not renewed.
        pairs = pairs[(self._choice[pairs] >= 0) & ~self._due[pairs]]
        if len(pairs) == 0:
            return {}
        if len(pairs) > MAX_COMPARED:
            pairs = pairs[(np.arange(MAX_COMPARED) * (len(pairs) / MAX_COMPARED)).astype(np.int64)]
        self._measure(self._near[pairs])
        n_candidates, compared = int(self.first[action + 1] - self.first[action]), []
        for near, candidate in zip(self._near[pairs], self._choice[pairs].tolist(), strict=True):
            near = near[near >= 0]
            mean, chosen = self._cache.compliance[near, :n_candidates].mean(axis=0), candidate - self.first[action]
            no_change = np.mean([self._table.no_change(self.transitions, i) for i in near.tolist()])
            compared.append((mean[chosen], np.delete(mean, chosen).max(initial=-np.inf), no_change))
        compliance, next_best, no_change = np.array(compared).mean(axis=0).tolist()
        next_best = next_best if n_candidates > 1 else np.nan
        return {"compliance": compliance, "next_best_compliance": next_best, "no_change_compliance": no_change}

    def get_state(self) -> dict[str, np.ndarray]:
        return {
            "first_episode": np.array([float(self.first_episode)]),
            "renewal_due": np.array([float(self._renewal_due)]),
            "switches": np.array([float(self.n_switches)]),
            "choice": self._choice.astype(np.float64),
            "vote_due": self._due.astype(np.float64),
            "draws_at": self._draws_at,
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self.first_episode = bool(state["first_episode"][0] > 0.5)
        for i in range(self.n_used()):
            self._use(i)
        first, last = self.first[:-1, None], self.first[1:, None] - 1
        chosen = state["choice"].astype(np.int64).reshape(self.task.n_actions, -1)
        self._choice[:] = np.where(chosen < 0, -1, np.clip(chosen, first, last)).ravel()
        self._due[:] = state["vote_due"] > 0.5
        self._draws_at = np.clip(state["draws_at"], 0.0, 1.0)
        self._renewal_due = float(state["renewal_due"][0])
        self.n_switches = int(state["switches"][0])

    def sample_moved(self) -> None:
        before = self.n_switches
        self._choice[:] = -1
        self._renew(np.flatnonzero(self._near[:, 0] >= 0))
        self.n_switches = before

    def statistics(self) -> dict[str, float]:
        chosen = self._choice[self._choice >= 0]
        shares = np.bincount(chosen) / max(len(chosen), 1)
        shares = shares[shares > 0.0]
        return {
            "transfer/switches": self.n_switches,
            "transfer/choice_entropy": float(-(shares * np.log(shares)).sum()),
            "transfer/distinct_mappings": len(shares),
            "transfer/target_transitions": self.transitions.n,
        }
