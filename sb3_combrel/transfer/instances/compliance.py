"""Compliance: how probable target transitions are under the source task, mapping by mapping (Eqs. 2, 3, 5 and 6).

For a transition with target action a, compliance depends on the state mapping and on the one source action that a
maps to. A table [state mapping, source action] for each transition therefore holds the compliance of every pair of a
state and an action mapping, however many there are. And since the kernel exp(-d^2 / delta) of a Euclidean distance is
a product of one factor a variable, the exponentials needed are one for each pair of a target and a source variable,
whatever the number of state mappings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, inner_fast, part
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.periodic import difference, flag_array
from sb3_combrel.transfer.candidates import MappingTable
from sb3_combrel.transfer.equations import Bandwidths

# The weight of one instance at a distance of sqrt(2.3 delta). Where the sum of start kernels is less, no instance is near
# enough to be evidence: normalized, a far instance would look as good as a near one.
DEFAULT_MIN_EVIDENCE = 0.1


class RewardCounts(NamedTuple):
    """
    The rewards of source instances.

    :param value: the different ones, raw, shape (n,)
    :param fraction: which fraction of all instances has each of them, same shape
    """

    value: np.ndarray
    fraction: np.ndarray

    @classmethod
    def of_instances(cls, source: Instances) -> "RewardCounts":
        """Count those of all source actions."""
        rewards = [source.reward[action, :n] for action, n in enumerate(source.size)]
        value, count = np.unique(np.concatenate(rewards), return_counts=True)
        return cls(value, count / count.sum())


class ComplianceScratch(NamedTuple):
    """
    Work space, and the state mappings in the form that the inner loop reads.

    A *factor* is a combination of a target variable, a source variable and (not) mirrored that some mapping uses; a *start
    factor* is one with a start bandwidth.

    :param variable: int64, shape (n_factors,): target variable of each factor
    :param source: int64, same shape: source variable
    :param mirrored: bool, same shape
    :param first: int64, shape (n_state_mappings + 1,): the factors of mapping m are
        ``factors[first[m] : first[m + 1]]``
    :param factors: int64
    :param starts: int64, shape of ``factors``: the same for start factors
    :param start_factor: int64, shape (n_start_factors,): the factor of each; ``start_bandwidth``: float64, same shape
    :param state: float64, shape (n_source_actions, n_source_variables, n): the source instances' states, variable by
        variable: the inner loops read them in a row; ``effect``: the same of their effects
    :param start: float64, shape (n_start_factors, n): kernel of where a transition and each source instance start
    :param outcome: float64, shape (n_factors, n): the same for outcomes
    :param reward: float64, shape (n,): the same for rewards
    :param weight: float64, shape (n,): product of a mapping's start kernels; ``hit``: of its outcome kernels
    :param still: float64, shape (n_state_mappings,): outcome kernel of the variables predicted not to change
    :param min_evidence: sum of start kernels below which a mapping has no compliance
    :param periodic: bool, shape (n_target_variables,): which variables of the target are periodic
    """

    variable: np.ndarray
    source: np.ndarray
    mirrored: np.ndarray
    first: np.ndarray
    factors: np.ndarray
    starts: np.ndarray
    start_factor: np.ndarray
    start_bandwidth: np.ndarray
    state: np.ndarray
    effect: np.ndarray
    start: np.ndarray
    outcome: np.ndarray
    reward: np.ndarray
    weight: np.ndarray
    hit: np.ndarray
    still: np.ndarray
    min_evidence: float
    periodic: np.ndarray

    @classmethod
    def for_mappings(
        cls,
        mappings: MappingTable,
        source: Instances,
        start: np.ndarray | float,
        min_evidence: float = DEFAULT_MIN_EVIDENCE,
        periodic: Sequence[bool] | None = None,
    ) -> "ComplianceScratch":
        """
        Make work space for a table of state mappings and the instances of a source.

        :param start: start bandwidth, of all mappings or of each, shape (n_state_mappings,)
        :param min_evidence: see the class
        :param periodic: see the class; None: none is periodic
        """
        largest = int(source.size.max())
        number: dict[tuple[int, int, bool], int] = {}
        start_number: dict[tuple[int, float], int] = {}
        first, factors, starts = [0], [], []
        of_mapping = np.broadcast_to(start, len(mappings.variable))
        for index, sign, bandwidth in zip(mappings.variable, mappings.sign, of_mapping.tolist(), strict=True):
            for v in np.flatnonzero(index >= 0):
                factors.append(number.setdefault((int(v), int(index[v]), bool(sign[v] < 0.0)), len(number)))
                starts.append(start_number.setdefault((factors[-1], bandwidth), len(start_number)))
            first.append(len(factors))
        n_mappings, keys = len(mappings.variable), list(number)
        return cls(
            variable=np.array([v for v, _, _ in keys], dtype=np.int64),
            source=np.array([k for _, k, _ in keys], dtype=np.int64),
            mirrored=np.array([m for _, _, m in keys], dtype=np.bool_),
            first=np.array(first, dtype=np.int64),
            factors=np.array(factors, dtype=np.int64),
            starts=np.array(starts, dtype=np.int64),
            start_factor=np.array([f for f, _ in start_number], dtype=np.int64),
            start_bandwidth=np.array([bandwidth for _, bandwidth in start_number]),
            state=np.ascontiguousarray(source.state[:, :largest].transpose(0, 2, 1)),
            effect=np.ascontiguousarray(source.effect[:, :largest].transpose(0, 2, 1)),
            start=np.empty((len(start_number), largest)),
            outcome=np.empty((len(keys), largest)),
            reward=np.empty(largest),
            weight=np.empty(largest),
            hit=np.empty(largest),
            still=np.empty(n_mappings),
            min_evidence=float(min_evidence),
            periodic=flag_array(periodic, mappings.variable.shape[1]),
        )


# Kernel arguments beyond this make less than 1e-17: the kernel is cut there.
FARTHEST = 40.0


@inner_fast
def _exponentiate(row, n):
    """Replace the first ``n`` entries x >= 0 by exp(-min(x, FARTHEST)), to 12 digits.

    The Taylor polynomial of exp(-x / 64), raised to the 64th power by squaring six times: multiplications only, so the
    loop runs in vector registers, which a call of exp would not.
    """
    for j in range(n):
        x = row[j]
        y = (x if x < FARTHEST else FARTHEST) * (-1.0 / 64.0)
        value = 1.0 + y * (1.0 / 13.0)
        value = 1.0 + y * (1.0 / 12.0) * value
        value = 1.0 + y * (1.0 / 11.0) * value
        value = 1.0 + y * (1.0 / 10.0) * value
        value = 1.0 + y * (1.0 / 9.0) * value
        value = 1.0 + y * (1.0 / 8.0) * value
        value = 1.0 + y * (1.0 / 7.0) * value
        value = 1.0 + y * (1.0 / 6.0) * value
        value = 1.0 + y * (1.0 / 5.0) * value
        value = 1.0 + y * (1.0 / 4.0) * value
        value = 1.0 + y * (1.0 / 3.0) * value
        value = 1.0 + y * (1.0 / 2.0) * value
        value = 1.0 + y * value
        value *= value
        value *= value
        value *= value
        value *= value
        value *= value
        row[j] = value * value


@inner_fast
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


@inner_fast
def _kernel_factors(state, effect, reward, source, action, bandwidths, scratch):
    """Fill ``scratch.start``, ``outcome`` and ``reward`` for all source instances of ``action``."""
    n = source.size[action]
    for f in range(len(scratch.variable)):
        v = scratch.variable[f]
        k = scratch.source[f]
        side = -1.0 if scratch.mirrored[f] else 1.0
        periodic = scratch.periodic[v]
        _squares(side * effect[v], scratch.effect[action, k], bandwidths.outcome, periodic, scratch.outcome[f], n)
        _exponentiate(scratch.outcome[f], n)
    for s in range(len(scratch.start_factor)):
        f = scratch.start_factor[s]
        at = state[scratch.variable[f]]
        at = 1.0 - at if scratch.mirrored[f] else at
        periodic = scratch.periodic[scratch.variable[f]]
        of_source = scratch.state[action, scratch.source[f]]
        _squares(at, of_source, scratch.start_bandwidth[s], periodic, scratch.start[s], n)
        _exponentiate(scratch.start[s], n)
    for j in range(n):
        off = reward - source.reward[action, j]
        scratch.reward[j] = off * off / bandwidths.reward
    _exponentiate(scratch.reward, n)


@inner_fast
def _mapping_compliance(m, n, scratch):
    """Return the compliance through state mapping ``m`` with ``n`` instances, but for the factor of unmapped variables."""
    for j in range(n):
        scratch.weight[j] = 1.0
        scratch.hit[j] = 1.0
    for t in range(scratch.first[m], scratch.first[m + 1]):
        f = scratch.factors[t]
        s = scratch.starts[t]
        for j in range(n):
            scratch.weight[j] *= scratch.start[s, j]
            scratch.hit[j] *= scratch.outcome[f, j]
    total = 0.0
    transition = 0.0
    rewarded = 0.0
    for j in range(n):
        total += scratch.weight[j]
        transition += scratch.weight[j] * scratch.hit[j]
        rewarded += scratch.weight[j] * scratch.reward[j]
    return 0.0 if total < scratch.min_evidence else (transition / total) * (rewarded / total)


@part
def _still_factors(effect, mappings, bandwidth, still):
    """Write to ``still`` the outcome kernel of each mapping's unmapped variables, which are predicted not to change."""
    for m in range(mappings.variable.shape[0]):
        missed = 0.0
        for v in range(len(effect)):
            if mappings.variable[m, v] < 0:
                missed += effect[v] * effect[v]
        still[m] = np.exp(-missed / bandwidth)


