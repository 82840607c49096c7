"""The finite MDP over the grid points: reward and successors of each state-action pair that has a model.

A model writes it pair by pair, the planner reads it. State-action pair ``action * n_points + point`` is action ``action`` at
grid point ``point``. A pair without a model is optimistic: its value is the planner's upper bound, and it has no successors.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import EntryPoint, compiled, inlined, inner, part
from sb3_combrel.common.list_store import ListStore, reserve
from sb3_combrel.planning.grid import StateGrid, corners_of

NEVER_LEAVES = 1e-9


class MDPArrays(NamedTuple):
    """The finite MDP for compiled code."""

    # Successors of each pair: the *other* grid points that it leads to, with discounted probabilities (see finish_row).
    rows: ListStore
    # For each grid point those whose rows have led to it, with a bound on that probability.
    predecessors: ListStore
    reward: np.ndarray  # float64, (n_pairs,): reward of the pair until its state is left
    modelled: np.ndarray  # bool, (n_pairs,): the pair has a model
    n_optimistic: np.ndarray  # int64, (n_points,): actions of a grid point that have none

    def plain(self) -> tuple[Any, ...]:
        """The same as plain tuples (see ``common.compiled``)."""
        return tuple(self.rows), tuple(self.predecessors), self.reward, self.modelled, self.n_optimistic


@inlined
def as_mdp(plain):
    """:class:`MDPArrays` from plain tuples."""
    return MDPArrays(ListStore(*plain[0]), ListStore(*plain[1]), plain[2], plain[3], plain[4])


class RowScratch(NamedTuple):
    """Work space for the row of one pair."""

    at: np.ndarray  # int64, (n_variables,): grid coordinates of the pair's point
    position: np.ndarray  # float64, (n_variables,): grid coordinates of a successor
    corner_index: np.ndarray  # int64, (2 ** n_variables,)
    corner_weight: np.ndarray  # float64, (2 ** n_variables,)
    dense: np.ndarray  # float64, (n_points,), all 0 between calls: probability of each successor
    touched: np.ndarray  # int64, (2 * n_points,): successors with a probability above 0
    before: np.ndarray  # float64, (n_points,), all 0 between calls: the pair's last row


class FiniteMDP:
    """The finite MDP, all of whose pairs are optimistic at first.

    :param grid: the finite sample of states
    :param n_actions: number of actions
    :param gamma: discount factor
    """

    def __init__(self, grid: StateGrid, n_actions: int, gamma: float):
        d, n_points, n_pairs = grid.n_variables, grid.n_points, grid.n_points * n_actions
        self.grid = grid
        self.n_actions = n_actions
        self.gamma = float(gamma)
        #: The MDP for compiled code; ``plain``: the same as plain tuples (see ``common.compiled``).
        self.arrays = MDPArrays(
            rows=ListStore.empty(n_pairs, 1 << 14),
            predecessors=ListStore.empty(n_points, 1 << 14),
            reward=np.zeros(n_pairs),
            modelled=np.zeros(n_pairs, dtype=np.bool_),
            n_optimistic=np.full(n_points, n_actions, dtype=np.int64),
        )
        self.plain = self.arrays.plain()
        self.scratch = RowScratch(
            at=np.empty(d, dtype=np.int64),
            position=np.empty(d),
            corner_index=np.empty(2**d, dtype=np.int64),
            corner_weight=np.empty(2**d),
            dense=np.zeros(n_points),
            touched=np.empty(2 * n_points, dtype=np.int64),
            before=np.zeros(n_points),
        )
        self.plain_scratch = tuple(self.scratch)

    def make_room(self) -> None:
        """Grow what was too small for what was last asked of it."""
        arrays = self.arrays
        self.arrays = arrays._replace(rows=arrays.rows.with_room(), predecessors=arrays.predecessors.with_room())
        self.plain = self.arrays.plain()

    def write_rows(
        self, pairs: np.ndarray, modelled: np.ndarray, probability: np.ndarray, effect: np.ndarray, reward: np.ndarray
    ) -> None:
        """Write the rows of pairs, int64, shape (n,), from predictions.

        :param modelled: bool, shape (n,): whether each has a model; the others become optimistic
        :param probability: shape (n, n_successors); what is missing to 1 ends the episode
        :param effect: shape (n, n_successors, n_variables): displacements, unit coordinates
        :param reward: shape (n,)
        """
        done = 0
        while done < len(pairs):
            done = _write_rows.call(
                self.arrays, self.grid.arrays, self.gamma, (pairs, modelled, probability, effect, reward), done, self.scratch
            )
            if done < len(pairs):
                self.make_room()

    def renew_predecessors(self) -> None:
        """Forget predecessors that no row needs any more."""
        while not _renew_predecessors.call(self.arrays):
            self.make_room()


@inlined
def next_power(weight):
    """The least power of two that is not below ``weight``."""
    return 2.0 ** np.ceil(np.log2(weight))


@inner
def note_predecessor(predecessors, to, point, weight):
    """Enter ``point`` among those that lead ``to`` a point with a probability of ``weight``; False if there is no room.

    The next power of two is noted, so that a little more of the same changes nothing.
    """
    weight = next_power(weight)
    start = predecessors.start[to]
    length = predecessors.length[to]
    for k in range(start, start + length):
        if predecessors.item[k] == point:
            predecessors.weight[k] = max(predecessors.weight[k], weight)
            return True
    if not reserve(predecessors, to, length + 1):
        return False
    end = predecessors.start[to] + length
    predecessors.item[end] = point
    predecessors.weight[end] = weight
    predecessors.length[to] = length + 1
    return True


@inlined
def coordinates_of(point, grid, at):
    """Write the whole-numbered grid coordinates of a point to ``at``."""
    rest = point
    for k in range(len(grid.shape)):
        at[k] = rest // grid.strides[k]
        rest -= at[k] * grid.strides[k]


@inner
def add_successor(p, effect, scratch, grid, n_touched):
    """Add a move by ``effect`` from the grid point at ``scratch.at``, of probability ``p``, to ``scratch.dense``.

    :param n_touched: how many of ``scratch.touched`` are filled; how many are now is returned
    """
    for k in range(len(effect)):
        scratch.position[k] = scratch.at[k] + effect[k] * grid.cells[k]
    n_corners = corners_of(scratch.position, grid, scratch.corner_index, scratch.corner_weight)
    for c in range(n_corners):
        point = scratch.corner_index[c]
        if scratch.dense[point] == 0.0:
            scratch.touched[n_touched] = point
            n_touched += 1
        scratch.dense[point] += p * scratch.corner_weight[c]
    return n_touched


@inlined
def infinite_reward(reward):
    """What staying for ever with a reward each step is worth; values are cut to their bounds."""
    return 0.0 if reward == 0.0 else np.inf * reward


@part
def finish_row(mdp, gamma, pair, point, reward, n_touched, scratch):
    """Turn the successors in ``scratch.dense`` into the row of a pair; False if there is no room, and nothing is written.

    Staying is summed as the geometric series it is: reward and probabilities are divided by 1 - gamma * P(stay), which leaves
    the fixed point as it was and saves most sweeps. A pair that never leaves gets an infinite reward of the reward's sign.
    """
    if not reserve(mdp.rows, pair, n_touched):
        for t in range(n_touched):
            scratch.dense[scratch.touched[t]] = 0.0
        return False
    leave = 1.0 - gamma * scratch.dense[point]
    never_leaves = leave < NEVER_LEAVES
    discount = 0.0 if never_leaves else gamma / leave
    if not store_row(mdp, pair, point, n_touched, discount, scratch):
        return False
    mdp.reward[pair] = infinite_reward(reward) if never_leaves else reward / leave
    return True


@part
def store_row(mdp, pair, point, n_touched, discount, scratch):
    """Write the probabilities in ``scratch.dense``, discounted, to a pair's row, and note its point as a predecessor.

    False, and the row is empty, if there is no room; it is empty if ``discount`` is 0, too.
    """
    slot = mdp.rows.start[pair]
    n_old = mdp.rows.length[pair]
    for k in range(n_old):
        to = mdp.rows.item[slot + k]
        scratch.before[to] = mdp.rows.weight[slot + k]
        scratch.touched[n_touched + k] = to
    length = 0
    room = True
    for t in range(n_touched):
        to = scratch.touched[t]
        if to != point and discount > 0.0:
            weight = scratch.dense[to] * discount
            before = scratch.before[to]
            if weight > before and (before == 0.0 or weight > next_power(before)):
                room = room and note_predecessor(mdp.predecessors, to, point, weight)
            mdp.rows.item[slot + length] = to
            mdp.rows.weight[slot + length] = weight
            length += 1
        scratch.dense[to] = 0.0
    for t in range(n_touched, n_touched + n_old):
        scratch.before[scratch.touched[t]] = 0.0
    mdp.rows.length[pair] = length if room else 0
    return room


@inlined
def set_modelled(mdp, pair, modelled):
    """Note whether a pair has a model; one that has lost it becomes optimistic."""
    if modelled != mdp.modelled[pair]:
        if not modelled:
            mdp.rows.length[pair] = 0
            mdp.reward[pair] = 0.0
        mdp.modelled[pair] = modelled
        mdp.n_optimistic[pair % len(mdp.n_optimistic)] += -1 if modelled else 1


@compiled
def write_rows(mdp, grid, gamma, predictions, done, scratch):
    """Write rows from predictions, from number ``done`` on; how many are done, fewer than all if there is no room."""
    pairs, modelled, probability, effect, expected_reward = predictions
    n_points = len(mdp.n_optimistic)
    while done < len(pairs):
        pair = pairs[done]
        if modelled[done]:
            point = pair % n_points
            coordinates_of(point, grid, scratch.at)
            n_touched = np.int64(0)
            for k in range(probability.shape[1]):
                if probability[done, k] > 0.0:
                    n_touched = add_successor(probability[done, k], effect[done, k], scratch, grid, n_touched)
            if not finish_row(mdp, gamma, pair, point, expected_reward[done], n_touched, scratch):
                return done
        set_modelled(mdp, pair, modelled[done])
        done += 1
    return done


@compiled
def renew_predecessors(mdp):
    """Note the predecessors that the rows need; False if there is no room for them."""
    mdp.predecessors.length[:] = np.int32(0)
    n_points = len(mdp.n_optimistic)
    for pair in range(len(mdp.reward)):
        if mdp.modelled[pair]:
            start = mdp.rows.start[pair]
            for k in range(start, start + mdp.rows.length[pair]):
                to = np.int64(mdp.rows.item[k])
                if not note_predecessor(mdp.predecessors, to, pair % n_points, mdp.rows.weight[k]):
                    return False
    return True


_write_rows, _renew_predecessors = EntryPoint(write_rows), EntryPoint(renew_predecessors)
