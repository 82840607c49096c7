"""The translator: source instances become instances of the target, as many as a state-action pair lacks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import entry_point, inlined
from sb3_combrel.common.instances import BLOCK, Instances
from sb3_combrel.common.kernels import list_room
from sb3_combrel.common.periodic import difference
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.candidates import CandidateArrays, Candidates, MappingTable
from sb3_combrel.transfer.instances.selectors import Ranges

# Instances of a state and action by distance, at most; by relevance room is made for as many as it takes.
MAX_TRANSFERRED = 32

# Columns of the scratch arrays of the selected instances.
_INSTANCE, _CANDIDATE = 0, 1
_RANK, _WEIGHT = 0, 1


class TranslationRules(NamedTuple):
    """When and how instances are translated: see ``equations.TransferRules`` for the first four."""

    threshold: float
    breadth: float
    min_weight: float
    min_fraction: float
    transfer_terminals: bool  # whether an instance that ended a source episode ends the target's
    by_relevance: bool  # whether instances come in the order of their relevance, not of their distance
    times_weight: bool  # of their relevance times their weight


class TranslationScratch(NamedTuple):
    """Work space: the instances selected at one state, best first, with room for one more than are ever needed."""

    number: np.ndarray  # int64, shape (room, 2): instance and candidate
    value: np.ndarray  # float64, shape (room, 2): what it is ranked by, and its weight
    variable: np.ndarray  # int64, shape (n_variables,): source variables that a candidate compares with
    at: np.ndarray  # float64, same shape: where the state lies along each
    periodic: np.ndarray  # bool, same shape: whether it wraps there
    full: np.ndarray  # bool, shape (1,): an instance that was needed did not fit
    enters: np.ndarray  # float64, shape (1,): an instance of no higher rank than this is not needed


class TranslationArrays(NamedTuple):
    """All that the translator's loops read, and their work space."""

    source: Instances
    candidates: CandidateArrays
    mappings: MappingTable
    rules: TranslationRules
    relevance: np.ndarray  # float64, shape (n_candidates, most instances of an action); or (1, 0) if not used
    scratch: TranslationScratch
    periodic: np.ndarray  # bool, shape (n_target_variables,): the target's variables that wrap