@part
def transition_compliance(state, effect, reward, source, mappings, bandwidths, scratch, table):
    """
    Compute the compliance of one target transition through every state mapping, for every source action (Eq. 5).

    The transition function's factor is the mean of phi(d(s', s + (s_j' - s_j))) weighted by w_ij (Eq. 2), the reward
    function's the mean of phi(|r - r_j|), both over the source instances of one action. Z^P and Z^R are left out: they
    are the same for all mappings, and would hide what is to be compared if they were not. An unmapped variable adds
    nothing to where a transition starts, and is predicted not to change.

    :param state: unit coordinates of the target, shape (n_target_variables,)
    :param effect: next state minus state, same shape
    :param source: Instances of the source, in its own unit coordinates
    :param bandwidths: of outcome and reward; those of starts are in ``scratch``
    :param scratch: ComplianceScratch for ``mappings``
    :param table: receives the compliances, shape (n_state_mappings, n_source_actions); 0 where no instance is near
    """
    _still_factors(effect, mappings, bandwidths.outcome, scratch.still)
    for action in range(len(source.size)):
        _kernel_factors(state, effect, reward, source, action, bandwidths, scratch)
        for m in range(mappings.variable.shape[0]):
            table[m, action] = scratch.still[m] * _mapping_compliance(m, source.size[action], scratch)


