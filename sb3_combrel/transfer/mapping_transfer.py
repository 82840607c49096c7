"""What TIMBREL and COMBREL share: a selector of mappings, and a translator of source instances."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.common.checks import check_positive
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.prior import PriorPredictions
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.mappings.inter_task_mapping import MappingNames
from sb3_combrel.mappings.named_sets import check_mappings, with_numbers
from sb3_combrel.sources.recipes import check_source
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.bandwidths import default_bandwidths, start_bandwidths
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import (
    Candidate,
    Candidates,
    MappedVariables,
    MappingsLike,
    SourceLike,
    load_sources,
)
from sb3_combrel.transfer.equations import Bandwidths
from sb3_combrel.transfer.explaining import describe_sources, mappings_of_instances, report_of_prior
from sb3_combrel.transfer.instances_check import InstancesCheck
from sb3_combrel.transfer.placed_errors import PlacedErrors
from sb3_combrel.transfer.prior_sets import is_factored
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions
from sb3_combrel.transfer.relevance import renew_near_relevance, renew_relevance
from sb3_combrel.transfer.renamed import warn_of_name
from sb3_combrel.transfer.report import TransferReport
from sb3_combrel.transfer.selectors import Ranges, Selector
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH
from sb3_combrel.transfer.source_prior import SourcePrior
from sb3_combrel.transfer.translation import Translator

DEFAULT_BREADTH = 0.3
DEFAULT_BREADTH_DECAY = 0.8
# Relevance is renewed whenever this many times as many transitions are used as at the last time, from so many on.
RELEVANCE_GROWTH = 1.2
MIN_TRANSITIONS_FOR_RELEVANCE = 50
#: The relevance that does not favour distant instances, ``equations.near_relevances``.
NEAR = "near"

#: Arguments of TIMBREL and COMBREL by their former names.
RENAMED_ARGUMENTS = {
    "fading": "breadth_decay",
    "believe_terminal": "transfer_terminals",
    "voting_radius": "neighbor_radius",
}
_RENAMED_ATTRIBUTES = {**RENAMED_ARGUMENTS, "target": "task", "way": "candidate"}


class MappingTransfer(Transfer):
    """
    Translates source instances through mappings: a selector chooses the mappings, a translator the instances.

    :param source: instances, a path to them, the id or recipe of a task to learn them from, or a list of several
    :param mappings: mappings from the target to the source (see ``resolve``)
    :param breadth: kernel breadth of transferred instances, in unit coordinates
    :param breadth_decay: factor on ``breadth`` for each episode that reaches its time limit after the target's own transitions
        have contradicted what was transferred (see :class:`~sb3_combrel.transfer.instances_check.InstancesCheck`)
    :param transfer_terminals: whether a source instance that ended its episode ends the target's
    :param relevance: whether instances come in the order of their relevance (Eq. 7), not of their distance; "near": of the
        relevance that does not favour distant instances, times their weight
    :param relevance_fraction: mu of Eq. 4
    :param bandwidths: (start, outcome, reward) of compliance and relevance; None: from the data
    :param use: "instances" or "prior": translated instances, or the source's own model seen through the mappings
    :param source_breadth: kernel breadth of the source's own model, in unit coordinates of the source
    """

    renamed_arguments = RENAMED_ARGUMENTS

    #: Whether relevance, where it is asked for, is the order in which instances are added.
    ranks_by_relevance: ClassVar[bool] = True

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike,
        *,
        breadth: float,
        breadth_decay: float,
        transfer_terminals: bool,
        relevance: bool | str,
        relevance_fraction: float,
        bandwidths: tuple[float, float, float] | None,
        use: str = "instances",
        source_breadth: float = DEFAULT_SOURCE_BREADTH,
    ):
        if use not in ("instances", "prior"):
            raise ValueError(f'use must be "instances" or "prior", got {use!r}')
        if use == "instances" and is_factored(mappings):
            raise ValueError(f'factored mappings need use="prior", got use="instances" with {mappings!r}')
        if use == "prior" and relevance:
            raise ValueError('relevance must be False with use="prior": no instances are transferred, got True')
        check_source(source)
        check_mappings(mappings)
        check_positive("source_breadth", source_breadth)
        check_positive("breadth", breadth)
        check_positive("breadth_decay", breadth_decay, max=1.0)
        check_positive("relevance_fraction", relevance_fraction, max=1.0)
        if bandwidths is not None:
            if isinstance(bandwidths, str) or not isinstance(bandwidths, Sequence | np.ndarray) or len(bandwidths) != 3:
                raise ValueError(f"bandwidths must be three numbers (start, outcome, reward) or None, got {bandwidths!r}")
            for value in bandwidths:
                check_positive("bandwidths", value)
        check_boolean("transfer_terminals", transfer_terminals)
        check_relevance(relevance)
        self.source = source
        self.mappings = mappings
        self.breadth = breadth
        self.breadth_decay = breadth_decay
        self.transfer_terminals = bool(transfer_terminals)
        self.relevance = relevance if isinstance(relevance, str) else bool(relevance)
        self.relevance_fraction = relevance_fraction
        self.bandwidths = bandwidths
        self.use = use
        self.source_breadth = source_breadth

    def __getattr__(self, name: str) -> Any:
        # Called only for what is not there otherwise.
        if name not in _RENAMED_ATTRIBUTES:
            self._check_bound(name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        warn_of_name(name, _RENAMED_ATTRIBUTES[name])
        return getattr(self, _RENAMED_ATTRIBUTES[name])

    # ----------------------------------------------------------------- binding

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        sources = load_sources(self.source)
        # Once read, the instances themselves: the file of a saved model must not depend on other files.
        self.source = sources if len(sources) > 1 else sources[0]
        self._replace_names(sources, task)
        self._periodic = np.array(task.periodic)
        self._wraps = bool(self._periodic.any())
        if self.use == "prior":
            self._prior = self._make_prior(task)
            return
        self.candidates = Candidates(self.source, self.mappings, task, self._whole_mappings())
        self._choose_bandwidths()
        self._transitions = RecordedTransitions(task.n_variables)
        self._by_relevance = bool(self.relevance) and self.ranks_by_relevance
        self._translator = self._make_translator(self.candidates, task)
        self._selector = self._make_selector(task)
        self._last_selected: Ranges = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        self._last_state = np.empty(0)
        self._check = InstancesCheck(self.candidates.sources, float(task.exploration_threshold))
        self._uses: Counter[int] = Counter()
        self._instances_used = 0
        self._n_steps = 0
        self._errors = PlacedErrors(task)
        self._n_of_relevance = 0
        # What has been returned for any state of the sample may have changed.
        self._all_changed = True

    def _replace_names(self, sources: Sequence[SourceInstances], task: TargetTask) -> None:
        """Replace names of variables and actions in mappings by their numbers, now that both tasks are known."""
        names = [
            MappingNames(each.state_names, tuple(task.state_names), each.action_names, tuple(task.action_names))
            for each in sources
        ]
        self.mappings = with_numbers(self.mappings, names)

    def _whole_mappings(self) -> bool:
        """Return whether whole mappings are the candidates."""
        return False

    def _choose_bandwidths(self) -> None:
        """Take the bandwidths given, the same for all mappings; or choose them from the data."""
        if self.bandwidths is None:
            self._bandwidths = default_bandwidths(self.candidates.instances)
            self._starts = start_bandwidths(self.candidates, self._bandwidths.start)
        else:
            self._bandwidths = Bandwidths(*self.bandwidths)
            self._starts = np.full(len(self.candidates.table.variable), self._bandwidths.start)

    def _make_translator(self, candidates: Candidates, task: TargetTask) -> Translator:
        """Make the translator of the instances of some candidates."""
        return Translator(
            candidates,
            task,
            breadth=float(self.breadth),
            transfer_terminals=self.transfer_terminals,
            by_relevance=self._by_relevance,
            times_weight=self._by_relevance and self.relevance == NEAR,
        )

    @abstractmethod
    def _make_selector(self, task: TargetTask) -> Selector:
        """Make the selector for the target task that the method was just bound to."""

    @abstractmethod
    def _make_prior(self, task: TargetTask) -> SourcePrior:
        """Make the prior of the target task that the method was just bound to."""

    @property
    def sources(self) -> list[SourceInstances]:
        """The source tasks' instances, once bound."""
        return list(self._prior.copies.sources) if self.use == "prior" else self.candidates.sources

    # ------------------------------------------------------------------ asking

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        if self.use == "prior":
            return TransferredInstances.empty(len(actions), states.shape[1])
        self._last_selected = self._selector.select(states, actions, own_weight)
        self._last_state = states[0]
        return self._translator(states, own_weight, self._last_selected)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        assert self.task is not None
        if self.use == "prior":
            return TransferredInstances.empty(len(actions), self.task.n_variables)
        selected = self._selector.select_at_sample(points, actions, own_weight)
        return self._translator(self.task.sample_states[points], own_weight, selected)

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        return self._prior.predict(states, actions)

    def prior_version(self) -> int:
        return self._prior.version

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        if self.use == "prior":
            return False
        if self._all_changed:
            self._all_changed = False
            return True
        return self._selector.changed(known)

    def lowest_reward(self) -> float:
        return min(float(source.rewards.min()) for source in self.sources)

    # --------------------------------------------------------------- observing

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        effect = differences(next_state, state, self._periodic) if self._wraps else next_state - state
        if self.use == "prior":
            self._prior.observe(state, action, reward, effect, terminated)
            return
        self._n_steps += 1
        predicted = self._check.observe(state, action, reward, effect, terminated)
        if predicted is not None:
            self._errors.note(state, action, effect, predicted)
        selector = self._selector
        selector.before_transition()
        if (self._by_relevance or selector.needs_transitions) and selector.takes_transitions():
            selector.add_transition(self._transitions.add(state, action, reward, effect))
            n_used = selector.n_used()
            if self._by_relevance and n_used >= max(MIN_TRANSITIONS_FOR_RELEVANCE, RELEVANCE_GROWTH * self._n_of_relevance):
                self._renew_relevance(n_used)

    def end_episode(self, truncated: bool) -> None:
        """
        Take in the end of an episode.

        One that reached its time limit narrows the kernel of transferred instances, if the target's own transitions have
        contradicted them: where they reach the threshold everywhere, wrongly, nothing is optimistic and nothing would ever be
        explored. A time limit alone says nothing against them.
        """
        if self.use == "prior":
            self._prior.end_episode(truncated)
            return
        if self._check.end_episode(truncated) and self.breadth_decay < 1.0:
            self._translator.set_breadth(self._translator.rules.breadth * self.breadth_decay)
            self._all_changed = True
        if self._selector.end_episode() and self._by_relevance:
            self._renew_relevance(self._selector.n_used())

    def note_use(self, transferred: TransferredInstances) -> None:
        if self.use == "prior":
            return
        first, _ = self._last_selected
        self._check.note_use(self._last_state, transferred, len(first))
        for candidate, n in zip(first.tolist(), transferred.length[: len(first)].tolist(), strict=True):
            if n > 0 and self._selector.selects_one:
                self._uses[candidate] += 1
            self._instances_used += n

    def _renew_relevance(self, n_used: int) -> None:
        self._measure_relevance(n_used, self._translator.relevance)
        self._n_of_relevance = n_used

    def _measure_relevance(self, n_used: int, values: np.ndarray) -> None:
        """Write to ``values`` the relevance of each candidate's instances to the first ``n_used`` recorded transitions."""
        bandwidths = self._bandwidths, self._starts
        given = self.candidates, self._transitions, n_used, bandwidths, self._periodic
        if self.relevance == NEAR:
            renew_near_relevance(*given, values)
        else:
            renew_relevance(*given, float(self.relevance_fraction), values)

    # --------------------------------------------------------------- describing

    def describe(self, candidate: int) -> str:
        """Return target action, source action and pairs of variables of a candidate as text."""
        if self.use == "prior":
            parts = self._prior.candidate(candidate)
            assert self.task is not None
            return f"{self.task.action_names[parts.target_action]}<-{parts.source_action} with {parts.state_mapping}"
        return self.candidates.describe(candidate)

    def describe_prior(self) -> str:
        """
        Say what the source is taken for: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v)".

        Target variables are named first, then the source variables that they are taken for, where these have other names.

        :raises ValueError: with ``use="instances"``, or if no algorithm uses this object
        """
        self._check_bound("describe_prior")
        if self.use != "prior":
            raise ValueError(f'use must be "prior" for describe_prior, got {self.use!r}')
        return self._prior.describe()

    def candidate(self, number: int) -> Candidate:
        """Return a candidate's parts, by name."""
        return self._prior.candidate(number) if self.use == "prior" else self.candidates.parts(number)

    def mapped_variables(self, number: int) -> MappedVariables:
        """Return what a candidate makes of each target variable, in numbers."""
        return self._prior.mapped_variables(number) if self.use == "prior" else self.candidates.mapped_variables(number)

    @property
    def makes_choices(self) -> bool:
        """Whether :meth:`choices` ever names a candidate."""
        return self.use == "prior" or self._selector.makes_choices

    def choices(self) -> np.ndarray:
        """
        Return the candidate selected for each state-action pair of the sample.

        :return: int64, shape (n_actions * n_points,), by action; -1 where there is none, or not a single one
        """
        if self.use == "prior":
            of_actions = self._prior.choices()
            assert self.task is not None
            return np.repeat(of_actions, len(self.task.sample_states))
        return self._selector.choices()

    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        Return the candidate selected for states and actions, whether or not its instances are needed there.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        :return: int64, shape (n,); -1 where there is none, or not a single one
        """
        if self.use == "prior":
            return self._prior.choices()[actions]
        first, last = self._selector.select(states, actions, np.zeros(len(actions)))
        return np.where(last - first == 1, first, -1)

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions of all sources, each name once."""
        return self._prior.source_action_names() if self.use == "prior" else self.candidates.source_action_names()

    def uses(self) -> dict[int, int]:
        """Return for how many of the agent's steps and actions each candidate's instances were used."""
        return self._prior.uses() if self.use == "prior" else dict(self._uses)

    def mapping_counts(self) -> list[tuple[str, int]]:
        """Return how often each candidate's instances were used, the most used first, by name."""
        return [(self.describe(candidate), n) for candidate, n in Counter(self.uses()).most_common()]

    def statistics(self) -> dict[str, float]:
        if self.use == "prior":
            return self._prior.statistics()
        return {
            "transfer/instances_used": self._instances_used,
            "transfer/uses": sum(self._uses.values()),
            "transfer/mappings_used": len(self._uses),
            "transfer/prediction_error": self._check.error(),
            "transfer/breadth": self._translator.rules.breadth,
            **self._selector.statistics(),
        }

    def report(self) -> TransferReport:
        """
        Say what was transferred: which mappings, how sure, what the target contradicted, how many steps rested on it.

        :return: a report to print, with all its figures as fields
        :raises NotBoundError: (a ValueError) if no algorithm uses this object
        :raises ValueError: before the first step of learning
        """
        self._check_bound("report")
        if (self._prior.n_observed if self.use == "prior" else self._n_steps) == 0:
            raise ValueError("there is nothing to report before learning: call model.learn(total_timesteps) first")
        return report_of_prior(repr(self), self._prior) if self.use == "prior" else self._report_of_instances()

    def _report_of_instances(self) -> TransferReport:
        assert self.task is not None
        n_actions, outcomes, used = self.task.n_actions, self._check.outcomes, self.uses()
        parts = [self.candidates.parts(candidate) for candidate in used]
        sure = [self._selector.confidence(action) for action in range(n_actions)]
        totals = self._errors.of_actions.sum(axis=0)
        return TransferReport(
            method=repr(self),
            use=self.use,
            sources=describe_sources(self.sources),
            n_steps=self._n_steps,
            n_rested=self._check.n_compared,
            mappings=mappings_of_instances(used, parts, self.task.action_names, sure, self._errors),
            error=self._errors.error(),
            n_compared=int(totals[0]),
            n_worse=int(totals[3]),
            contradictions=self._errors.contradictions(),
            ends=(outcomes.confirmed, outcomes.contradicted),
            rewards=(outcomes.rewards_right, outcomes.rewards_wrong),
            statistics=self.statistics(),
        )

    # --------------------------------------------------------------- saving

    def get_state(self) -> dict[str, np.ndarray]:
        if self.use == "prior":
            return self._prior.get_state()
        uses = np.zeros(len(self.candidates))
        uses[list(self._uses)] = list(self._uses.values())
        return {
            "transitions": self._transitions.rows(),
            "breadth": np.array([self._translator.rules.breadth]),
            "uses": uses,
            "instances_used": np.array([float(self._instances_used)]),
            "check": self._check.get_state(),
            "errors": np.concatenate([[float(self._n_steps)], self._errors.sums.ravel()]),
            **self._selector.get_state(),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        assert self.task is not None
        if self.use == "prior":
            self._prior.set_state(state)
            return
        d = self.task.n_variables
        self._translator.set_breadth(float(state["breadth"][0]))
        for row in state["transitions"]:
            action = int(np.clip(row[-1], 0, self.task.n_actions - 1))
            self._transitions.add(row[:d], action, float(row[-2]), row[d : 2 * d])
        self._selector.set_state(state)
        # All pairs of the sample are asked for again with what is restored here.
        self._all_changed = False
        used = np.flatnonzero(state["uses"] >= 1.0)
        self._uses = Counter(dict(zip(used.tolist(), state["uses"][used].astype(np.int64).tolist(), strict=True)))
        self._instances_used = int(state["instances_used"][0])
        self._check.set_state(state["check"])
        self._n_steps = int(state["errors"][0])
        self._errors.sums.ravel()[:] = state["errors"][1:]
        if self._by_relevance and self._selector.n_used():
            self._renew_relevance(self._selector.n_used())


def check_relevance(value: object) -> None:
    """
    :raises ValueError: unless ``value`` is True, False or "near"
    """
    if not isinstance(value, bool | np.bool_) and not (isinstance(value, str) and value == NEAR):
        raise ValueError(f'relevance must be True, False or "{NEAR}", got {value!r}')


def check_boolean(name: str, value: object) -> None:
    """
    :raises ValueError: unless ``value`` is True or False
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def __getattr__(name: str) -> Any:
    former = {"VirtualSourceTransfer": MappingTransfer, "Way": Candidate}
    if name not in former:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    message = f"{name} was renamed to {former[name].__name__}; the former name goes with the next version"
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    return former[name]
