"""What the methods share that transfer through mappings: their arguments, and what ``use`` says is done with the source."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import partial
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.common.checks import check_boolean, check_positive
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.mappings.named_sets import check_mappings
from sb3_combrel.sources.recipes import checked_source
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import Candidate, Candidates, MappedVariables, MappingsLike, SourceLike, loaded
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths, candidate_bandwidths
from sb3_combrel.transfer.instances.instance_transfer import InstanceTransfer
from sb3_combrel.transfer.instances.relevance import renew_relevance
from sb3_combrel.transfer.instances.selectors import Selector
from sb3_combrel.transfer.instances.translation import Translator
from sb3_combrel.transfer.outcome_evidence import RegionErrors
from sb3_combrel.transfer.prior.prior_sets import is_factored, make_prior
from sb3_combrel.transfer.prior.report_of_prior import report_of_prior
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.report import TransferReport
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH

DEFAULT_BREADTH = 0.3
DEFAULT_BREADTH_DECAY = 0.8
NEAR = "near"  #: the relevance that does not favour distant instances, ``equations.near_relevances``
MAX_ACTION_MAPPINGS = 100_000  # action mappings that are restricted as a whole are compared one by one


@dataclass(repr=False, eq=False)
class MappingTransfer(Transfer):
    """Transfers from sources through mappings: translated instances, or the sources' own model as the prior of the target's.

    :param source: what holds experience of another task: source instances, a file or a pandas DataFrame of them, a Minari
        dataset, a replay buffer, a model that has its experience; or a list of several; or the id of an environment, which is
        then learned by Q-learning (30,000 steps, 1000 instances) when first needed, and kept in a file; or a recipe, ``{"env":
        "MountainCar-v0", "total_timesteps": 50_000}``: :func:`~sb3_combrel.sources.recipes.find_source`
    :param mappings: the name of a set: "injective" (each source variable is mapped to by one target variable, the others are
        left unmapped), "surjective", "all", "balanced", these with ``signed_`` before them (variables may be mirrored as
        well), "paper_mountain_car" or "paper_icub"; a mapping, a list of mappings or a ``MappingSet``
    :param breadth: kernel breadth of transferred instances, in unit coordinates, wide enough for them to cover the source; the
        papers name none
    :param breadth_decay: factor on ``breadth`` for each episode that reaches its time limit after new evidence against what
        was transferred (:class:`~sb3_combrel.transfer.instances.instances_check.InstancesCheck` says which), so that pairs for
        which the source is wrong are explored in the end. 1: never, as in the papers
    :param transfer_terminals: whether a source instance that ended its episode ends the target's too (the papers do not say).
        Where this is wrong the target's own transitions correct it; without it no path leads to an end at first. With
        ``use="prior"``: whether the source's values, which depend on its ends, bound the target's
    :param relevance: True: instances come in the order of their relevance (Eq. 7) to the target's transitions, not of their
        distance. COMBREL's paper finds it harmful: it favours instances that are far from these. "near": of a relevance that
        does not, times the weight, see ``equations.near_relevances``
    :param relevance_fraction: mu of Eq. 4: the fraction of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of compliance and relevance, delta_sa, delta_s' and delta_r of Eq.
        2; None: from the data, that of starts in proportion to how many variables a mapping compares
    :param use: "instances": translated instances fill what the target's own lack; "prior": the source's own local linear
        model, seen through the mappings, is the prior of the target's (``FittedRMax(degree=1)``), whose fits it joins as
        further instances. :class:`~sb3_combrel.transfer.prior.evidence.PriorEvidence` says how much it weighs.
        ``breadth``, ``breadth_decay``, relevance and its arguments have no meaning then
    :param source_breadth: with ``use="prior"``: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    #: Whether relevance, where it is asked for, is the order in which instances are added.
    ranks_by_relevance: ClassVar[bool] = True
    #: Arguments that have a meaning with ``use="prior"`` as well.
    of_prior: ClassVar[tuple[str, ...]] = ("source", "mappings", "transfer_terminals", "use", "source_breadth")

    source: SourceLike
    mappings: MappingsLike
    _: KW_ONLY
    breadth: float = DEFAULT_BREADTH
    breadth_decay: float = DEFAULT_BREADTH_DECAY
    transfer_terminals: bool = True
    relevance: bool | str = False
    relevance_fraction: float = 0.5
    bandwidths: tuple[float, float, float] | None = None
    use: str = "instances"
    source_breadth: float = DEFAULT_SOURCE_BREADTH
    # Arguments that are left to the target's model, as they were given, until the method is bound.
    _left_open: dict[str, None] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        check_either("use", self.use, "instances", "prior")
        if self.use == "instances" and is_factored(self.mappings):
            raise ValueError(f'factored mappings need use="prior", got use="instances" with {self.mappings!r}')
        meaningless = ", ".join(f"{name}={getattr(self, name)!r}" for name in self._of_instances())
        if self.use == "prior" and meaningless:
            raise ValueError(f'{meaningless} must be left out with use="prior": it has a meaning for use="instances" alone')
        self.source = checked_source(self.source)
        check_mappings(self.mappings)
        check_positive("source_breadth", self.source_breadth)
        check_positive("breadth", self.breadth)
        check_positive("breadth_decay", self.breadth_decay, max=1.0)
        check_positive("relevance_fraction", self.relevance_fraction, max=1.0)
        if self.bandwidths is not None:
            given: Any = self.bandwidths
            if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray) or len(given) != 3:
                raise ValueError(f"bandwidths must be three numbers (start, outcome, reward) or None, got {given!r}")
            for value in given:
                check_positive("bandwidths", value)
        check_boolean("transfer_terminals", self.transfer_terminals)
        is_near = isinstance(self.relevance, str) and self.relevance == NEAR
        if not is_near and not isinstance(self.relevance, bool | np.bool_):
            raise ValueError(f'relevance must be True, False or "{NEAR}", got {self.relevance!r}')
        self.transfer_terminals = bool(self.transfer_terminals)
        self.relevance = NEAR if is_near else bool(self.relevance)

    def _of_instances(self) -> list[str]:
        """Arguments that differ from their defaults, and have no meaning for a prior."""
        given = (each for each in fields(self) if each.init and each.name not in self.of_prior)
        return [each.name for each in given if np.any(getattr(self, each.name) != each.default)]

    def __getattr__(self, name: str) -> Any:
        self._check_bound(name)  # called only for what is not there otherwise
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def arguments(self) -> dict[str, Any]:
        return {**super().arguments(), **self._left_open}

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        if self._left_open:
            self.use, self._left_open = "prior" if task.takes_prior else "instances", {}
        self.source, self.mappings = loaded(self.source, self.mappings, task)
        # What is done with the source, as ``use`` says.
        self._source_use: InstanceTransfer | SourcePrior
        self._source_use = self._make_prior(task) if self.use == "prior" else self._make_instances(task)

    def _make_instances(self, task: TargetTask) -> InstanceTransfer:
        self.candidates = Candidates(self.source, self.mappings, task, self._whole_mappings())
        bandwidths = candidate_bandwidths(self.candidates, self.bandwidths)
        selector = self._make_selector(self.candidates, bandwidths)
        translator = self._make_translator(self.candidates, self.breadth)
        mu = None if self.relevance == NEAR else float(self.relevance_fraction)
        measure = partial(renew_relevance, self.candidates, selector.transitions, bandwidths=bandwidths, mu=mu)
        return InstanceTransfer(selector, translator, breadth_decay=self.breadth_decay, measure_relevance=measure)

    def _whole_mappings(self) -> bool:
        """Return whether whole mappings are the candidates."""
        return False

    def _make_translator(self, candidates: Candidates, breadth: float) -> Translator:
        ranked = bool(self.relevance) and self.ranks_by_relevance
        order = {"by_relevance": ranked, "times_weight": ranked and self.relevance == NEAR}
        return Translator(candidates, breadth=breadth, transfer_terminals=self.transfer_terminals, **order)

    @abstractmethod
    def _make_selector(self, candidates: Candidates, bandwidths: CandidateBandwidths) -> Selector:
        """Make the selector for the target task that the method was just bound to."""

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        """Make the prior of the target task that the method was just bound to."""
        raise NotImplementedError(f"{type(self).__name__} transfers instances, it has no prior")

    def _prior_of_set(self, task: TargetTask, **rules: Any) -> SourcePrior:
        """Make the prior by the set of mappings; ``rules``: others of :func:`make_prior`."""
        given = {"breadth": float(self.source_breadth), "transfer_terminals": self.transfer_terminals, **rules}
        return make_prior(self.source, self.mappings, task, **given)

    @property
    def sources(self) -> list[SourceInstances]:
        """The source tasks' instances, once bound."""
        return list(self._source_use.sources)

    @property
    def source_prior(self) -> SourcePrior:
        """The source as the prior of the target's model; a ValueError with ``use="instances"``, or if not bound."""
        self._check_bound("source_prior")
        if not isinstance(self._source_use, SourcePrior):
            raise ValueError(f'use must be "prior" for what the source is taken for, got {self.use!r}')
        return self._source_use

    @property
    def _instances(self) -> InstanceTransfer:
        assert isinstance(self._source_use, InstanceTransfer)
        return self._source_use

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        if self.use == "prior":
            return super().transferred(states, actions, own_weight)
        return self._instances.transferred(states, actions, own_weight)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        if self.use == "prior":
            return super().transferred_to_sample(points, actions, own_weight)
        return self._instances.transferred_to_sample(points, actions, own_weight)

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        return self.source_prior.predict(states, actions)

    def prior_version(self) -> int:
        return self.source_prior.version

    def value_bound(self) -> np.ndarray | None:
        return self.source_prior.value_bound()

    def change_optimism(self, gamma: float, max_value: float) -> None:
        super().change_optimism(gamma, max_value)
        if self.use == "prior":
            self.source_prior.change_optimism(gamma, max_value)

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        return self.use == "instances" and self._instances.changed(known)

    def lowest_reward(self) -> float:
        return min(float(source.rewards.min()) for source in self.sources)

    def note_prediction(self, effect: np.ndarray, leverage: float) -> None:
        self.source_prior.note_prediction(effect, leverage)

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        self._source_use.environment = self.environment
        self._source_use.observe(state, action, reward, self._bound_task.effect(state, next_state), terminated)

    def end_episode(self, truncated: bool) -> None:
        self._source_use.environment = self.environment
        self._source_use.end_episode(truncated)

    def break_off(self) -> None:
        self._source_use.break_off()

    def sample_moved(self) -> None:
        if self.use == "instances":
            self._instances.selector.sample_moved()

    def note_use(self, transferred: TransferredInstances) -> None:
        if self.use == "instances":
            self._instances.note_use(transferred)

    def describe(self, candidate: int) -> str:
        """Return target action, source action and pairs of variables of a candidate as text."""
        return self._source_use.candidates.describe(candidate)

    def describe_prior(self) -> str:
        """Say what the source is taken for: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v)".

        :raises ValueError: as of :attr:`source_prior`
        """
        self._check_bound("describe_prior")
        prior = self.source_prior
        return prior.candidates.describe_choice(prior.choice)

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
        """Return each pair's candidate, int64, shape (n_actions * n_points,), by action; -1 for none, or not a single one."""
        return self._source_use.choices()

    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the candidates selected, whether or not their instances are needed, shape (n,), -1 as in :meth:`choices`."""
        return self._source_use.selected(states, actions)

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions of all sources, each name once."""
        return self._source_use.candidates.source_action_names()

    def uses(self) -> dict[int, int]:
        """Return for how many of the agent's steps and actions each candidate's instances were used."""
        return self._source_use.uses()

    def mapping_counts(self) -> list[tuple[str, int]]:
        """Return how often each candidate's instances were used, the most used first, by name."""
        # Those that were used as often by their number, not by when they were used first, which is not saved.
        most_used = sorted(self.uses().items(), key=lambda use: (-use[1], use[0]))
        return [(self.describe(candidate), n) for candidate, n in most_used]

    @property
    def region_errors(self) -> RegionErrors:
        """Where predictions of the source were right and wrong, once bound."""
        self._check_bound("region_errors")
        return self._source_use.errors

    def statistics(self) -> dict[str, float]:
        return self._source_use.statistics()

    def report(self) -> TransferReport:
        """Say what was transferred: which mappings, how sure, what the target contradicted, how many steps rested on it.

        :raises ValueError: before the first step of learning; NotBoundError, which is one, if no algorithm uses this object
        """
        self._check_bound("report")
        if self._source_use.n_observed == 0:
            raise ValueError("there is nothing to report before learning: call model.learn(total_timesteps) first")
        if self.use == "prior":
            return report_of_prior(repr(self), self.source_prior, self.statistics())
        return self._instances.report(repr(self), self.statistics())

    def get_state(self) -> dict[str, np.ndarray]:
        return self._source_use.get_state()

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._source_use.set_state(state)


def check_either(name: str, value: object, one: str, other: str) -> None:
    """Raise a ValueError unless ``value`` is one of two words."""
    if value not in (one, other):
        raise ValueError(f'{name} must be "{one}" or "{other}", got {value!r}')


def check_action_mappings(sets: Sequence[MappingSet]) -> None:
    """Raise a ValueError if these sets have too many mappings to compare."""
    for mappings in sets:
        if mappings.pairs is None and not mappings.combines_freely and mappings.n_action_mappings > MAX_ACTION_MAPPINGS:
            raise ValueError(
                f"mappings must have at most {MAX_ACTION_MAPPINGS:,} action mappings, or all there are, whose source "
                f'actions are chosen one by one ("injective"), got {mappings.n_action_mappings:,}'
            )
