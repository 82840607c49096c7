"""The finite MDP: rows written from predictions against rows in plain loops."""

import warnings

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, N_ACTIONS, assert_same_row, make_grid, row_of, without_staying
from helpers.naive_fitted_rmax import NaiveGrid
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning import grid as grid_module
from sb3_combrel.planning.grid import StateGrid, fitting_grid
from sb3_combrel.planning.mdp import FiniteMDP


def make_mdp(grid=((2,), 0), gamma=1.0):
    return FiniteMDP(make_grid(grid), N_ACTIONS, gamma), NaiveGrid(*grid)


def write(mdp, pairs, probability, effect, reward, modelled=True):
    """Write rows of predictions given as lists; effects of one variable may be plain numbers."""
    pairs, probability = np.asarray(pairs, dtype=np.int64), np.asarray(probability, dtype=np.float64)
    effect = np.asarray(effect, dtype=np.float64).reshape(*probability.shape, mdp.grid.n_variables)
    modelled = np.broadcast_to(modelled, len(pairs)).copy()
    mdp.write_rows(pairs, modelled, probability, effect, np.asarray(reward, dtype=np.float64))


def naive_row(grid, point, probability, effect):
    """{successor: probability} of a prediction at a grid point."""
    successors = {}
    for p, moved in zip(probability, effect, strict=True):
        if p > 0.0:
            for to, fraction in grid.corners(grid.unit(point) + moved).items():
                successors[to] = successors.get(to, 0.0) + p * fraction
    return successors


def random_predictions(rng, n, n_successors, n_variables):
    """Some of them end the episode with some probability, some stay, some leave the grid."""
    probability = rng.random((n, n_successors)) * (rng.random((n, n_successors)) < 0.8)
    probability *= (rng.random((n, 1)) < 0.7) * rng.random((n, 1)) + (rng.random((n, 1)) < 0.5)
    probability /= np.maximum(1.0, probability.sum(axis=1, keepdims=True))
    moves = rng.random((n, n_successors, n_variables)) < 0.6
    return probability, rng.normal(0.0, 0.4, moves.shape) * moves, rng.normal(size=n)


@settings(deadline=None, derandomize=True, max_examples=12)
@given(st.sampled_from(GRIDS), st.integers(0, 10**6), st.integers(1, 5), st.sampled_from([1.0, 0.9]))
def test_written_rows_are_those_of_plain_loops(grid, seed, n_successors, gamma):
    rng = np.random.default_rng(seed)
    mdp, naive = make_mdp(grid, gamma)
    n_points, expected = mdp.grid.n_points, {}
    for _ in range(3):  # a later row replaces an earlier one
        pairs = rng.choice(N_ACTIONS * n_points, min(40, n_points), replace=False)
        probability, effect, reward = random_predictions(rng, len(pairs), n_successors, len(grid[0]))
        modelled = rng.random(len(pairs)) < 0.8
        write(mdp, pairs, probability, effect, reward, modelled)
        for row, pair in enumerate(pairs.tolist()):
            expected[pair] = (probability[row], effect[row], reward[row]) if modelled[row] else None
    for pair in range(N_ACTIONS * n_points):
        action, point = divmod(pair, n_points)
        found, prediction = row_of(mdp, point, action), expected.get(pair)
        assert mdp.arrays.modelled[pair] == (prediction is not None)
        if prediction is None:
            assert found == {} and mdp.arrays.reward[point, action] == 0.0
            continue
        successors = naive_row(naive, point, prediction[0], prediction[1])
        reward, others = without_staying(prediction[2], successors, point, gamma)
        assert mdp.arrays.reward[point, action] == pytest.approx(reward, rel=1e-9, abs=1e-9)
        assert_same_row(found, others)
    modelled = mdp.arrays.modelled.reshape(N_ACTIONS, -1)
    np.testing.assert_array_equal(mdp.arrays.n_optimistic, (~modelled).sum(axis=0))