@inlined
def insert_selected(j, candidate, weight, rank, own, kept, rules, scratch):
    """Add an instance to the list of the ``kept`` selected, the highest rank first, and cut what is not needed any more.

    An instance is needed while those before it and ``own`` do not reach the threshold, and while it has at least
    ``min_fraction`` of their weight. These sums only grow, so what is cut once would be cut for ever.

    :return: how many are kept now; ``scratch.enters`` receives the least rank with which a further one could enter
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
        if not rules.by_relevance and value[k, _WEIGHT] < rules.min_fraction * total:
            # Heavier than the last of the list, one need not have that fraction of the last's weight as well.
            least = rules.min_fraction * total
            scratch.enters[0] = min(least, value[k - 1, _WEIGHT]) if k > 0 else least
            return k
        total += value[k, _WEIGHT]
        if total >= rules.threshold:
            scratch.enters[0] = value[k, _RANK]
            return k + 1
    if kept + 1 > room:
        scratch.full[0] = True
    if not rules.by_relevance:
        scratch.enters[0] = value[room - 1, _WEIGHT] if kept + 1 >= room else 0.0
    return min(kept + 1, room)


@inlined
def add_near_instances(state, own, candidate, arrays, kept):
    """Add a candidate's instances that weigh at least ``min_weight`` at ``state`` to the ``kept`` selected; how many now."""
    source, rules, scratch = arrays.source, arrays.rules, arrays.scratch
    row = arrays.candidates.row[candidate]
    action = arrays.candidates.action[candidate]
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
    nearest_block = measure_mapped_gaps(source, action, n_mapped, scratch)
    nearest = far
    # The instances in the nearest block exclude most other blocks. By relevance alone they do not: there, of equally relevant
    # ones the first comes first.
    by_relevance_alone = rules.by_relevance and not rules.times_weight
    first_turn = 0 if by_relevance_alone else -1
    for turn in range(first_turn, (size + BLOCK - 1) // BLOCK):
        block = nearest_block if turn < 0 else turn
        if source.gap[block] > nearest or (turn == nearest_block and first_turn < 0):
            continue
        for j in range(block * BLOCK, min(size, (block + 1) * BLOCK)):
            if rules.by_relevance and arrays.relevance[candidate, j] <= scratch.enters[0]:
                continue
            apart = 0.0
            for m in range(n_mapped):
                along = difference(scratch.at[m], source.state[action, j, scratch.variable[m]], scratch.periodic[m])
                apart += along * along
            if apart <= nearest:
                weight = np.exp(apart * scale)
                rank = 1.0 if by_relevance_alone else weight
                if rules.by_relevance:
                    rank *= arrays.relevance[candidate, j]
                kept = insert_selected(j, candidate, weight, rank, own, kept, rules, scratch)
                if scratch.enters[0] > rules.min_weight and not by_relevance_alone:
                    # No relevance exceeds 1: what is lighter than the least rank that is needed has a lower one.
                    nearest = np.log(scratch.enters[0]) / scale * (1 + 1e-12)
    return kept


@inlined
def measure_mapped_gaps(source, action, n_mapped, scratch):
    """Write to ``source.gap`` the squared distance of each block's box, in the mapped variables; return the nearest block."""
    low, high, gap = source.block_low[action], source.block_high[action], source.gap
    variable, at = scratch.variable, scratch.at
    nearest_block = 0
    for block in range((source.size[action] + BLOCK - 1) // BLOCK):
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


@inlined
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
        row = arrays.candidates.row[number[n, _CANDIDATE]]
        action = arrays.candidates.action[number[n, _CANDIDATE]]
        transferred.weight[s, n] = value[n, _WEIGHT]
        transferred.reward[s, n] = source.reward[action, j]
        transferred.terminated[s, n] = rules.transfer_terminals and source.terminated[action, j]
        for v in range(mappings.variable.shape[1]):
            k = mappings.variable[row, v]
            transferred.effect[s, n, v] = mappings.sign[row, v] * source.effect[action, j, k] if k >= 0 else 0.0


@entry_point
def translate(states, own, ranges, arrays, transferred):
    """Translate instances for n states and actions (see ``Transfer.transferred``).

    :param own: weight of the target's own instances there
    :param ranges: (first candidate whose instances may be used, one past the last: none if equal)
    :param arrays: TranslationArrays; plain tuples
    :param transferred: TransferredInstances as a plain tuple, receives the instances, at least n rows
    """
    source, candidates, mappings = Instances(*arrays[0]), CandidateArrays(*arrays[1]), MappingTable(*arrays[2])
    rules, scratch = TranslationRules(*arrays[3]), TranslationScratch(*arrays[5])
    arrays = TranslationArrays(source, candidates, mappings, rules, arrays[4], scratch, arrays[6])
    transferred = TransferredInstances(*transferred)
    first, last = ranges
    for s in range(len(own)):
        transferred.length[s] = 0
        if own[s] >= arrays.rules.threshold:
            continue
        kept = np.int64(0)
        arrays.scratch.enters[0] = -np.inf
        for candidate in range(first[s], last[s]):
            kept = add_near_instances(states[s], own[s], candidate, arrays, kept)
        write_row(s, own[s], kept, arrays, transferred)


class Translator:
    """Translates instances of selected candidates.

    :param breadth: kernel breadth of transferred instances, unit coordinates; the others: see ``TranslationRules``
    """

    def __init__(
        self, candidates: Candidates, *, breadth: float, transfer_terminals: bool, by_relevance: bool, times_weight: bool
    ):
        task, largest = candidates.task, int(candidates.instances.size.max())
        self._source = candidates.instances, candidates.arrays, candidates.table
        self._periodic = np.array(task.periodic)
        #: When and how instances are translated.
        self.rules = TranslationRules(
            threshold=float(task.exploration_threshold),
            breadth=float(breadth),
            min_weight=float(task.min_weight),
            min_fraction=float(task.min_fraction),
            transfer_terminals=transfer_terminals,
            by_relevance=by_relevance,
            times_weight=times_weight,
        )
        #: Relevance of each candidate's instances, which is written to from outside.
        self.relevance = np.ones((len(candidates), largest)) if by_relevance else np.empty((1, 0))
        self._make_room(task.n_actions, min(list_room(task.min_fraction), MAX_TRANSFERRED))

    def _make_room(self, n: int, max_instances: int) -> None:
        """Make room for so many instances of each of ``n`` states and actions."""
        n_variables = len(self._periodic)
        self._scratch = TranslationScratch(
            number=np.empty((max_instances + 1, 2), dtype=np.int64),
            value=np.empty((max_instances + 1, 2)),
            variable=np.empty(n_variables, dtype=np.int64),
            at=np.empty(n_variables),
            periodic=np.zeros(n_variables, dtype=np.bool_),
            full=np.zeros(1, dtype=np.bool_),
            enters=np.zeros(1),
        )
        self._transferred = TransferredInstances.empty(n, n_variables, max_instances)

    def set_breadth(self, breadth: float) -> None:
        """Translate with another kernel breadth from now on."""
        self.rules = self.rules._replace(breadth=breadth)

    def __call__(self, states: np.ndarray, own_weight: np.ndarray, ranges: Ranges) -> TransferredInstances:
        """Translate instances for states and actions, see :func:`translate`, in arrays that the next call uses again."""
        n, room = self._transferred.weight.shape
        if len(own_weight) > n:
            self._make_room(2 * len(own_weight), room)
        while True:
            structs = map(tuple, (*self._source, self.rules))
            arrays = *structs, self.relevance, tuple(self._scratch), self._periodic
            translate.call(states, own_weight, ranges, arrays, tuple(self._transferred))
            # The most relevant instances may be far and light: cut off, they would not reach the threshold together.
            if not (self.rules.by_relevance and self._scratch.full[0]):
                return self._transferred
            n, room = self._transferred.weight.shape
            self._make_room(n, 2 * room)
