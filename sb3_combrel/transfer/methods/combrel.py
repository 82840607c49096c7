"""COMBREL: transfer through many mappings, selected state by state by compliance (Fachantidis et al.)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite, check_positive
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike, SourceLike, load_sources
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.compliance import DEFAULT_MIN_EVIDENCE
from sb3_combrel.transfer.instances.compliance_selector import ComplianceSelector, SelectionOptions
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer, check_either
from sb3_combrel.transfer.prior.prior_sets import PRACTICAL_SETS, WITHOUT_COPIES, is_factored, practical_set
from sb3_combrel.transfer.prior.report_of_prior import compliance_of_prior
from sb3_combrel.transfer.prior.source_prior import SourcePrior


@dataclass(repr=False, eq=False)
class COMBREL(MappingTransfer):
    """COmpliance-aware transfer for Model-Based REinforcement Learning: finds by itself how two tasks correspond.

    Paper: Fachantidis, Partalas, Taylor & Vlahavas, "Transfer learning with probabilistic mapping selection" (Algorithm 1).
    Each mapping makes a virtual source task. For a state and an action, the mapping with the highest mean compliance with the
    nearest recorded target transitions of that action is selected; it translates the source instances that are missing. Such
    compliance depends only on the state mapping and the one source action, so any number of action mappings costs nothing.

    That is one reading of the paper (Section 5.1). Its Table 2 contradicts it, where two mappings with the same source action
    for an action have different shares: ``neighbors="state_action"`` is the other reading.

    With ``use="prior"`` one mapping is chosen for all states, or with sets that are not factored one for each target action,
    by its evidence (``equations.evidence``), the likelihood of the target's transitions under the source's model, of which the
    paper's compliance is the form of a kernel: after 10 transitions, and again whenever there are 1.4 times as many. How the
    source's values bound those of what is unknown is said in :class:`~sb3_combrel.transfer.prior.value_bound.ValueBound`.

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`.

    ::

        source = SourceInstances.from_q_learning("combrel/MountainCar2D-v0", n_instances=1000, seed=0)
        model = FittedRMax("combrel/MountainCar4D-v0", transfer=COMBREL(source), seed=0).learn(total_timesteps=5_000)
        print(model.transfer.report())

    :param source: as there; of several sources is selected as well
    :param mappings: a set as there, by default "injective" with ``use="instances"``; with ``use="prior"`` also
        "signed_factored", the default where there are at most 2,000 copies, or "factored": the target's variables are divided
        among copies of the source, or of some of its variables, as they are or, where that explains twice as much, mirrored,
        each moved by a source action of its own, and variables that stay; or a ``FactoredMapping``. Where all target variables
        are mapped, as in "surjective", translated instances lie on diagonals of the target's space and help much less
    :param n_neighbors: how many of the nearest target transitions are averaged over; k of Algorithm 1 (the paper: 3)
    :param neighbors: "action": the nearest transitions with the same action are averaged over; or "state_action": the nearest
        whatever their action, each judged by the source action that the mapping has for *its* action; at most 20,000 mappings
        then
    :param choice: "best": the mapping with the highest mean compliance, as in the paper; or "drawn": with a probability in
        proportion to it
    :param neighbor_radius: how far, in unit coordinates, a target transition may be and still count as a neighbour; without
        any nothing is transferred. None: however far they are, as in the paper
    :param measured: which transitions are recorded: "online": those of all episodes, used from the first step on; or
        "first_episode": those of the first episode, used after its end, as in the paper
    :param max_transitions: target transitions that are recorded, at most
    :param min_compliance: a mapping transfers nothing where its mean compliance does not exceed this many times that of the
        prediction that no variable ever changes. It excludes sources that predict large changes wrongly, but none of small
        random effects: these ``breadth_decay`` ends. 0: any mapping that has evidence may transfer, as in the paper
    :param min_evidence: a mapping's compliance with a transition counts as 0 where the start kernels of its instances (Eq. 2,
        before they are normalized) add up to less. 0.1 is one instance at 1.5 times the square root of the bandwidth. 0: every
        mapping counts, as in the paper
    :param use: as there; of the arguments after ``mappings`` only ``max_transitions``, ``transfer_terminals`` and
        ``source_breadth`` have a meaning for a prior. None: "prior" with factored ``mappings``; "instances" with others, and
        where an argument that has a meaning for instances only differs from its default; else "prior" where the target's model
        takes one (``FittedRMax(degree=1)``)
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    mappings: MappingsLike | None = None  # type: ignore[assignment]
    _: KW_ONLY
    of_prior: ClassVar[tuple[str, ...]] = (*MappingTransfer.of_prior, "max_transitions")

    n_neighbors: int = 3
    neighbors: str = "action"
    choice: str = "best"
    neighbor_radius: float | None = None
    measured: str = "online"
    max_transitions: int = 3000
    min_compliance: float = 0.8
    min_evidence: float = DEFAULT_MIN_EVIDENCE
    use: str | None = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_count("n_neighbors", self.n_neighbors)
        check_count("max_transitions", self.max_transitions)
        if self.neighbor_radius is not None:
            check_positive("neighbor_radius", self.neighbor_radius)
        for name in ("min_compliance", "min_evidence"):
            check_finite(name, getattr(self, name), min=0.0)
        check_either("neighbors", self.neighbors, "action", "state_action")
        check_either("choice", self.choice, "best", "drawn")
        check_either("measured", self.measured, "online", "first_episode")
        # With nothing given that says which, both depend on the target's model.
        if self.mappings is None and self.use is None and not self._of_instances():
            self._left_open = {"mappings": None, "use": None}
        if self.use is None:
            self.use = "prior" if self.mappings is not None and is_factored(self.mappings) else "instances"
        if self.mappings is None:
            self.mappings = PRACTICAL_SETS[0] if self.use == "prior" else WITHOUT_COPIES
        super().__post_init__()

    @classmethod
    def paper(cls, source: SourceLike, mappings: MappingsLike = "injective", **arguments: Any) -> COMBREL:
        """COMBREL as the paper has it: instances of the mapping that complies best with the transitions of the first episode.

        :param arguments: others of the class, which come before the paper's
        """
        as_published = dict(
            use="instances", measured="first_episode", n_neighbors=3, min_compliance=0.0, min_evidence=0.0, breadth_decay=1.0
        )
        return cls(source, mappings, **{**as_published, **arguments})

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        if self._left_open:
            self.source = load_sources(self.source)
            self.mappings = practical_set(self.source, task) if task.takes_prior else WITHOUT_COPIES
        super().bind(task, rng)

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        return self._prior_of_set(task, max_transitions=self.max_transitions)

    def _whole_mappings(self) -> bool:
        return self.neighbors == "state_action"

    def _make_selector(self, candidates: Candidates, bandwidths: CandidateBandwidths) -> ComplianceSelector:
        names = ("n_neighbors", "neighbor_radius", "max_transitions", "min_evidence", "min_compliance")
        given = {name: getattr(self, name) for name in names}
        given |= {"all_actions": self._whole_mappings(), "drawn": self.choice == "drawn", "online": self.measured == "online"}
        options = SelectionOptions(bandwidths, **given)
        self._compliance_selector = ComplianceSelector(candidates, options, self.rng)
        return self._compliance_selector

    def chosen_compliance(self, pairs: np.ndarray) -> np.ndarray:
        """Return the chosen mapping's mean compliance with the nearest transitions (line 19 of Algorithm 1), NaN where none is
        chosen.

        :param pairs: pairs ``action * n_points + point`` of the sample, int64, shape (n,)
        """
        if self.use == "prior":
            return compliance_of_prior(self.source_prior)[pairs // len(self._bound_task.sample_states)]
        return self._compliance_selector.mean_compliance(pairs)