def test_rows_become_wider_when_a_mean_has_more_successors_than_there_is_room_for():
    mdp, naive = make_mdp(((4, 4), 0))
    rng = np.random.default_rng(0)
    width = mdp.arrays.to.shape[-1]
    narrow, wide = random_predictions(rng, 3, 1, 2), random_predictions(rng, 3, 8, 2)
    write(mdp, [100, 0, 7], *narrow)
    assert mdp.arrays.to.shape[-1] == width == 4
    write(mdp, [40, 41, 42], *wide)
    assert mdp.arrays.to.shape[-1] > width
    for points, (probability, effect, _) in (([100, 0, 7], narrow), ([40, 41, 42], wide)):
        for row, point in enumerate(points):
            _, others = without_staying(0.0, naive_row(naive, point, probability[row], effect[row]), point, 1.0)
            assert_same_row(row_of(mdp, point), others)


def test_staying_is_summed_in_closed_form_and_probability_missing_to_one_ends_the_episode():
    mdp, _ = make_mdp(gamma=0.8)
    write(mdp, [2], [[0.6, 0.3]], [[0.0, 0.25]], [-1.0])
    leave = 1.0 - 0.8 * 0.6
    assert row_of(mdp, 2) == pytest.approx({3: 0.8 * 0.3 / leave})
    assert mdp.arrays.reward[2, 0] == pytest.approx(-1.0 / leave)
    write(mdp, [2], [[0.0, 0.0]], [[0.25, -0.25]], [-3.0])
    assert row_of(mdp, 2) == {} and mdp.arrays.reward[2, 0] == -3.0
    assert mdp.arrays.modelled[2], "a pair that always ends the episode has a model"


@pytest.mark.parametrize("resolution", [15, 16, 17])
def test_rows_lead_to_the_last_points_of_a_large_grid(resolution):
    """Points are numbered by as few bits as will do."""
    mdp, last = FiniteMDP(StateGrid(1, resolution), N_ACTIONS, 1.0), 2**resolution
    write(mdp, [last - 2], [[1.0]], [[[1.5 / 2**resolution]]], [0.0])
    to, weight = (array[last - 2, 0, : mdp.arrays.length[last - 2, 0]] for array in mdp.arrays[:2])
    assert dict(zip(to.tolist(), weight.tolist(), strict=True)) == pytest.approx({last - 1: 0.5, last: 0.5})


@pytest.mark.parametrize(("reward", "expected"), [(-1.0, -np.inf), (2.0, np.inf), (0.0, 0.0)])
def test_a_pair_that_never_leaves_has_an_infinite_reward_of_its_sign(reward, expected):
    mdp, _ = make_mdp()
    write(mdp, [2], [[0.5, 0.5]], [[0.0, 0.0]], [reward])
    assert row_of(mdp, 2) == {} and mdp.arrays.reward[2, 0] == expected
    write(mdp, [2], [[0.5, 0.5]], [[0.0, 0.25]], [reward])
    assert row_of(mdp, 2) == pytest.approx({3: 1.0}), "and an ordinary row once it leaves"
    assert mdp.arrays.reward[2, 0] == pytest.approx(2 * reward)


# The grid of states against plain loops: its points, interpolation between them, and its size.
FIVE_VARIABLES = [((1, 1, 1, 1, 1), 0), ((1, 2, 1, 1, 1), 0, (False, True, False, True, False))]


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.sampled_from([*GRIDS, *FIVE_VARIABLES]), st.integers(0, 10**6))
def test_interpolation_is_multilinear_or_by_simplices_between_grid_points_and_constant_beyond_them(grid, seed):
    rng = np.random.default_rng(seed)
    own, naive = make_grid(grid), NaiveGrid(*grid)
    values = rng.normal(size=own.n_points)
    assert own.n_points == np.prod(naive.shape)
    np.testing.assert_allclose([own.interpolate(values, state) for state in own.points()], values)
    for state in rng.uniform(-0.8, 1.8, (10, own.n_variables)):
        expected = sum(weight * values[point] for point, weight in naive.corners(state).items())
        assert own.interpolate(values, state) == pytest.approx(expected, abs=1e-12)


