"""Kernel averages and what they are compared with: grids, kernels, transitions, and the definition in plain loops."""

import numpy as np

from helpers.naive_fitted_rmax import Instance, NaiveFittedRMax
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.mdp import FiniteMDP

N_ACTIONS = 2

# (resolution by variable, margin), which variables are periodic where some are, and grid lines where they are not even: a few
# hundred points at most, as the naive loops are slow.
PERIODIC_GRIDS = [
    *[((3,), 1, (True,)), ((2, 2), 1, (True, False)), ((2, 3), 0, (False, True)), ((1, 2, 1), 1, (True, False, True))],
]
UNEVEN_GRIDS = [
    ((2,), 0, None, [[0.0, 0.05, 0.5, 0.8, 1.0]]),
    ((2, 1), 0, (False, True), [[0.0, 0.3, 0.5, 0.52, 1.0], [0.0, 0.8, 1.0]]),
    ((1, 2, 1), 0, (False, True, False), [[0.0, 0.5, 1.0], [0.0, 0.1, 0.5, 0.55, 1.0], [0.0, 0.3, 1.0]]),
]
GRIDS = [
    ((3,), 1),
    ((4,), 0),
    ((2, 2), 1),
    ((3, 2), 0),
    ((2, 1), 1),
    ((1, 2, 1), 0),
    ((1, 1, 1), 1),
    *PERIODIC_GRIDS,
    *UNEVEN_GRIDS,
]


def make_grid(grid):
    """The package's grid of an entry of GRIDS."""
    resolution, margin, periodic, uneven = *grid, *(None,) * (4 - len(grid))
    even = StateGrid(len(resolution), resolution, margin, periodic)
    if uneven is None:
        return even
    lines = even.even_lines
    for k, of_variable in enumerate(uneven):
        lines[k, : len(of_variable)] = of_variable
    return even.with_lines(lines)


KERNELS = [
    *[dict(breadth=0.3, min_weight=0.01, min_fraction=0.13), dict(breadth=0.15, min_weight=0.01, min_fraction=0.02)],
    *[dict(breadth=0.5, min_weight=0.1, min_fraction=0.37), dict(breadth=0.8, min_weight=0.3, min_fraction=0.9)],
]


def random_transitions(seed, n_variables, n):
    """States that repeat now and then, effects that leave the box now and then, some of them zero."""
    rng, transitions = np.random.default_rng(seed), []
    for _ in range(n):
        state = rng.random(n_variables)
        if transitions and rng.random() < 0.15:
            state = transitions[rng.integers(len(transitions))][0]
        effect = rng.normal(0.0, 0.2, n_variables) * (rng.random(n_variables) < 0.8)
        transitions.append(
            (state, int(rng.integers(N_ACTIONS)), float(rng.normal()), state + effect, bool(rng.random() < 0.15))
        )
    return transitions


def make_model(grid, kernel, gamma=1.0, max_instances=None, transfer=None, model_class=KernelAverage, threshold=1.0):
    """A model on a finite MDP of its own, ``model.mdp``.

    :param grid: an entry of GRIDS, or another such
    """
    arguments = dict(min_fraction=kernel["min_fraction"], exploration_threshold=threshold, max_instances=max_instances)
    settings = ModelSettings(model_breadth=kernel["breadth"], min_weight=kernel["min_weight"], **arguments)
    return model_class(FiniteMDP(make_grid(grid), N_ACTIONS, gamma), settings, transfer)


def model_and_definition(grid, kernel, gamma=1.0, max_instances=None):
    model = make_model(grid, kernel, gamma, max_instances)
    more = dict(zip(("periodic", "lines"), grid[2:], strict=False))
    return model, NaiveFittedRMax(*grid[:2], N_ACTIONS, kernel, gamma=gamma, **more)


def learn(model, transitions):
    """Add transitions to a model, and update the rows that they change."""
    for transition in transitions:
        pairs = model.add(*transition)
        if len(pairs):
            model.update_rows(pairs)


def learn_both(model, naive, transitions):
    for transition in transitions:
        learn(model, [transition])
        naive.add(*transition)


def add_instances(naive, transitions):
    """Add transitions to the definition without the slow look at which pairs become known."""
    for state, action, reward, next_state, terminated in transitions:
        naive.instances[action].append(Instance(state, action, reward, next_state, terminated, naive.grid.periodic))


def pairs_of(naive):
    """Action, point and number of all pairs."""
    for action in range(naive.n_actions):
        for point in range(naive.n_points):
            yield action, point, action * naive.n_points + point


def row_of(mdp, point, action=0):
    """{successor: discounted probability} of a pair's row in the finite MDP."""
    arrays = mdp.arrays
    to, probability = (array[point, action, : arrays.length[point, action]] for array in (arrays.to, arrays.weight))
    assert len(set(to.tolist())) == len(to), "a successor has one entry"
    return dict(zip(to.tolist(), probability.tolist(), strict=True))


def without_staying(reward, successors, point, gamma):
    """The row of a pair whose staying at ``point`` is summed as a geometric series, from a plain one.

    :param successors: {successor: probability}, staying included
    :return: reward and {successor: discounted probability}
    """
    leave = 1.0 - gamma * successors.get(point, 0.0)
    if leave < 1e-9:
        return (0.0 if reward == 0.0 else float(np.sign(reward) * np.inf)), {}
    return reward / leave, {to: gamma * p / leave for to, p in successors.items() if to != point}


def assert_same_row(found, expected):
    for successor in found.keys() | expected.keys():
        assert abs(found.get(successor, 0.0) - expected.get(successor, 0.0)) <= 1e-9
