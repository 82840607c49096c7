"""COMBREL: transfer through many mappings, selected state by state by compliance (Fachantidis et al.)."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite, check_positive
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import MappingsLike, SourceLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.compliance import DEFAULT_MIN_EVIDENCE
from sb3_combrel.transfer.instances.compliance_selector import ComplianceSelector, SelectionOptions
from sb3_combrel.transfer.instances.selectors import SelectorParts
from sb3_combrel.transfer.methods.mapping_transfer import (
    DEFAULT_BREADTH,
    DEFAULT_BREADTH_DECAY,
    MappingTransfer,
)
from sb3_combrel.transfer.prior.prior_sets import is_factored, make_prior
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH

#: Arguments of COMBREL that have a meaning for transferred instances only.
_OF_INSTANCES = (
    "n_neighbors",
    "neighbors",
    "choice",
    "neighbor_radius",
    "measured",
    "min_compliance",
    "min_evidence",
    "breadth",
    "breadth_decay",
    "relevance",
    "relevance_fraction",
    "bandwidths",
)


class COMBREL(MappingTransfer):
    """
    COmpliance-aware transfer for Model-Based REinforcement Learning: finds by itself how two tasks correspond.

    Paper: Fachantidis, Partalas, Taylor & Vlahavas, "Transfer learning with probabilistic mapping selection" (Algorithm
    1). Each mapping makes a virtual source task. For a state and an action, the mapping with the highest mean compliance
    with the nearest recorded target transitions of that action is selected; it translates the source instances that are
    missing. Because compliance with transitions of that action depends only on the state mapping and on the one source
    action that the target action maps to, any number of action mappings costs nothing.

    That is one reading of the paper: compliance is computed "only to the target task instances that apply action a"
    (Section 5.1). Its Table 2 contradicts it, where two mappings with the same source action for an action have different
    shares. ``neighbors="state_action"`` is the other reading.

    With ``use="prior"`` the source's own local linear model, seen through a mapping, is the prior of the target's model: the
    target's own instances are fitted to what it leaves over. Compliance is then that of the source's predictions with the
    target's transitions, and one mapping is chosen for all states, or with sets that are not factored one for each target
    action: after 10 transitions, and again whenever there are 1.4 times as many. What the prior claims to know without the
    target's own instances is said in :class:`~sb3_combrel.transfer.prior.claims.Claims`, and how the source's values bound
    those of what is unknown in :class:`~sb3_combrel.transfer.prior.value_bound.ValueBound`. It needs ``FittedRMax(degree=1)``.

    ::

        source = SourceInstances.from_q_learning("combrel/MountainCar2D-v0", n_instances=1000, seed=0)
        model = FittedRMax("combrel/MountainCar4D-v0", transfer=COMBREL(source), seed=0).learn(total_timesteps=5_000)
        print(model.transfer.report())

    :param source: source instances, a path to them, or a list of several, among which is selected as well; or the id of an
        environment, "MountainCar-v0", which is then learned by Q-learning (30,000 steps, 1000 instances) when it is first
        needed, and kept in a file; or a recipe, ``{"env": "MountainCar-v0", "total_timesteps": 50_000}``, see
        :func:`~sb3_combrel.sources.recipes.find_source`
    :param mappings: None: "factored" with ``use="prior"``, "injective" with "instances"; or a set. "injective" (each source
        variable is mapped to by one target variable, the other target variables are left unmapped), "surjective", "all",
        "balanced", these with ``signed_`` before them (variables may be mirrored as well), "paper_mountain_car", "paper_icub";
        "factored" and "signed_factored" (with ``use="prior"`` only): the target's variables are divided among copies of the
        source, or of some of its variables, each moved by a source action of its own, and variables that stay; a
        ``FactoredMapping``; a list of mappings or a ``MappingSet``. Where every target variable is mapped, as in
        "surjective", translated instances lie on diagonals of the target's space and help much less: 12 episodes of
        MountainCar4D (``degree=0``, breadth 0.1, 6 seeds) took 3,207 +- 55 steps with "injective", 3,803 +- 239 with "all",
        4,752 +- 239 with "signed_injective", 4,655 +- 184 with "signed_all", and 15,669 +- 327 with "surjective". The sets
        named after the paper's experiments leave two of the four target variables unmapped.
    :param n_neighbors: how many of the nearest target transitions are averaged over; k of Algorithm 1 (the paper: 3)
    :param neighbors: "action": the nearest transitions with the same action are averaged over; or "state_action": the
        nearest whatever their action, each judged by the source action that the mapping has for *its* action. So whole
        mappings differ; they must be at most 20,000.
    :param choice: "best": the mapping with the highest mean compliance is selected, as in the paper; or "drawn": one is
        drawn, each with a probability in proportion to its mean compliance. Where many mappings comply about equally
        well none of them then determines all predictions alone.
    :param neighbor_radius: how far, in unit coordinates, a target transition may be and still count as a neighbour. Without
        any nothing is transferred: regions without transitions stay optimistic, and in the others not every action has to
        be tried. None: the nearest count however far they are, as in the paper.
    :param measured: which transitions are recorded: "online": those of all episodes, used from the first step on (the
        default, which works best); or "first_episode": those of the first episode, used after its end, as in the paper
    :param max_transitions: target transitions that are recorded, at most
    :param min_compliance: a mapping transfers nothing where its mean compliance does not exceed this many times that of
        the no-change baseline, the prediction that no variable ever changes. It excludes sources that predict large changes
        wrongly. A source of small random effects complies about as well as the baseline and is *not* excluded: with effects
        of standard deviation 0.01 from anywhere (unit coordinates; MountainCar4D, breadth 0.1, 12 episodes, 6 seeds) its
        instances were used 20,000 times, and learning took 16,613 +- 949 steps instead of 15,897 +- 244 without transfer;
        with 1.0 instead of 0.8 it took 18,912 +- 780, so a higher bar does not help. ``breadth_decay`` is what ends it. 0:
        any mapping that has evidence may transfer, as in the paper.
    :param min_evidence: a mapping's compliance with a transition counts as 0 where the start kernels of its instances (Eq. 2,
        before they are normalized) add up to less: with weights that are normalized, a mapping whose instances are all far
        away could look as good as one with near ones. 0.1 is one instance at 1.5 times the square root of the bandwidth.
        0: every mapping counts, as in the paper.
    :param breadth: kernel breadth of transferred instances, in unit coordinates; the paper names none
    :param breadth_decay: factor on ``breadth`` for each episode that reaches its time limit after new evidence against what
        was transferred (the paper: none, 1): the target's own transitions were predicted worse than by "no change", or ends
        were predicted that never came, or there was nothing left to find out (see
        :class:`~sb3_combrel.transfer.instances.instances_check.InstancesCheck`). So pairs for which the source is wrong are
        explored in the end, whatever the source. MountainCar4D with the right source, noise, and five other misleading ones
        (``degree=0``, breadth 0.1, 12 episodes, 4 seeds) took on average at most as many steps as with a decay at every time
        limit. Effects alone do not suffice as evidence: with the right dynamics and a wrong goal all episodes then reached the
        limit.
    :param transfer_terminals: whether a source instance that ended its episode ends the target's too. The paper does not
        say. Where this is wrong the target's own transitions correct it; without it no path leads to an end at first.
    :param relevance: True: order the instances by relevance (Eq. 7), not by distance. The paper finds it harmful: it favours
        instances that are far from the target's transitions. "near": by a relevance that does not, times the weight; see
        ``equations.near_relevances``
    :param relevance_fraction: mu of Eq. 4: the fraction of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of compliance, delta_sa, delta_s' and delta_r of Eq. 2; None:
        from the data, that of starts in proportion to how many variables a mapping compares. The paper names none.
    :param use: "instances": translated instances fill what the target's own lack; "prior": see above. Then of the arguments
        after ``mappings`` only ``max_transitions``, ``transfer_terminals`` and ``source_breadth`` have a meaning. None:
        "prior" with factored ``mappings``; "instances" with others, and where an argument that has a meaning for instances
        only differs from its default; else "prior" where the target's model takes one (``FittedRMax(degree=1)``)
    :param source_breadth: with ``use="prior"``: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike | None = None,
        *,
        n_neighbors: int = 3,
        neighbors: str = "action",
        choice: str = "best",
        neighbor_radius: float | None = None,
        measured: str = "online",
        max_transitions: int = 3000,
        min_compliance: float = 0.8,
        min_evidence: float = DEFAULT_MIN_EVIDENCE,
        breadth: float = DEFAULT_BREADTH,
        breadth_decay: float = DEFAULT_BREADTH_DECAY,
        transfer_terminals: bool = True,
        relevance: bool | str = False,
        relevance_fraction: float = 0.5,
        bandwidths: tuple[float, float, float] | None = None,
        use: str | None = None,
        source_breadth: float = DEFAULT_SOURCE_BREADTH,
    ):
        of_instances = {name: value for name, value in locals().items() if name in _OF_INSTANCES}
        check_count("n_neighbors", n_neighbors)
        check_count("max_transitions", max_transitions)
        check_finite("min_compliance", min_compliance)
        check_finite("min_evidence", min_evidence)
        if neighbor_radius is not None:
            check_positive("neighbor_radius", neighbor_radius)
        if min_compliance < 0.0:
            raise ValueError(f"min_compliance must be at least 0, got {min_compliance!r}")
        if min_evidence < 0.0:
            raise ValueError(f"min_evidence must be at least 0, got {min_evidence!r}")
        if neighbors not in ("action", "state_action"):
            raise ValueError(f'neighbors must be "action" or "state_action", got {neighbors!r}')
        if choice not in ("best", "drawn"):
            raise ValueError(f'choice must be "best" or "drawn", got {choice!r}')
        if measured not in ("online", "first_episode"):
            raise ValueError(f'measured must be "online" or "first_episode", got {measured!r}')
        # With nothing given that says which, both depend on the target's model, and are decided when it is known.
        self._decides = mappings is None and use is None and not _differ_from_defaults(of_instances)
        if use is None:
            use = "prior" if mappings is not None and is_factored(mappings) else "instances"
        if mappings is None:
            mappings = "factored" if use == "prior" else "injective"
        super().__init__(
            source,
            mappings,
            breadth=breadth,
            breadth_decay=breadth_decay,
            transfer_terminals=transfer_terminals,
            relevance=relevance,
            relevance_fraction=relevance_fraction,
            bandwidths=bandwidths,
            use=use,
            source_breadth=source_breadth,
        )
        self.n_neighbors = n_neighbors
        self.neighbors = neighbors
        self.choice = choice
        self.neighbor_radius = neighbor_radius
        self.measured = measured
        self.max_transitions = max_transitions
        self.min_compliance = min_compliance
        self.min_evidence = min_evidence

    @classmethod
    def paper(cls, source: SourceLike, mappings: MappingsLike = "injective", **arguments: Any) -> COMBREL:
        """
        COMBREL as the paper has it: instances of the mapping that complies best with the transitions of the first episode.

        :param source: as of the class; ``mappings``: the same
        :param arguments: others of the class, which come before the paper's
        """
        as_published = dict(
            use="instances", measured="first_episode", n_neighbors=3, min_compliance=0.0, min_evidence=0.0, breadth_decay=1.0
        )
        return cls(source, mappings, **{**as_published, **arguments})

    def arguments(self) -> dict[str, Any]:
        given = super().arguments()
        return {**given, "mappings": None, "use": None} if self._decides else given

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        if self._decides:
            self.use, self.mappings = ("prior", "factored") if task.takes_prior else ("instances", "injective")
            self._decides = False
        super().bind(task, rng)

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        given = is_factored(self.mappings) and not isinstance(self.mappings, str)
        return make_prior(
            self.source,
            self.mappings,
            task,
            breadth=float(self.source_breadth),
            given=given,
            drawn=None,
            max_transitions=self.max_transitions,
            transfer_terminals=self.transfer_terminals,
        )

    def _whole_mappings(self) -> bool:
        return self.neighbors == "state_action"

    def _make_selector(self, parts: SelectorParts, bandwidths: CandidateBandwidths) -> ComplianceSelector:
        options = SelectionOptions(
            bandwidths=bandwidths.of_all,
            starts=bandwidths.starts,
            n_neighbors=self.n_neighbors,
            all_actions=self._whole_mappings(),
            neighbor_radius=self.neighbor_radius,
            drawn=self.choice == "drawn",
            online=self.measured == "online",
            max_transitions=self.max_transitions,
            min_evidence=self.min_evidence,
            min_compliance=self.min_compliance,
        )
        self._compliance_selector = ComplianceSelector(parts, options)
        return self._compliance_selector

    def chosen_compliance(self, pairs: np.ndarray) -> np.ndarray:
        """
        Return the mean compliance of the chosen mapping with the nearest transitions (line 19 of Algorithm 1).

        :param pairs: pairs ``action * n_points + point`` of the sample, int64, shape (n,)
        :return: float64, shape (n,); NaN where nothing is chosen
        """
        if self.use == "prior":
            assert self.task is not None
            return self.source_prior.mean_compliance()[pairs // len(self.task.sample_states)]
        return self._compliance_selector.mean_compliance(pairs)


def _differ_from_defaults(arguments: dict[str, Any]) -> bool:
    """Return whether any of these arguments of COMBREL differs from its default."""
    parameters = inspect.signature(COMBREL.__init__).parameters
    return any(np.any(value != parameters[name].default) for name, value in arguments.items())