def test_interpolation_by_simplices_is_exact_for_linear_functions():
    grid, rng = make_grid(FIVE_VARIABLES[0]), np.random.default_rng(0)
    slopes = rng.normal(size=5)
    for state in rng.random((20, 5)):
        assert grid.interpolate(grid.points() @ slopes, state) == pytest.approx(state @ slopes, abs=1e-12)


@pytest.mark.parametrize("grid", [((2,), 0), ((2,), 1), ((2,), 0, (True,))])
@pytest.mark.parametrize("error", [-5e-10, -1e-16, 0.0, 1e-16, 5e-10])
def test_what_lies_on_a_grid_line_but_for_rounding_has_one_successor(grid, error):
    mdp, naive = make_mdp(grid)
    for point in range(mdp.grid.n_points):
        for moved in (-0.25, 0.25, 0.5, 1.0):
            write(mdp, [point], [[1.0]], [[moved + error / 4.0]], [-1.0])
            [(to, p)] = row_of(mdp, point).items() or [(point, 1.0)]
            [expected] = [to for to, p in naive.corners(naive.unit(point) + moved).items() if p > 1e-6]
            assert to == expected and p == 1.0


@pytest.mark.parametrize(("n_variables", "breadth"), [(1, 0.09), (2, 0.09), (2, 0.02), (3, 0.15), (4, 0.2)])
def test_a_default_grid_is_fine_enough_for_the_reach_of_the_kernel(n_variables, breadth):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grid = fitting_grid(n_variables, 2, None, breadth, 0.01)
    assert np.linalg.norm(0.5 ** np.array(grid.resolution)) <= breadth * np.sqrt(-np.log(0.01))
    assert grid.margin == (1 if n_variables <= 2 else 0)


def test_a_default_grid_has_a_million_pairs_at_most():
    with pytest.warns(UserWarning, match="coarse"):
        grid = fitting_grid(4, 5, None, 0.01, 0.01)
    assert 5 * grid.n_points <= 10**6 < 5 * (2 ** (grid.resolution[0] + 1) + 1) ** 4


@pytest.mark.parametrize("resolution", [9, [9, 2, 2, 9]])
def test_the_resolution_that_an_error_proposes_is_the_finest_that_is_accepted(resolution, monkeypatch):
    def of_grid(resolution):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return fitting_grid(4, 1, resolution, 0.5, 0.01)

    # A little less, and a little more, than a grid of resolution 3 is estimated at: 1,200 bytes a point with one action.
    for memory, proposed in ((2 * 1200 * 9**4 - 1, 2), (2 * 1200 * 9**4, 3)):
        monkeypatch.setattr(grid_module, "_memory", lambda memory=memory: float(memory))
        with pytest.raises(ValueError, match=rf"resolution={proposed} fits"):
            of_grid(resolution)
        of_grid(proposed)
        with pytest.raises(ValueError, match="GiB"):
            of_grid(proposed + 1)
    monkeypatch.setattr(grid_module, "_memory", lambda: 1000.0)
    with pytest.raises(ValueError, match="no resolution fits"):
        of_grid(1)


@pytest.mark.parametrize(
    ("resolution", "margin", "periodic"), [((2, 3), 0, None), ((2, 2), 1, (True, False)), ((3,), 0, (True,))]
)
def test_the_cells_around_states_have_the_corners_that_are_interpolated_between(resolution, margin, periodic):
    grid = StateGrid(len(resolution), resolution, margin, periodic)
    rng = np.random.default_rng(0)
    states = rng.uniform(-0.3, 1.3, (40, len(resolution)))
    for state, corners in zip(states, grid.cells_around(states), strict=True):
        for point in range(grid.n_points):
            values = np.zeros(grid.n_points)
            values[point] = 1.0
            assert point in corners or grid.interpolate(values, state) < 1e-8
