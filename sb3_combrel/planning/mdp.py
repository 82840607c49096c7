"""The finite MDP over the grid points: reward and successors of each state-action pair that has a model.

A model writes it pair by pair, the planner reads it. State-action pair ``action * n_points + point`` is action ``action`` at
grid point ``point``. A pair without a model is optimistic: its value is the planner's upper bound, and it has no successors.
"""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.compiled import compiled, entry_point, inlined
from sb3_combrel.planning.grid import StateGrid, cells_away, coordinates_of, corners_of, n_corners

NEVER_LEAVES = 1e-9


class MDPArrays(NamedTuple):
    """The finite MDP for compiled code: rows of fixed width, those of a grid point beside each other, as sweeps read them."""

    # (n_points, n_actions, width): the *other* grid points that a pair leads to; uint16 where that will do, as sweeps wait
    # for memory, else int32.
    to: np.ndarray
    weight: np.ndarray  # float64, the same: with which discounted probability (see finish_row)
    length: np.ndarray  # int32, (n_points, n_actions): how many they are
    reward: np.ndarray  # float64, (n_points, n_actions): reward of the pair until its state is left
    modelled: np.ndarray  # bool, (n_pairs,): the pair has a model
    n_optimistic: np.ndarray  # int64, (n_points,): actions of a grid point that have none
    span: np.ndarray  # int64, (n_variables,): how many grid points away, at most, a pair has led along each variable
    changed: np.ndarray  # bool, (n_points,): a row of the point has changed; the planner takes it back


class RowScratch(NamedTuple):
    """Work space for the row of one pair."""

    at: np.ndarray  # int64, (n_variables,): grid coordinates of the pair's point
    position: np.ndarray  # float64, (n_variables,): grid coordinates of a successor
    corner_index: np.ndarray  # int64, (2 ** n_variables,)
    corner_weight: np.ndarray  # float64, (2 ** n_variables,)
    dense: np.ndarray  # float64, (n_points,), all 0 between calls: probability of each successor
    touched: np.ndarray  # int64, (n_points,): successors with a probability above 0
    span: np.ndarray  # ``MDPArrays.span``


class FiniteMDP:
    """The finite MDP, all of whose pairs are optimistic at first.

    :param grid: the finite sample of states
    :param n_actions: number of actions
    :param gamma: discount factor
    :param width: room for successors in each row; None: for one, between the corners of a cell
    """

    def __init__(self, grid: StateGrid, n_actions: int, gamma: float, width: int | None = None):
        d, n_points, n_pairs = grid.n_variables, grid.n_points, grid.n_points * n_actions
        width = n_corners(d) if width is None else width
        self.grid = grid
        self.n_actions = n_actions
        self.gamma = float(gamma)
        #: The MDP for compiled code, which takes it as a plain tuple where it is called often (see ``common.compiled``).
        self.arrays = MDPArrays(
            to=np.zeros((n_points, n_actions, width), dtype=np.uint16 if n_points <= 2**16 else np.int32),
            weight=np.zeros((n_points, n_actions, width)),
            length=np.zeros((n_points, n_actions), dtype=np.int32),
            reward=np.zeros((n_points, n_actions)),
            modelled=np.zeros(n_pairs, dtype=np.bool_),
            n_optimistic=np.full(n_points, n_actions, dtype=np.int64),
            span=np.zeros(d, dtype=np.int64),
            changed=np.ones(n_points, dtype=np.bool_),
        )
        self.scratch = RowScratch(
            at=np.empty(d, dtype=np.int64),
            position=np.empty(d),
            corner_index=np.empty(2**d, dtype=np.int64),
            corner_weight=np.empty(2**d),
            dense=np.zeros(n_points),
            touched=np.empty(n_points, dtype=np.int64),
            span=self.arrays.span,
        )

    def make_room(self) -> None:
        """Make rows twice as wide: a mean of many successors needs more room than one successor."""
        to, weight = (np.concatenate([array, np.zeros_like(array)], axis=2) for array in self.arrays[:2])
        self.arrays = self.arrays._replace(to=to, weight=weight)

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
            done = write_rows.call(
                self.arrays, self.grid.arrays, self.gamma, (pairs, modelled, probability, effect, reward), done, self.scratch
            )
            if done < len(pairs):
                self.make_room()


@compiled
def add_successor(p, effect, scratch, grid, n_touched):
    """Add a move by ``effect`` from the grid point at ``scratch.at``, of probability ``p``, to ``scratch.dense``.

    :param n_touched: how many of ``scratch.touched`` are filled; how many are now is returned
    """
    for k in range(len(grid.shape)):
        away = cells_away(scratch.at[k], effect[k], k, grid)
        scratch.position[k] = scratch.at[k] + away
        scratch.span[k] = max(scratch.span[k], int(np.ceil(min(abs(away), float(grid.shape[k])))))
    for c in range(corners_of(scratch.position, grid, scratch.corner_index, scratch.corner_weight)):
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


@compiled
def finish_row(mdp, gamma, pair, point, reward, n_touched, scratch):
    """Turn the successors in ``scratch.dense`` into the row of a pair; False if there is no room, and nothing is written.

    Staying is summed as the geometric series it is: reward and probabilities are divided by 1 - gamma * P(stay), which leaves
    the fixed point as it was and saves most sweeps. A pair that never leaves gets an infinite reward of the reward's sign.
    """
    leave = 1.0 - gamma * scratch.dense[point]
    never_leaves = leave < NEVER_LEAVES
    discount = 0.0 if never_leaves else gamma / leave
    action = pair // len(mdp.n_optimistic)
    length, width = 0, mdp.to.shape[2]
    room = n_touched <= width
    for t in range(n_touched):
        to = scratch.touched[t]
        if room and to != point and discount > 0.0:
            mdp.to[point, action, length] = to
            mdp.weight[point, action, length] = scratch.dense[to] * discount
            length += 1
        scratch.dense[to] = 0.0
    if room:
        mdp.length[point, action] = length
        mdp.reward[point, action] = infinite_reward(reward) if never_leaves else reward / leave
        mdp.changed[point] = True
    return room


@inlined
def set_modelled(mdp, pair, modelled):
    """Note whether a pair has a model; one that has lost it becomes optimistic."""
    if modelled != mdp.modelled[pair]:
        point, action = pair % len(mdp.n_optimistic), pair // len(mdp.n_optimistic)
        if not modelled:
            mdp.length[point, action] = 0
            mdp.reward[point, action] = 0.0
        mdp.modelled[pair] = modelled
        mdp.changed[point] = True
        mdp.n_optimistic[point] += -1 if modelled else 1


@entry_point
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
