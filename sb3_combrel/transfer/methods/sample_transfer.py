"""Transfer of samples: instances of several sources and mappings, drawn by compliance and relevance (Lazaric et al. 2008)."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.checks import check_count
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import MappingsLike, SourceLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.instance_transfer import RELEVANCE_GROWTH
from sb3_combrel.transfer.instances.selectors import SelectorParts
from sb3_combrel.transfer.instances.task_compliance_selector import TaskComplianceSelector
from sb3_combrel.transfer.methods.least_error import check_action_mappings
from sb3_combrel.transfer.methods.mapping_transfer import DEFAULT_BREADTH, DEFAULT_BREADTH_DECAY, MappingTransfer
from sb3_combrel.transfer.methods.task_compliance import candidate_compliances, draw_instances, instances_of_each
from sb3_combrel.transfer.prior.prior_sets import is_factored
from sb3_combrel.transfer.prior.source_prior import SourcePrior

# Seeds are saved as float64.
MAX_SEED = 2**53


class SampleTransfer(MappingTransfer):
    """
    Draws instances of all sources, through all mappings, more from tasks that comply with the target and more relevant ones.

    Paper: Lazaric, Restelli & Bonarini, "Transfer of samples in batch reinforcement learning" (ICML 2008). The compliance of a
    source task with the target is the mean probability of the target's transitions under it (Eqs. 1-6). A fixed number of
    instances is transferred, from each task in proportion to its compliance, and of a task in proportion to their relevance
    (Eq. 7). Every mapping to every source makes a virtual source task: (source, mapping) is one task among all.

    What differs from the paper:

    - The paper's tasks have the same variables and actions. Here each mapping of each source is a task, all sources being
      equally likely beforehand, and all mappings to one source. There are thousands; their compliances are never listed: an
      instance that is translated for a target action depends on the state mapping and one source action, and the compliances
      of all tasks that have these are added up.
    - Instances are drawn for each target action, the same number for all, without replacement.
    - The learner is Fitted R-Max, not fitted Q-iteration. Drawn instances help only where the target's own do not suffice: the
      nearest first, until the threshold is reached, as in :class:`~sb3_combrel.transfer.methods.timbrel.TIMBREL`.
    - The paper draws once, after a batch of transitions of the target. Here instances are drawn after ``min_transitions``, and
      again whenever there are 1.2 times as many, with the same random numbers, so that more of those drawn stay. With
      ``min_transitions`` and ``max_transitions`` equal they are drawn once.
    - As in COMBREL, a transition complies with no task whose instances are all far from it.

    What to expect: where tasks differ in one action or one pair of variables, as mappings do, their mean compliances over all
    transitions differ little, and many instances come through wrong mappings. COMBREL chooses by state and action instead.
    The number of instances does not depend on whether any task complies well: sources of no use are transferred too.

    Cost: no steps of the target but the first ``min_transitions``, in which the agent learns as without transfer. Each
    transition is compared with all instances through every state mapping and source action, Mountain Car 2D to 4D 0.3
    milliseconds; to draw after n transitions takes as long as relevance, the number of candidates times instances times n.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=SampleTransfer(source, relevance="near"))
        model.learn(total_timesteps=5_000)

    :param source: source instances, a path to them, or a list of several
    :param mappings: the mappings to each source: the name of a set ("injective", "surjective", "all", "balanced"), one of the
        paper's sets, a list of mappings or a ``MappingSet``
    :param n_instances: source instances that are drawn, at most; the same number for each target action
    :param min_transitions: transitions of the target after which instances are first drawn
    :param max_transitions: transitions that are recorded, at most
    :param breadth: kernel breadth of transferred instances, in unit coordinates
    :param breadth_decay: as of :class:`~sb3_combrel.transfer.methods.timbrel.TIMBREL`
    :param transfer_terminals: whether a source instance that ended its episode ends the target's too
    :param relevance: True: instances of a task are drawn in proportion to their relevance, Eq. 7; "near": to a relevance that
        does not favour those far from the target's transitions, ``equations.near_relevances``; False: all alike
    :param relevance_fraction: mu of Eq. 4: the fraction of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of compliance and relevance; None: from the data
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    ranks_by_relevance = False

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike = "injective",
        *,
        n_instances: int = 1000,
        min_transitions: int = 50,
        max_transitions: int = 3000,
        breadth: float = DEFAULT_BREADTH,
        breadth_decay: float = DEFAULT_BREADTH_DECAY,
        transfer_terminals: bool = True,
        relevance: bool | str = True,
        relevance_fraction: float = 0.5,
        bandwidths: tuple[float, float, float] | None = None,
    ):
        check_count("n_instances", n_instances)
        check_count("min_transitions", min_transitions)
        check_count("max_transitions", max_transitions)
        if max_transitions < min_transitions:
            raise ValueError(f"max_transitions must be at least min_transitions={min_transitions}, got {max_transitions}")
        if is_factored(mappings):
            raise ValueError(
                f"mappings must be a set whose members are tasks to draw from, no factored ones, got {mappings!r}"
            )
        super().__init__(
            source,
            mappings,
            breadth=breadth,
            breadth_decay=breadth_decay,
            transfer_terminals=transfer_terminals,
            relevance=relevance,
            relevance_fraction=relevance_fraction,
            bandwidths=bandwidths,
        )
        self.n_instances = n_instances
        self.min_transitions = min_transitions
        self.max_transitions = max_transitions

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        #: Candidate and number of its instance of those drawn, one a row, int64, shape (n, 2).
        self.drawn: np.ndarray
        self._show_drawn(np.empty((0, 2), dtype=np.int64))
        self._seed = 0
        self._n_of_draw = self._n_of_first = self._n_draws = 0

    def _make_selector(self, parts: SelectorParts, bandwidths: CandidateBandwidths) -> TaskComplianceSelector:
        check_action_mappings(parts.candidates.sets)
        self._tasks = TaskComplianceSelector(parts, *bandwidths, self.max_transitions)
        return self._tasks

    def _make_prior(self, task: TargetTask) -> SourcePrior:
        raise NotImplementedError(f"{type(self).__name__} transfers instances, it has no prior")

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        super().observe(state, action, reward, next_state, terminated)
        n = self._tasks.transitions.n
        if n > self._n_of_draw and n >= max(self.min_transitions, RELEVANCE_GROWTH * self._n_of_draw):
            self._draw(n)

    def _draw(self, n: int) -> None:
        """Draw instances by compliance with the first ``n`` transitions, and relevance to them."""
        if self._n_draws == 0:
            self._seed = int(self.rng.integers(MAX_SEED))
        self._show_drawn(self._drawn_by(n))
        self._n_of_draw = n
        self._n_draws += 1
        if self._n_of_first == 0 and len(self.drawn):
            self._n_of_first = n
        self._instances.all_changed = True

    def _drawn_by(self, n: int) -> np.ndarray:
        """Candidates and numbers of the instances that the first ``n`` transitions, the selector's, say are to be drawn."""
        assert self.task is not None
        relevances = np.ones((len(self.candidates), int(self.candidates.instances.size.max())))
        if self.relevance:
            self._instances.measure_relevance(n_used=n, values=relevances)
        compliances = candidate_compliances(self.candidates, self._tasks.sums, n)
        n_each = max(1, self.n_instances // self.task.n_actions)
        return draw_instances(self.candidates, compliances, relevances, n_each, np.random.default_rng(self._seed))

    def _show_drawn(self, drawn: np.ndarray) -> None:
        """Transfer these instances from now on."""
        assert self.task is not None
        self.drawn = drawn
        candidates = self.candidates.with_own(instances_of_each(self.candidates, drawn))
        instances = self._instances
        instances.translator = self._make_translator(candidates, self.task, instances.translator.rules.breadth)

    def task_compliance(self, mapping: InterTaskMapping, source: int = 0) -> float:
        """
        Return the compliance of one virtual source task with the target's transitions so far, Lambda_X of Eq. 6.

        :param mapping: from the target to the source; its state mapping must be of the set
        :param source: number of the source
        :return: value in [0, 1]; 0 before the first transition
        :raises ValueError: if the set has no such state mapping
        """
        return self._tasks.task_compliance(source, mapping)

    def drawn_counts(self) -> list[tuple[str, int]]:
        """Return how many of the instances in use were drawn through each candidate, the most first, by name."""
        numbers, counts = np.unique(self.drawn[:, 0], return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return [(self.describe(int(numbers[k])), int(counts[k])) for k in order]

    def mapping_steps(self) -> int:
        """Return after how many transitions of the target instances were first drawn; all so far if none have been."""
        return self._n_of_first or self._instances.n_observed

    def statistics(self) -> dict[str, float]:
        return {
            **super().statistics(),
            "transfer/instances_drawn": len(self.drawn),
            "transfer/candidates_drawn": len(np.unique(self.drawn[:, 0])),
            "transfer/draws": self._n_draws,
            "transfer/steps_to_find_mapping": self.mapping_steps(),
        }

    def get_state(self) -> dict[str, np.ndarray]:
        figures = self._seed, self._n_of_draw, self._n_of_first, self._n_draws
        return {**super().get_state(), "draw": np.array(figures, dtype=np.float64), "drawn": self.drawn.astype(np.float64)}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        super().set_state(state)
        self._seed, self._n_of_draw, self._n_of_first, self._n_draws = (int(figure) for figure in state["draw"])
        # Whatever a file says: instances that exist, of each candidate in their order.
        candidate = np.clip(state["drawn"][:, 0], 0, len(self.candidates) - 1).astype(np.int64)
        size = self.candidates.instances.size[self.candidates.arrays.action[candidate]]
        number = np.clip(state["drawn"][:, 1], 0, size - 1).astype(np.int64)
        kept = size > 0
        self._show_drawn(np.column_stack([candidate[kept], number[kept]]))
