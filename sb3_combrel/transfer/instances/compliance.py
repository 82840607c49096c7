"""Compliance: how probable target transitions are under the source task, mapping by mapping (Eqs. 2, 3, 5 and 6).

For a transition with target action a, compliance depends on the state mapping and on the one source action that a maps to. A
table [state mapping, source action] for each transition therefore holds the compliance of every pair of a state and an action
mapping. And since the kernel exp(-d^2 / delta) of a Euclidean distance is a product of one factor a variable, one exponential
is needed for each pair of a target and a source variable, whatever the number of state mappings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled_fast, entry_point
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.periodic import difference, flag_array
from sb3_combrel.transfer.candidates import Candidates, MappingTable
from sb3_combrel.transfer.equations import Bandwidths
from sb3_combrel.transfer.instances.bandwidths import CandidateBandwidths
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

# Where the sum of start kernels is less, no instance is near enough to be evidence: normalized, a far one would look as good.
DEFAULT_MIN_EVIDENCE = 0.1


class ComplianceScratch(NamedTuple):
    """Work space, and the state mappings in the form that the inner loop reads; n is the most instances of an action.

    A *factor* is a combination of a target variable, a source variable, (not) mirrored and a start bandwidth that some mapping
    uses.
    """

    variable: np.ndarray  # int64, shape (n_factors,): target variable
    source: np.ndarray  # int64, same shape: source variable
    mirrored: np.ndarray  # bool, same shape
    bandwidth: np.ndarray  # float64, same shape: start bandwidth
    first: np.ndarray  # int64, shape (n_state_mappings + 1,): mapping m has factors[first[m] : first[m + 1]]
    factors: np.ndarray  # int64
    state: np.ndarray  # float64, shape (n_source_actions, n_source_variables, n): the instances' states by variable
    effect: np.ndarray  # the same of their effects
    start: np.ndarray  # float64, shape (n_factors, n): kernel of where a transition and each instance start
    outcome: np.ndarray  # the same for outcomes
    reward: np.ndarray  # float64, shape (n,): the same for rewards
    weight: np.ndarray  # float64, shape (n,): product of a mapping's start kernels
    hit: np.ndarray  # the same of its outcome kernels
    min_evidence: float  # sum of start kernels below which a mapping has no compliance
    periodic: np.ndarray  # bool, shape (n_target_variables,)

    @classmethod
    def for_mappings(
        cls,
        mappings: MappingTable,
        source: Instances,
        start: np.ndarray | float,
        min_evidence: float = DEFAULT_MIN_EVIDENCE,
        periodic: Sequence[bool] | None = None,
    ) -> "ComplianceScratch":
        """Make work space; ``start``: start bandwidth, of all mappings or of each, shape (n_state_mappings,)."""
        largest = int(source.size.max())
        number: dict[tuple[int, int, bool, float], int] = {}
        first, factors = [0], []
        of_mapping = np.broadcast_to(start, len(mappings.variable))
        for index, sign, bandwidth in zip(mappings.variable, mappings.sign, of_mapping.tolist(), strict=True):
            for v in np.flatnonzero(index >= 0).tolist():
                factors.append(number.setdefault((v, int(index[v]), bool(sign[v] < 0.0), bandwidth), len(number)))
            first.append(len(factors))
        return cls(
            variable=np.array([v for v, _, _, _ in number], dtype=np.int64),
            source=np.array([k for _, k, _, _ in number], dtype=np.int64),
            mirrored=np.array([m for _, _, m, _ in number], dtype=np.bool_),
            bandwidth=np.array([bandwidth for _, _, _, bandwidth in number]),
            first=np.array(first, dtype=np.int64),
            factors=np.array(factors, dtype=np.int64),
            state=np.ascontiguousarray(source.state[:, :largest].transpose(0, 2, 1)),
            effect=np.ascontiguousarray(source.effect[:, :largest].transpose(0, 2, 1)),
            start=np.empty((len(number), largest)),
            outcome=np.empty((len(number), largest)),
            reward=np.empty(largest),
            weight=np.empty(largest),
            hit=np.empty(largest),
            min_evidence=float(min_evidence),
            periodic=flag_array(periodic, mappings.variable.shape[1]),
        )


# Kernel arguments beyond this make less than 1e-17: the kernel is cut there.
FARTHEST = 40.0


@compiled_fast
def _exponentiate(row, n):
    """Replace the first ``n`` entries x >= 0 by exp(-min(x, FARTHEST)), to 12 digits.

    By the Taylor polynomial of exp(-x / 64), squared six times: multiplications alone run in vector registers.
    """
    for j in range(n):
        x = row[j]
        y = (x if x < FARTHEST else FARTHEST) * (-1.0 / 64.0)
        value = 1.0
        for k in range(13):
            value = 1.0 + y * (1.0 / (13 - k)) * value
        for _ in range(6):
            value *= value
        row[j] = value


@compiled_fast
def _squares(at, of_source, bandwidth, periodic, row, n):
    """Write to ``row`` the squared distances of ``at`` from what the source instances have, over the bandwidth."""
    scale = 1.0 / bandwidth
    if periodic:
        for j in range(n):
            apart = difference(at, of_source[j], True)
            row[j] = apart * apart * scale
    else:
        for j in range(n):
            apart = at - of_source[j]
            row[j] = apart * apart * scale


@compiled_fast
def _kernel_factors(state, effect, reward, source, action, bandwidths, scratch):
    """Fill ``scratch.start``, ``outcome`` and ``reward`` for the source instances of ``action``."""
    n = source.size[action]
    for f in range(len(scratch.variable)):
        v = scratch.variable[f]
        k = scratch.source[f]
        side = -1.0 if scratch.mirrored[f] else 1.0
        periodic = scratch.periodic[v]
        at = 1.0 - state[v] if scratch.mirrored[f] else state[v]
        _squares(at, scratch.state[action, k], scratch.bandwidth[f], periodic, scratch.start[f], n)
        _exponentiate(scratch.start[f], n)
        _squares(side * effect[v], scratch.effect[action, k], bandwidths.outcome, periodic, scratch.outcome[f], n)
        _exponentiate(scratch.outcome[f], n)
    for j in range(n):
        off = reward - source.reward[action, j]
        scratch.reward[j] = off * off / bandwidths.reward
    _exponentiate(scratch.reward, n)


@compiled_fast
def _mapping_compliance(m, n, scratch):
    """Return the compliance through state mapping ``m`` with ``n`` instances, but for the factor of unmapped variables."""
    for j in range(n):
        scratch.weight[j] = 1.0
        scratch.hit[j] = 1.0
    for t in range(scratch.first[m], scratch.first[m + 1]):
        f = scratch.factors[t]
        for j in range(n):
            scratch.weight[j] *= scratch.start[f, j]
            scratch.hit[j] *= scratch.outcome[f, j]
    total = 0.0
    transition = 0.0
    rewarded = 0.0
    for j in range(n):
        total += scratch.weight[j]
        transition += scratch.weight[j] * scratch.hit[j]
        rewarded += scratch.weight[j] * scratch.reward[j]
    if total < scratch.min_evidence or total == 0.0:
        return 0.0
    return (transition / total) * (rewarded / total)


@entry_point
def transition_compliance(state, effect, reward, source, mappings, bandwidths, scratch, table):
    """Compute the compliance of one target transition through every state mapping, for every source action (Eq. 5).

    An unmapped variable adds nothing to where a transition starts, and is predicted not to change.

    :param state: unit coordinates of the target, shape (n_target_variables,); ``effect``: next state minus state
    :param scratch: ComplianceScratch for ``mappings``; plain tuple, as the other structures
    :param table: receives the compliances, shape (n_state_mappings, n_source_actions); 0 where no instance is near
    """
    source, mappings, scratch = Instances(*source), MappingTable(*mappings), ComplianceScratch(*scratch)
    bandwidths = Bandwidths(*bandwidths)
    for action in range(len(source.size)):
        _kernel_factors(state, effect, reward, source, action, bandwidths, scratch)
        for m in range(mappings.variable.shape[0]):
            missed = 0.0
            for v in range(len(effect)):
                if mappings.variable[m, v] < 0:
                    missed += effect[v] * effect[v]
            still = np.exp(-missed / bandwidths.outcome)
            table[m, action] = still * _mapping_compliance(m, source.size[action], scratch)


class ComplianceTable:
    """Computes compliance with all candidates of a set, one transition after the other."""

    def __init__(self, candidates: Candidates, bandwidths: CandidateBandwidths, min_evidence: float = DEFAULT_MIN_EVIDENCE):
        table, instances = candidates.table, candidates.instances
        #: Compliance of the last transition, shape (n_state_mappings, n_source_actions).
        self.values = np.empty((len(table.variable), len(instances.size)))
        scratch = ComplianceScratch.for_mappings(table, instances, bandwidths.starts, min_evidence, candidates.task.periodic)
        # Plain tuples for compiled code are made once, not at every step (see ``common.compiled``).
        self._given = tuple(instances), tuple(table), tuple(bandwidths.of_all), tuple(scratch), self.values
        self._bandwidths = bandwidths.of_all
        rewards = np.concatenate([source.rewards for source in candidates.sources])
        # The different rewards of source instances, and which fraction of all has each of them.
        self._rewards, count = np.unique(rewards, return_counts=True)
        self._fraction = count / count.sum()

    def measure(self, transitions: RecordedTransitions, i: int) -> None:
        """Compute the compliance of transition ``i``."""
        transition = transitions.states[i], transitions.effects[i], float(transitions.rewards[i])
        transition_compliance.call(*transition, *self._given)

    def no_change(self, transitions: RecordedTransitions, i: int) -> float:
        """Compliance with the prediction of no change, and of each of the source's rewards as often as it occurs there."""
        effect, reward = transitions.effects[i], float(transitions.rewards[i])
        rewarded = self._fraction @ np.exp(-((reward - self._rewards) ** 2) / self._bandwidths.reward)
        return float(np.exp(-(effect @ effect) / self._bandwidths.outcome) * rewarded)
