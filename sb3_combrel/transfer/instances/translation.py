"""The translator: source instances become instances of the target, as many as a state-action pair lacks."""

from __future__ import annotations

import itertools

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, part
from sb3_combrel.common.instances import BLOCK
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.periodic import difference
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.instances.selectors import Ranges
from sb3_combrel.transfer.instances.translation_arrays import (
    CandidateMappings,
    SourceArrays,
    TranslationArrays,
    TranslationRules,
    TranslationScratch,
    as_arrays,
)

# Instances of a state and action by distance, at most; by relevance room is made for as many as it takes.
MAX_TRANSFERRED = 32

# Columns of the scratch arrays of the selected instances.
_INSTANCE, _CANDIDATE = 0, 1
_RANK, _WEIGHT = 0, 1


@part
def consider(j, candidate, weight, rank, own, kept, rules, scratch):
    """
    Add an instance to the list of the selected, the highest rank first, and cut what is not needed any more.

    An instance is needed while those before it and ``own`` do not reach the threshold, and while it has at least
    ``min_fraction`` of their weight. These sums only grow, so what is cut once would be cut for ever.

    :param kept: how many are in the list
    :param scratch: TranslationScratch that holds it
    :return: how many are now, and the least weight with which a further instance could enter (by weight)
    """
    number, value = scratch.number, scratch.value
    room = len(value) - 1
    k = kept
    while k > 0 and value[k - 1, _RANK] < rank:
        number[k, _INSTANCE] = number[k - 1, _INSTANCE]
        number[k, _CANDIDATE] = number[k - 1, _CANDIDATE]
        value[k, _RANK] = value[k - 1, _RANK]
        value[k, _WEIGHT] = value[k - 1, _WEIGHT]
        k -= 1
    number[k, _INSTANCE] = j
    number[k, _CANDIDATE] = candidate
    value[k, _RANK] = rank
    value[k, _WEIGHT] = weight
    total = own
    for k in range(min(kept + 1, room)):
        if not rules.times_weight and value[k, _WEIGHT] < rules.min_fraction * total:
            # Heavier than the last of the list, one need not have that fraction of the last's weight as well.
            enters = rules.min_fraction * total
            return k, min(enters, value[k - 1, _WEIGHT]) if k > 0 else enters
        total += value[k, _WEIGHT]
        if total >= rules.threshold:
            scratch.enters[0] = value[k, _RANK]
            return k + 1, value[k, _WEIGHT]
    if kept + 1 > room:
        scratch.full[0] = True
    return min(kept + 1, room), value[room - 1, _WEIGHT] if kept + 1 >= room else 0.0