@compiled
def transition_compliance_plain(state, effect, reward, source, mappings, bandwidths, scratch, table):
    """:func:`transition_compliance` for callers from Python, with plain tuples."""
    source, mappings, scratch = Instances(*source), MappingTable(*mappings), ComplianceScratch(*scratch)
    transition_compliance(state, effect, reward, source, mappings, Bandwidths(*bandwidths), scratch, table)


def no_change_compliance(effect: np.ndarray, reward: float, rewards: RewardCounts, bandwidths: Bandwidths) -> float:
    """
    Return the compliance of one target transition with the no-change baseline.

    It predicts that no variable changes, and any of the source's rewards, each as often as it occurs there. A mapping that
    predicts worse than this is of no use.

    :param effect: next state minus state, shape (n_target_variables,)
    :param reward: raw
    """
    rewarded = rewards.fraction @ np.exp(-((reward - rewards.value) ** 2) / bandwidths.reward)
    return float(np.exp(-(effect @ effect) / bandwidths.outcome) * rewarded)


@compiled
def compliance_table(states, effects, rewards, source, mappings, bandwidths, scratch, tables):
    """:func:`transition_compliance` of many transitions; ``tables`` has one table a transition."""
    for i in range(len(rewards)):
        transition_compliance(states[i], effects[i], rewards[i], source, mappings, bandwidths, scratch, tables[i])


def task_compliance(tables: np.ndarray, actions: np.ndarray, state_index: int, action_mapping: np.ndarray) -> float:
    """
    Return the compliance of the whole target sample with one virtual source task (Eq. 6, all mappings equally likely).

    :param tables: shape (n_transitions, n_state_mappings, n_source_actions)
    :param actions: target action of each transition, shape (n_transitions,)
    :param action_mapping: source action of each target action, shape (n_target_actions,)
    """
    return float(tables[np.arange(len(actions)), state_index, np.asarray(action_mapping)[actions]].mean())
