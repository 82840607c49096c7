"""Transfer of samples: instances of several sources and mappings, drawn by compliance and relevance (Lazaric et al. 2008)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from sb3_combrel.common.checks import check_count
from sb3_combrel.common.instances import Instances
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates, MappingsLike
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.instances.compliance import ComplianceTable
from sb3_combrel.transfer.instances.instance_transfer import RELEVANCE_GROWTH
from sb3_combrel.transfer.instances.selectors import PooledSelector
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer, check_action_mappings
from sb3_combrel.transfer.prior.prior_sets import is_factored
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH

MAX_SEED = 2**53  # seeds are saved as float64


@dataclass(repr=False, eq=False)
class SampleTransfer(MappingTransfer):
    """
    Draws instances of all sources, through all mappings, more from tasks that comply with the target and more relevant ones.

    Paper: Lazaric, Restelli & Bonarini, "Transfer of samples in batch reinforcement learning" (ICML 2008). Every mapping to
    every source makes a virtual source task, whose compliance is the mean probability of the target's transitions under it
    (Eqs. 1-6). A fixed number of instances is drawn, from each task in proportion to its compliance, and of a task in
    proportion to their relevance (Eq. 7).

    What differs from the paper:

    - Its tasks have the same variables and actions. Here each mapping of each source is a task, all sources being equally
      likely beforehand, and all mappings to one; compliances of tasks with the same state mapping and source action are added
      up.
    - Instances are drawn for each target action, the same number for all, without replacement: after ``min_transitions``, and
      again whenever there are 1.2 times as many, with the same random numbers. The paper draws once, as with
      ``max_transitions`` equal.
    - The learner is Fitted R-Max, not fitted Q-iteration. Drawn instances help only where the target's own do not suffice.

    What to expect: mappings that differ in one action or pair of variables comply about equally, so many instances come
    through wrong ones, and as many are transferred where no task complies well. Only the first ``min_transitions`` are without
    transfer.

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`; it has
    neither ``use`` nor ``source_breadth``.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=SampleTransfer(source, relevance="near"))
        model.learn(total_timesteps=5_000)

    :param mappings: the mappings to each source, a set as there
    :param n_instances: source instances that are drawn, at most; the same number for each target action
    :param min_transitions: transitions of the target after which instances are first drawn
    :param max_transitions: transitions that are recorded, at most
    :param relevance: True: instances of a task are drawn in proportion to their relevance, Eq. 7; "near": to a relevance that
        does not favour those far from the target's transitions, ``equations.near_relevances``; False: all alike
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    ranks_by_relevance = False

    mappings: MappingsLike = "injective"
    _: KW_ONLY
    n_instances: int = 1000
    min_transitions: int = 50
    max_transitions: int = 3000
    relevance: bool | str = True
    use: str = field(default="instances", init=False)
    source_breadth: float = field(default=DEFAULT_SOURCE_BREADTH, init=False)

    def __post_init__(self) -> None:
        for name in ("n_instances", "min_transitions", "max_transitions"):
            check_count(name, getattr(self, name))
        if self.max_transitions < self.min_transitions:
            least = f"min_transitions={self.min_transitions}"
            raise ValueError(f"max_transitions must be at least {least}, got {self.max_transitions}")
        if is_factored(self.mappings):
            message = "mappings must be a set whose members are tasks to draw from, no factored ones, got"
            raise ValueError(f"{message} {self.mappings!r}")
        super().__post_init__()

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        self._show_drawn(np.empty((0, 2), dtype=np.int64))
        self._seed = 0
        self._n_of_draw = self._n_of_first = self._n_draws = 0

    def _make_selector(self, candidates: Candidates, bandwidths: CandidateBandwidths) -> TaskComplianceSelector:
        check_action_mappings(candidates.sets)
        self._tasks = TaskComplianceSelector(candidates, bandwidths, self.max_transitions)
        return self._tasks

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        super().observe(state, action, reward, next_state, terminated)
        n = self._tasks.transitions.n
        if n >= max(self.min_transitions, RELEVANCE_GROWTH * self._n_of_draw):
            self._draw(n)

    def _draw(self, n: int) -> None:
        """Draw instances by compliance with the first ``n`` transitions, and relevance to them."""
        if self._n_draws == 0:
            self._seed = int(self.rng.integers(MAX_SEED))
        relevances = np.ones((len(self.candidates), int(self.candidates.instances.size.max())))
        if self.relevance:
            self._instances.measure_relevance(n_used=n, values=relevances)
        compliances = candidate_compliances(self.candidates, self._tasks.sums, n)
        n_each = max(1, self.n_instances // self._bound_task.n_actions)
        generator = np.random.default_rng(self._seed)
        self._show_drawn(draw_instances(self.candidates, compliances, relevances, n_each, generator))
        self._n_of_draw = n
        self._n_draws += 1
        if self._n_of_first == 0 and len(self.drawn):
            self._n_of_first = n
        self._instances.all_changed = True

    def _show_drawn(self, drawn: np.ndarray) -> None:
        self.drawn = drawn  #: candidate and number of its instance of those drawn, one a row, int64, shape (n, 2)
        candidates = self.candidates.with_own(instances_of_each(self.candidates, drawn))
        instances = self._instances
        instances.translator = self._make_translator(candidates, instances.translator.rules.breadth)

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
        self._show_drawn(state["drawn"].astype(np.int64))


class TaskComplianceSelector(PooledSelector):
    """Selects all candidates of an action, and adds up the compliance of the target's transitions with each (Eq. 6)."""

    needs_transitions = True

    def __init__(self, candidates: Candidates, bandwidths: CandidateBandwidths, max_transitions: int):
        super().__init__(candidates)
        self.max_transitions = max_transitions
        self._table = ComplianceTable(candidates, bandwidths)
        n_rows, n_source_actions = self._table.values.shape
        #: Compliances of transitions added up, by state mapping, target action and source action, of all sources.
        self.sums = np.zeros((n_rows, self.task.n_actions, n_source_actions))

    def add_transition(self, i: int) -> None:
        self._table.measure(self.transitions, i)
        self.sums[:, int(self.transitions.actions[i])] += self._table.values


def mean_compliances(mappings: MappingSet, sums: np.ndarray, n_transitions: int) -> np.ndarray:
    """Return sum over X of Lambda_X (Eq. 6) / n_mappings by state mapping, target and source action, as ``sums`` are."""
    n_rows, n_actions, n_source_actions = sums.shape
    if mappings.combines_freely:
        # In the mean over all source actions that the other target actions may have.
        of_action = sums.mean(axis=2)
        everything: np.ndarray = sums + (of_action.sum(axis=1, keepdims=True) - of_action)[:, :, None]
        return everything / (n_transitions * n_rows * n_source_actions)
    found = np.zeros_like(sums)
    for rows, actions in mappings.members():
        members = rows[:, None], np.arange(n_actions), actions
        np.add.at(found, members, (sums[members].sum(axis=1) / (n_transitions * mappings.n_mappings))[:, None])
    return found


def candidate_compliances(candidates: Candidates, sums: np.ndarray, n_transitions: int) -> np.ndarray:
    """Return for each candidate the compliance of all tasks that have it, added up; ``sums``: of all sources, numbered on."""
    found = np.zeros_like(sums)
    for k, mappings in enumerate(candidates.sets):
        rows, actions = slice(*candidates.first_row[k : k + 2]), slice(*candidates.first_action[k : k + 2])
        each = mean_compliances(mappings, sums[rows, :, actions], n_transitions) / len(candidates.sources)
        # Of equal state mappings one is a candidate, which stands for all.
        same = np.unique(np.hstack([mappings.state_mappings, mappings.state_signs]), axis=0, return_inverse=True)[1].ravel()
        of_equal = np.zeros_like(each)
        np.add.at(of_equal, same, each)
        found[rows, :, actions] = of_equal[same]
    target_actions = [origin.target_action for origin in candidates.origins]
    of_candidates: np.ndarray = found[candidates.arrays.row, target_actions, candidates.arrays.action]
    return of_candidates


def draw_instances(
    candidates: Candidates, compliances: np.ndarray, relevances: np.ndarray, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw ``n`` instances at most for each target action, without replacement: candidate and number, shape (n_drawn, 2).

    A candidate in proportion to its compliance, and of it an instance in proportion to its relevance, of those that are left:
    the n largest of log-probabilities with Gumbel noise, which is the same.
    """
    exists = np.arange(relevances.shape[1]) < candidates.instances.size[candidates.arrays.action][:, None]
    relevant = np.where(exists, relevances, 0.0)
    total = relevant.sum(axis=1, keepdims=True)
    probability = compliances[:, None] * np.divide(relevant, total, out=np.zeros_like(relevant), where=total > 0.0)
    noise = rng.gumbel(size=probability.shape)
    rank = np.log(probability, out=np.full_like(probability, -np.inf), where=probability > 0.0) + noise
    found = []
    for first, last in zip(candidates.arrays.first[:-1], candidates.arrays.first[1:], strict=True):
        of_action = rank[first:last].ravel()
        best = np.argsort(-of_action, kind="stable")[:n]
        best = np.sort(best[of_action[best] > -np.inf])
        found.append(np.column_stack([first + best // rank.shape[1], best % rank.shape[1]]))
    return np.vstack(found).astype(np.int64)


def instances_of_each(candidates: Candidates, drawn: np.ndarray) -> Instances:
    """Return what :func:`draw_instances` has drawn, by candidate, in the coordinates of their sources."""
    source, (candidate, number) = candidates.instances, drawn.T
    at = candidates.arrays.action[candidate], number
    columns = source.state[at], source.effect[at], source.reward[at], source.terminated[at]
    return Instances.of_rows(len(candidates), candidate, *columns, periodic=source.periodic)