@part
def gather(state, own, candidate, arrays, kept):
    """
    Add the translated instances of one candidate that weigh at least ``min_weight`` at ``state`` to the selected.

    :param own: weight of the target's own instances at ``state``
    :param arrays: TranslationArrays, whose scratch holds the selected
    :param kept: how many there are
    :return: how many are now
    """
    source, rules, scratch = arrays.source, arrays.rules, arrays.scratch
    row = arrays.mappings.row[candidate]
    action = arrays.mappings.action[candidate]
    variable = arrays.mappings.variable[row]
    sign = arrays.mappings.sign[row]
    scale = -1.0 / (rules.breadth * rules.breadth)
    far = np.log(rules.min_weight) / scale
    n_mapped = 0
    for v in range(len(state)):
        k = variable[v]
        if k >= 0:
            mirrored = sign[v] < 0.0
            scratch.variable[n_mapped] = k
            scratch.periodic[n_mapped] = arrays.periodic[v]
            scratch.at[n_mapped] = 1.0 - state[v] if mirrored else state[v]
            n_mapped += 1
    size = source.size[action]
    low, high = source.block_low[action], source.block_high[action]
    nearest_block = measure_blocks(low, high, size, n_mapped, scratch)
    nearest = far
    # The instances in the nearest block exclude most other blocks.
    for turn in range(-1, (size + BLOCK - 1) // BLOCK):
        block = nearest_block if turn < 0 else turn
        if turn == nearest_block or scratch.gap[block] > nearest:
            continue
        for j in range(block * BLOCK, min(size, (block + 1) * BLOCK)):
            if rules.times_weight and arrays.relevance[candidate, j] <= scratch.enters[0]:
                continue
            apart = 0.0
            for m in range(n_mapped):
                along = difference(scratch.at[m], source.state[action, j, scratch.variable[m]], scratch.periodic[m])
                apart += along * along
            if apart <= nearest:
                weight = np.exp(apart * scale)
                rank = weight * arrays.relevance[candidate, j] if rules.times_weight else weight
                kept, enters = consider(j, candidate, weight, rank, own, kept, rules, scratch)
                if rules.times_weight:
                    # No relevance exceeds 1: what is lighter than the least rank that is needed has a lower one.
                    enters = scratch.enters[0]
                if enters > rules.min_weight:
                    nearest = np.log(enters) / scale * (1 + 1e-12)
    return kept


@part
def take_most_relevant(state, own, first, last, arrays):
    """
    Select the translated instances of some candidates in the order of their relevance, which is known before the state is.

    So only as many are looked at as it takes to reach the threshold.

    :param own: weight of the target's own instances at ``state``
    :param first: the first candidate; ``last``: one past the last. All that ``arrays.order`` has together
    :param arrays: TranslationArrays, whose scratch receives the selected
    :return: how many they are
    """
    source, mappings, rules, scratch = arrays.source, arrays.mappings, arrays.rules, arrays.scratch
    most = arrays.relevance.shape[1]
    scale = -1.0 / (rules.breadth * rules.breadth)
    far = np.log(rules.min_weight) / scale
    total = own
    kept = 0
    for place in range(first * most, last * most):
        pair = arrays.order[place]
        if pair < 0 or total >= rules.threshold:
            break
        candidate = pair // most
        j = pair - candidate * most
        row, action = mappings.row[candidate], mappings.action[candidate]
        apart = 0.0
        for v in range(len(state)):
            k = mappings.variable[row, v]
            if k >= 0:
                at = 1.0 - state[v] if mappings.sign[row, v] < 0.0 else state[v]
                along = difference(at, source.state[action, j, k], arrays.periodic[v])
                apart += along * along
        if apart > far:
            continue
        if kept == len(scratch.value) - 1:
            scratch.full[0] = True
            break
        scratch.number[kept, _INSTANCE] = j
        scratch.number[kept, _CANDIDATE] = candidate
        scratch.value[kept, _WEIGHT] = np.exp(apart * scale)
        total += scratch.value[kept, _WEIGHT]
        kept += 1
    return kept


@part
def measure_blocks(low, high, size, n_mapped, scratch):
    """Write to ``scratch.gap`` the squared distance of each block's box, in the mapped variables; return the nearest block."""
    variable, at, gap = scratch.variable, scratch.at, scratch.gap
    nearest_block = 0
    for block in range((size + BLOCK - 1) // BLOCK):
        total = 0.0
        for m in range(n_mapped):
            k = variable[m]
            below = low[k, block] - at[m]
            above = at[m] - high[k, block]
            outside = below if below > above else above
            if scratch.periodic[m]:
                # Around the other way the far end of the box is the nearer one.
                outside = min(outside, 1.0 + min(below, above))
            if outside > 0.0:
                total += outside * outside
        gap[block] = total
        if total < gap[nearest_block]:
            nearest_block = block
    return nearest_block


@part
def write_row(s, own, kept, arrays, transferred):
    """Write the selected instances to row ``s`` of ``transferred``, if they and ``own`` reach the threshold."""
    source, mappings, rules = arrays.source, arrays.mappings, arrays.rules
    number, value = arrays.scratch.number, arrays.scratch.value
    total = own
    for n in range(kept):
        total += value[n, _WEIGHT]
    if total < rules.threshold:
        return
    transferred.length[s] = kept
    for n in range(kept):
        j = number[n, _INSTANCE]
        row = mappings.row[number[n, _CANDIDATE]]
        action = mappings.action[number[n, _CANDIDATE]]
        transferred.weight[s, n] = value[n, _WEIGHT]
        transferred.reward[s, n] = source.reward[action, j]
        transferred.terminated[s, n] = rules.transfer_terminals and source.terminated[action, j]
        for v in range(mappings.variable.shape[1]):
            k = mappings.variable[row, v]
            transferred.effect[s, n, v] = mappings.sign[row, v] * source.effect[action, j, k] if k >= 0 else 0.0


@part
def translate(states, own, ranges, arrays, transferred):
    """
    Translate instances for states and actions (see ``Transfer.transferred``).

    :param states: unit coordinates, shape (n, n_variables)
    :param own: weight of the target's own instances there, shape (n,)
    :param ranges: (first candidate whose instances may be used, one past the last: none if equal), shape (n,) each
    :param arrays: TranslationArrays
    :param transferred: receives the instances, at least n rows
    """
    first, last = ranges
    for s in range(len(own)):
        transferred.length[s] = 0
        if own[s] >= arrays.rules.threshold:
            continue
        kept = np.int64(0)
        if arrays.rules.by_relevance and not arrays.rules.times_weight:
            kept = take_most_relevant(states[s], own[s], first[s], last[s], arrays)
        else:
            arrays.scratch.enters[0] = -np.inf
            for candidate in range(first[s], last[s]):
                kept = gather(states[s], own[s], candidate, arrays, kept)
        write_row(s, own[s], kept, arrays, transferred)


@compiled
def translate_plain(states, own, ranges, arrays, transferred):
    """:func:`translate` for callers from Python, with plain tuples."""
    translate(states, own, ranges, as_arrays(arrays), TransferredInstances(*transferred))


_translate = EntryPoint(translate_plain)


def most_relevant_first(relevance: np.ndarray, sizes: np.ndarray, pools: np.ndarray) -> np.ndarray:
    """
    Sort the instances of pools of candidates by relevance; of those that are equally relevant the first comes first.

    :param relevance: shape (n_candidates, most instances of an action)
    :param sizes: how many instances each candidate has, int64, shape (n_candidates,)
    :param pools: the first candidate of each pool, and ``n_candidates``, int64
    :return: see ``TranslationArrays.order``
    """
    most = relevance.shape[1]
    missing = np.arange(most) >= sizes[:, None]
    rank = np.where(missing, np.inf, -relevance).ravel()
    order = np.empty(rank.shape, dtype=np.int64)
    for first, last in itertools.pairwise((pools * most).tolist()):
        order[first:last] = first + np.argsort(rank[first:last], kind="stable")
    order[missing.ravel()[order]] = -1
    return order


class Translator:
    """
    Translates instances of selected candidates, with the arrays that this takes.

    :param candidates: the candidates of every target action
    :param task: the target task
    :param breadth: kernel breadth of transferred instances, unit coordinates
    :param transfer_terminals: see ``TranslationRules``; ``by_relevance`` and ``times_weight``: the same
    :param pooled: whether instances of all candidates of a target action come from one pool, and not those of one candidate
    """

    def __init__(
        self,
        candidates: Candidates,
        task: TargetTask,
        *,
        breadth: float,
        transfer_terminals: bool,
        by_relevance: bool,
        times_weight: bool = False,
        pooled: bool = False,
    ):
        largest = int(candidates.instances.size.max())
        self._max_instances = min(list_room(task.min_fraction), MAX_TRANSFERRED)
        self._n_blocks = max(1, (largest + BLOCK - 1) // BLOCK)
        self._n_variables = task.n_variables
        self._set_arrays(
            TranslationArrays(
                source=SourceArrays.of_instances(candidates.instances),
                mappings=CandidateMappings(candidates.arrays.row, candidates.arrays.action, *candidates.table),
                rules=TranslationRules(
                    threshold=float(task.exploration_threshold),
                    breadth=float(breadth),
                    min_weight=float(task.min_weight),
                    min_fraction=float(task.min_fraction),
                    transfer_terminals=transfer_terminals,
                    by_relevance=by_relevance,
                    times_weight=times_weight,
                ),
                relevance=np.ones((len(candidates), largest)) if by_relevance else np.empty((1, 0)),
                order=np.empty(len(candidates) * largest if by_relevance and not times_weight else 0, dtype=np.int64),
                scratch=self._make_scratch(),
                periodic=np.array(task.periodic),
            )
        )
        self._make_room(task.n_actions)
        self._pools = candidates.arrays.first if pooled else np.arange(len(candidates) + 1)
        self.order_by_relevance()

    # Plain tuples for compiled code are made once, not at every step (see ``common.compiled``).

    def _set_arrays(self, arrays: TranslationArrays) -> None:
        self._arrays, self._plain_arrays = arrays, arrays.plain()

    def _make_scratch(self) -> TranslationScratch:
        return TranslationScratch.empty(self._max_instances, self._n_variables, self._n_blocks)

    def _make_room(self, n: int) -> None:
        """Make room for the instances of ``n`` states."""
        self._room = n
        self._transferred = TransferredInstances.empty(n, self._n_variables, self._max_instances)
        self._plain_transferred = tuple(self._transferred)

    @property
    def rules(self) -> TranslationRules:
        """When and how instances are translated."""
        return self._arrays.rules

    @property
    def relevance(self) -> np.ndarray:
        """Relevance of each candidate's instances, shape (n_candidates, most instances of an action); (1, 0) if not used."""
        return self._arrays.relevance

    def order_by_relevance(self) -> None:
        """Take in that :attr:`relevance` has changed. Of those that are equally relevant the first comes first."""
        if len(self._arrays.order):
            sizes = self._arrays.source.size[self._arrays.mappings.action]
            self._arrays.order[:] = most_relevant_first(self.relevance, sizes, self._pools)

    def set_breadth(self, breadth: float) -> None:
        """Translate with another kernel breadth from now on."""
        self._set_arrays(self._arrays._replace(rules=self.rules._replace(breadth=breadth)))

    def __call__(self, states: np.ndarray, own_weight: np.ndarray, ranges: Ranges) -> TransferredInstances:
        """
        Translate instances for states and actions (see ``Transfer.transferred``).

        :param states: unit coordinates, shape (n, n_variables)
        :param own_weight: shape (n,)
        :param ranges: (first candidate whose instances may be used, one past the last), int64, shape (n,) each
        :return: instances, in arrays that the next call uses again
        """
        if len(own_weight) > self._room:
            self._make_room(2 * len(own_weight))
        _translate.call(states, own_weight, ranges, self._plain_arrays, self._plain_transferred)
        # The most relevant instances may be far and light: cut off, they would not reach the threshold together.
        while self.rules.by_relevance and self._arrays.scratch.full[0]:
            self._max_instances *= 2
            self._set_arrays(self._arrays._replace(scratch=self._make_scratch()))
            self._make_room(self._room)
            _translate.call(states, own_weight, ranges, self._plain_arrays, self._plain_transferred)
        return self._transferred
