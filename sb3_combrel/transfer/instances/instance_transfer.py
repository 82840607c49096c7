"""Transfer of instances: translated through the mappings that are selected, and checked by what the target then does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.instances.instances_check import InstancesCheck
from sb3_combrel.transfer.instances.selectors import Ranges, Selector
from sb3_combrel.transfer.instances.translation import Translator
from sb3_combrel.transfer.outcome_evidence import RegionErrors
from sb3_combrel.transfer.report import MappingReport, TransferReport, describe_sources

# Relevance is renewed whenever this many times as many transitions are used as at the last time, from so many on.
RELEVANCE_GROWTH = 1.2
MIN_TRANSITIONS_FOR_RELEVANCE = 50


class InstanceTransfer:
    """Transfers source instances through mappings: a selector chooses the mappings, a translator the instances.

    Methods of the same name mean what they do of ``Transfer`` and of ``MappingTransfer``.

    :param breadth_decay: factor on the translator's breadth whenever the target has contradicted what was transferred
    :param measure_relevance: writes to ``values`` the relevance of each candidate's instances to the first ``n_used``
        recorded transitions; used where the translator's instances come in the order of it
    """

    def __init__(
        self, selector: Selector, translator: Translator, *, breadth_decay: float, measure_relevance: Callable[..., None]
    ):
        self.task = task = selector.task
        self.candidates = selector.candidates
        self.sources = selector.candidates.sources
        #: Number of the environment that transitions come from.
        self.environment = 0
        #: Transitions of the target that were observed.
        self.n_observed = 0
        self.transitions = selector.transitions
        self.selector = selector
        self.makes_choices = selector.makes_choices
        self.translator = translator
        self.breadth_decay = breadth_decay
        self.measure_relevance = measure_relevance
        self._by_relevance = translator.rules.by_relevance
        # Recorded transitions that relevance was last measured by.
        self._n_of_relevance = 0
        #: Compares what was transferred with what happened, wherever the agent acted on it.
        self.check = InstancesCheck(self.sources)
        #: Errors of what was transferred.
        self.errors = RegionErrors(task)
        #: Whether what has been returned for any state of the sample may have changed. Nothing has where the selection depends
        #: on transitions.
        self.all_changed = not selector.needs_transitions
        self._last_selected: Ranges = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        self._last_state = np.empty(0)
        self._uses: Counter[int] = Counter()
        self._instances_used = 0

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        self._last_selected = self.selector.select(states, actions, own_weight)
        self._last_state = states[0]
        return self.translator(states, own_weight, self._last_selected)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        selected = self.selector.select_at_sample(points, actions, own_weight)
        return self.translator(self.task.sample_states[points], own_weight, selected)

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        # The selector selects anew here, so it is asked in any case.
        of_selector = self.selector.changed(known)
        if self.all_changed:
            self.all_changed = False
            return True
        return of_selector

    def observe(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        """Take in a transition of the target; ``effect``: next state minus state, unit coordinates, shape (n_variables,)."""
        self.n_observed += 1
        self.check.evidence.environment = self.environment
        predicted = self.check.observe(state, action, reward, effect, terminated)
        if predicted is not None:
            self.errors.note(state, action, effect, predicted)
        selector = self.selector
        selector.before_transition()
        if (self._by_relevance or selector.needs_transitions) and selector.takes_transitions():
            selector.add_transition(self.transitions.add(state, action, reward, effect))
            n_used = selector.n_used()
            if self._by_relevance and n_used >= max(MIN_TRANSITIONS_FOR_RELEVANCE, RELEVANCE_GROWTH * self._n_of_relevance):
                self._renew_relevance(n_used)

    def break_off(self) -> None:
        self.check.break_off()

    def end_episode(self, truncated: bool) -> None:
        """Narrow the kernel if the target has contradicted what was transferred: else nothing would ever be explored."""
        self.check.evidence.environment = self.environment
        if self.check.end_episode(truncated) and self.breadth_decay < 1.0:
            self.translator.set_breadth(self.translator.rules.breadth * self.breadth_decay)
            self.all_changed = True
        if self.selector.end_episode() and self._by_relevance:
            self._renew_relevance(self.selector.n_used())

    def note_use(self, transferred: TransferredInstances) -> None:
        first, _ = self._last_selected
        self.check.note_use(self._last_state, transferred, len(first))
        for candidate, n in zip(first.tolist(), transferred.length[: len(first)].tolist(), strict=True):
            if n > 0 and self.selector.selects_one:
                self._uses[candidate] += 1
            self._instances_used += n

    def _renew_relevance(self, n_used: int) -> None:
        self.measure_relevance(n_used=n_used, values=self.translator.relevance)
        self._n_of_relevance = n_used
        # Another order, for all states: one that is asked for when it is loaded must not differ from the others.
        self.all_changed = True

    def choices(self) -> np.ndarray:
        return self.selector.choices()

    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        first, last = self.selector.select(states, actions, np.zeros(len(actions)))
        return np.where(last - first == 1, first, -1)

    def uses(self) -> dict[int, int]:
        return dict(self._uses)

    def statistics(self) -> dict[str, float]:
        return {
            "transfer/instances_used": self._instances_used,
            "transfer/uses": sum(self._uses.values()),
            "transfer/mappings_used": len(self._uses),
            "transfer/prediction_error": self.check.error(),
            "transfer/breadth": self.translator.rules.breadth,
            **self.selector.statistics(),
        }

    def report(self, method: str, statistics: Mapping[str, float]) -> TransferReport:
        """Report what was transferred; ``method``: with its arguments, ``statistics``: its figures of the log."""
        evidence = self.check.evidence
        return TransferReport(
            method=method,
            use="instances",
            sources=describe_sources(self.sources),
            n_steps=self.n_observed,
            n_rested=self.check.n_compared,
            mappings=tuple(map(self._mapping_report, range(self.task.n_actions))),
            error=self.errors.error(),
            ends=(evidence.confirmed, evidence.contradicted),
            rewards=(evidence.rewards_right, evidence.rewards_wrong),
            statistics=statistics,
            source_actions=tuple(self.candidates.source_action_names()),
            **self.errors.report_fields(),
        )

    def _mapping_report(self, action: int) -> MappingReport:
        """Report the mapping of a target action whose instances were used most."""
        parts_of = {each: self.candidates.parts(each) for each in self._uses}
        of_action = {each: n for each, n in self._uses.items() if parts_of[each].target_action == action}
        compared = int(self.errors.of_actions[action, 0])
        words, share = "many mappings at once" if compared else "nothing was transferred", np.nan
        if of_action:
            best = max(of_action, key=lambda each: (of_action[each], -each))
            words = f"{parts_of[best].source_action} with {parts_of[best].state_mapping}"
            share = of_action[best] / sum(of_action.values())
        return MappingReport(
            target_action=self.task.action_names[action],
            mapping=words,
            share=share,
            n_mappings=len(of_action),
            error=float(self.errors.errors()[action]),
            n_compared=compared,
            **self.selector.confidence(action),
        )

    def get_state(self) -> dict[str, np.ndarray]:
        uses = np.zeros(len(self.candidates))
        uses[list(self._uses)] = list(self._uses.values())
        return {
            "transitions": self.transitions.rows(),
            "breadth": np.array([self.translator.rules.breadth]),
            "uses": uses,
            "instances_used": np.array([float(self._instances_used)]),
            "check": self.check.get_state(),
            "visits": self.check.evidence.visits,
            "errors": np.concatenate([[float(self.n_observed)], self.errors.sums.ravel()]),
            **({"relevance_of": np.array([float(self._n_of_relevance)])} if self._by_relevance else {}),
            **self.selector.get_state(),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self.translator.set_breadth(float(state["breadth"][0]))
        self.transitions.restore(state["transitions"], self.task.n_actions)
        self.selector.set_state(state)
        used = np.flatnonzero(state["uses"] >= 1.0)
        self._uses = Counter(dict(zip(used.tolist(), state["uses"][used].astype(np.int64).tolist(), strict=True)))
        self._instances_used = int(state["instances_used"][0])
        self.check.set_state(state["check"])
        self.check.evidence.visits = state["visits"]
        self.n_observed = int(state["errors"][0])
        self.errors.sums.ravel()[:] = state["errors"][1:]
        if self._by_relevance:
            n = min(int(state["relevance_of"][0]), self.selector.n_used())
            if n > 0:
                self._renew_relevance(n)
        if self.n_observed > 0:
            # All pairs of the sample are asked for again with what is restored here.
            self.all_changed = False
