"""What TIMBREL and COMBREL share: arguments, and what is done with the source as ``use`` says."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.common.checks import check_boolean, check_positive
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.mappings.inter_task_mapping import MappingNames
from sb3_combrel.mappings.named_sets import check_mappings, with_numbers
from sb3_combrel.sources.recipes import check_source
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import (
    Candidate,
    Candidates,
    MappedVariables,
    MappingsLike,
    SourceLike,
    load_sources,
)
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths, candidate_bandwidths
from sb3_combrel.transfer.instances.instance_transfer import InstanceTransfer, MeasureRelevance
from sb3_combrel.transfer.instances.relevance import renew_near_relevance, renew_relevance
from sb3_combrel.transfer.instances.report_of_instances import report_of_instances
from sb3_combrel.transfer.instances.selectors import Selector, SelectorParts
from sb3_combrel.transfer.instances.translation import Translator
from sb3_combrel.transfer.prior.prior_sets import is_factored
from sb3_combrel.transfer.prior.report_of_prior import report_of_prior
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions
from sb3_combrel.transfer.report import TransferReport
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH

#: What a method does with its source once bound, as ``use`` says.
SourceUse = InstanceTransfer | SourcePrior
DEFAULT_BREADTH = 0.3
DEFAULT_BREADTH_DECAY = 0.8
#: The relevance that does not favour distant instances, ``equations.near_relevances``.
NEAR = "near"


class MappingTransfer(Transfer):
    """
    Transfers from sources through mappings: translated instances, or the sources' own model as the prior of the target's.

    What it does once bound is done by an object, as ``use`` says: an
    :class:`~sb3_combrel.transfer.instances.instance_transfer.InstanceTransfer`, or a
    :class:`~sb3_combrel.transfer.prior.source_prior.SourcePrior`.

    :param source: instances, a path to them, the id or recipe of a task to learn them from, or a list of several
    :param mappings: mappings from the target to the source (see ``resolve``)
    :param breadth: kernel breadth of transferred instances, in unit coordinates
    :param breadth_decay: factor on ``breadth`` for each episode that reaches its time limit after the target's own transitions
        have contradicted what was transferred (see :class:`~sb3_combrel.transfer.instances.instances_check.InstancesCheck`)
    :param transfer_terminals: whether a source instance that ended its episode ends the target's
    :param relevance: whether instances come in the order of their relevance (Eq. 7), not of their distance; "near": of the
        relevance that does not favour distant instances, times their weight
    :param relevance_fraction: mu of Eq. 4
    :param bandwidths: (start, outcome, reward) of compliance and relevance; None: from the data
    :param use: "instances" or "prior": translated instances, or the source's own model seen through the mappings
    :param source_breadth: kernel breadth of the source's own model, in unit coordinates of the source
    """

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
        self._check_bound(name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        sources = load_sources(self.source)
        # Once read, the instances themselves: the file of a saved model must not depend on other files.
        self.source = sources if len(sources) > 1 else sources[0]
        self._replace_names(sources, task)
        self._periodic = np.array(task.periodic)
        self._wraps = bool(self._periodic.any())
        #: What is done with the source, as ``use`` says.
        self._source_use: SourceUse = self._make_prior(task) if self.use == "prior" else self._make_instances(task)

    def _replace_names(self, sources: Sequence[SourceInstances], task: TargetTask) -> None:
        """Replace names of variables and actions in mappings by their numbers, now that both tasks are known."""
        names = [
            MappingNames(each.state_names, tuple(task.state_names), each.action_names, tuple(task.action_names))
            for each in sources
        ]
        self.mappings = with_numbers(self.mappings, names)

    def _make_instances(self, task: TargetTask) -> InstanceTransfer:
        """Make the transfer of instances to the target task that the method was just bound to."""
        self.candidates = Candidates(self.source, self.mappings, task, self._whole_mappings())
        bandwidths = candidate_bandwidths(self.candidates, self.bandwidths)
        parts = SelectorParts(self.candidates, task, RecordedTransitions(task.n_variables), self.rng)
        selector = self._make_selector(parts, bandwidths)
        return InstanceTransfer(
            selector,
            self._make_translator(self.candidates, task, float(self.breadth)),
            breadth_decay=self.breadth_decay,
            measure_relevance=self._relevance_to(parts.transitions, bandwidths),
        )

    def _relevance_to(self, transitions: RecordedTransitions, bandwidths: CandidateBandwidths) -> MeasureRelevance:
        """Return what measures the candidates' relevance to recorded transitions."""
        given = self.candidates, transitions
        if self.relevance == NEAR:
            return partial(renew_near_relevance, *given, bandwidths=bandwidths, periodic=self._periodic)
        mu = float(self.relevance_fraction)
        return partial(renew_relevance, *given, bandwidths=bandwidths, periodic=self._periodic, mu=mu)

    def _whole_mappings(self) -> bool:
        """Return whether whole mappings are the candidates."""
        return False

    def _make_translator(self, candidates: Candidates, task: TargetTask, breadth: float) -> Translator:
        """Make the translator of the instances of some candidates."""
        by_relevance = bool(self.relevance) and self.ranks_by_relevance
        return Translator(
            candidates,
            task,
            breadth=breadth,
            transfer_terminals=self.transfer_terminals,
            by_relevance=by_relevance,
            times_weight=by_relevance and self.relevance == NEAR,
        )

    @abstractmethod
    def _make_selector(self, parts: SelectorParts, bandwidths: CandidateBandwidths) -> Selector:
        """Make the selector for the target task that the method was just bound to."""

    @abstractmethod
    def _make_prior(self, task: TargetTask) -> SourcePrior:
        """Make the prior of the target task that the method was just bound to."""

    @property
    def sources(self) -> list[SourceInstances]:
        """The source tasks' instances, once bound."""
        return list(self._source_use.sources)

    @property
    def source_prior(self) -> SourcePrior:
        """
        The source as the prior of the target's model, once bound.

        :raises ValueError: with ``use="instances"``, or if no algorithm uses this object
        """
        self._check_bound("source_prior")
        if not isinstance(self._source_use, SourcePrior):
            raise ValueError(f'use must be "prior" for source_prior, got {self.use!r}')
        return self._source_use

    @property
    def _instances(self) -> InstanceTransfer:
        """The transfer of instances, once bound; only with ``use="instances"``."""
        assert isinstance(self._source_use, InstanceTransfer)
        return self._source_use

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        return self._source_use.transferred(states, actions, own_weight)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        return self._source_use.transferred_to_sample(points, actions, own_weight)

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        return self._source_use.predict(states, actions)

    def prior_version(self) -> int:
        return self._source_use.version

    def value_bound(self) -> np.ndarray | None:
        return self._source_use.value_bound()

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        return self._source_use.changed(known)

    def lowest_reward(self) -> float:
        return min(float(source.rewards.min()) for source in self.sources)

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        effect = differences(next_state, state, self._periodic) if self._wraps else next_state - state
        self._source_use.observe(state, action, reward, effect, terminated)

    def end_episode(self, truncated: bool) -> None:
        self._source_use.end_episode(truncated)

    def note_use(self, transferred: TransferredInstances) -> None:
        self._source_use.note_use(transferred)

    def describe(self, candidate: int) -> str:
        """Return target action, source action and pairs of variables of a candidate as text."""
        return self._source_use.candidates.describe(candidate)

    def describe_prior(self) -> str:
        """
        Say what the source is taken for: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v)".

        Target variables are named first, then the source variables that they are taken for, where these have other names.

        :raises ValueError: with ``use="instances"``, or if no algorithm uses this object
        """
        self._check_bound("describe_prior")
        if self.use != "prior":
            raise ValueError(f'use must be "prior" for describe_prior, got {self.use!r}')
        return self.source_prior.describe()

    def candidate(self, number: int) -> Candidate:
        """Return a candidate's parts, by name."""
        return self._source_use.candidates.parts(number)

    def mapped_variables(self, number: int) -> MappedVariables:
        """Return what a candidate makes of each target variable, in numbers."""
        return self._source_use.candidates.mapped_variables(number)

    @property
    def makes_choices(self) -> bool:
        """Whether :meth:`choices` ever names a candidate."""
        return self._source_use.makes_choices

    def choices(self) -> np.ndarray:
        """
        Return the candidate selected for each state-action pair of the sample.

        :return: int64, shape (n_actions * n_points,), by action; -1 where there is none, or not a single one
        """
        return self._source_use.choices()

    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        Return the candidate selected for states and actions, whether or not its instances are needed there.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        :return: int64, shape (n,); -1 where there is none, or not a single one
        """
        return self._source_use.selected(states, actions)

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions of all sources, each name once."""
        return self._source_use.candidates.source_action_names()

    def uses(self) -> dict[int, int]:
        """Return for how many of the agent's steps and actions each candidate's instances were used."""
        return self._source_use.uses()

    def mapping_counts(self) -> list[tuple[str, int]]:
        """Return how often each candidate's instances were used, the most used first, by name."""
        return [(self.describe(candidate), n) for candidate, n in Counter(self.uses()).most_common()]

    def statistics(self) -> dict[str, float]:
        return self._source_use.statistics()

    def report(self) -> TransferReport:
        """
        Say what was transferred: which mappings, how sure, what the target contradicted, how many steps rested on it.

        :return: a report to print, with all its figures as fields
        :raises NotBoundError: (a ValueError) if no algorithm uses this object
        :raises ValueError: before the first step of learning
        """
        self._check_bound("report")
        if self._source_use.n_observed == 0:
            raise ValueError("there is nothing to report before learning: call model.learn(total_timesteps) first")
        if self.use == "prior":
            return report_of_prior(repr(self), self.source_prior, self.statistics())
        return report_of_instances(repr(self), self._instances, self.statistics())

    def get_state(self) -> dict[str, np.ndarray]:
        return self._source_use.get_state()

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._source_use.set_state(state)


def check_relevance(value: object) -> None:
    """
    :raises ValueError: unless ``value`` is True, False or "near"
    """
    if not isinstance(value, bool | np.bool_) and not (isinstance(value, str) and value == NEAR):
        raise ValueError(f'relevance must be True, False or "{NEAR}", got {value!r}')
