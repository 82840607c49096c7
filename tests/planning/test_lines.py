"""Grid lines that are not evenly spread, and where they are moved to."""

import itertools

import numpy as np
import pytest
from helpers.kernel_models import UNEVEN_GRIDS, make_grid
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.lines import moved_lines

GRID = StateGrid(2, (3, 2), periodic=(False, True))


def errors_near(place, seed=0, n=4000, spread=0.02):
    """States all over the box, with errors near a place, unit coordinates."""
    states = np.random.default_rng(seed).random((n, 2))
    return states, np.exp(-(((states - place) / spread) ** 2).sum(axis=1)) + 1e-6


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.sampled_from(UNEVEN_GRIDS[:2]), st.integers(0, 10**6))
def test_values_between_uneven_lines_are_interpolated_as_scipy_does(grid, seed):
    own, rng = make_grid(grid), np.random.default_rng(seed)
    g, values = own.arrays, rng.normal(size=own.n_points)
    lines = [g.lines[k, : n + int(wraps)] for k, (n, wraps) in enumerate(zip(g.shape, g.periodic, strict=True))]
    table = values.reshape(g.shape)
    for k in np.flatnonzero(g.periodic):
        table = np.concatenate([table, np.take(table, [0], axis=k)], axis=k)
    theirs = RegularGridInterpolator(lines, table)
    for state in rng.uniform(-0.7, 1.7, (20, own.n_variables)):
        inside = np.where(g.periodic, state % 1.0, np.clip(state, 0.0, 1.0))
        assert own.interpolate(values, state) == pytest.approx(float(theirs(inside)[0]), abs=1e-9)


@pytest.mark.parametrize("grid", UNEVEN_GRIDS, ids=str)
def test_grid_coordinates_are_whole_numbers_at_the_points_and_go_on_beyond(grid):
    own = make_grid(grid)
    at = np.stack(np.unravel_index(np.arange(own.n_points), tuple(own.arrays.shape)), axis=-1)
    np.testing.assert_allclose(own.coordinates(own.points()), at, atol=1e-12)
    around = np.where(own.arrays.periodic, own.arrays.shape, 0)
    np.testing.assert_allclose(own.coordinates(own.points() + own.arrays.periodic), at + around, atol=1e-9)
    beyond = own.coordinates(np.array([[-0.1] * own.n_variables, [1.1] * own.n_variables]))
    assert (beyond[0] < 0.0).all() and (beyond[1] > own.arrays.shape - 1.0).all()


@pytest.mark.parametrize("grid", [((2, 3), 0), ((2, 2), 0, (True, False)), ((1, 2), 1), *UNEVEN_GRIDS], ids=str)
def test_a_finer_grid_has_the_lines_of_a_grid_and_others_in_the_middle_between_them(grid):
    own = make_grid(grid)
    finer = own.finer()
    assert finer.resolution == tuple(r + 1 for r in own.resolution) and finer.margin == own.margin
    assert finer.arrays.even == own.arrays.even
    np.testing.assert_array_equal(finer.arrays.periodic, own.arrays.periodic)
    for k, n in enumerate(2 ** np.array(own.resolution)):
        lines, before = (g.arrays.lines[k, g.margin * (not g.arrays.periodic[k]) :] for g in (finer, own))
        np.testing.assert_allclose(lines[: 2 * n + 1 : 2], before[: n + 1], atol=1e-15)
        np.testing.assert_allclose(lines[1 : 2 * n : 2], (before[:n] + before[1 : n + 1]) / 2.0, atol=1e-15)


def test_even_lines_make_an_even_grid_and_lines_that_a_damaged_file_says_do_not_count():
    uneven = make_grid(UNEVEN_GRIDS[1])
    assert not uneven.arrays.even and uneven.with_lines(uneven.even_lines).arrays.even
    assert uneven.with_lines(uneven.arrays.lines[:, ::-1]).arrays.even
    assert uneven.with_lines(np.zeros_like(uneven.arrays.lines)).arrays.even
    np.testing.assert_array_equal(uneven.with_lines(uneven.arrays.lines).points(), uneven.points())


def test_lines_gather_where_errors_are_and_stay_in_order_with_ends_and_middle():
    grid = GRID
    for _ in range(60):
        grid = grid.with_lines(moved_lines(grid, *errors_near((0.3, 0.6))))
    for k, (n_cells, place) in enumerate(((8, 0.3), (4, 0.6))):
        lines = grid.arrays.lines[k, : n_cells + 1]
        assert (np.diff(lines) > 0.0).all() and lines[0] == 0.0 and lines[-1] == 1.0 and lines[n_cells // 2] == 0.5
        half = lines[: n_cells // 2 + 1] if place < 0.5 else lines[n_cells // 2 :]
        assert np.diff(half).min() < 0.25 * np.diff(half).max()
        assert abs(half[:-1][np.diff(half).argmin()] - place) < 0.1


def errors_up_to(place, lines, states, errors):
    """The errors of the states below a place, where those of a cell are spread evenly over it, by a loop."""
    total = 0.0
    for low, high in itertools.pairwise(lines.tolist()):
        of_cell = sum(e for s, e in zip(states.tolist(), errors.tolist(), strict=True) if low <= s < high)
        total += of_cell * min(1.0, max(0.0, (place - low) / (high - low)))
    return total


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.05, 0.5))
def test_lines_go_half_of_the_way_to_where_all_cells_on_one_side_of_the_middle_have_the_same_errors(seed, spread):
    places = np.random.default_rng(seed).random(2)
    states, errors = errors_near(places, seed, n=300, spread=spread)
    grid = GRID.with_lines(moved_lines(GRID, *errors_near(1.0 - places, seed, n=300, spread=spread)))
    moved = moved_lines(grid, states, errors)
    for k, n_cells in enumerate((8, 4)):
        lines, half = grid.arrays.lines[k, : n_cells + 1], n_cells // 2
        aims = 2.0 * moved[k, : n_cells + 1] - lines
        shares = np.diff([errors_up_to(aim, lines, states[:, k], errors) for aim in aims])
        for side in (shares[:half], shares[half:]):
            np.testing.assert_allclose(side, side.mean(), rtol=1e-6)
        np.testing.assert_allclose(aims[[0, half, n_cells]], [0.0, 0.5, 1.0], atol=1e-15)


def test_where_values_between_lines_are_right_lines_stay():
    states, errors = errors_near((0.3, 0.6))
    left = states[:, 0] < 0.5
    moved = moved_lines(GRID, states[left], errors[left])
    np.testing.assert_array_equal(moved[0, 4:], GRID.arrays.lines[0, 4:])
    assert (moved[0, 1:4] != GRID.arrays.lines[0, 1:4]).all()


def test_errors_at_a_single_state_leave_no_cell_without_a_width():
    """They draw lines closer and closer together, until numbers end: then the grid is even again."""
    grid, narrowest = GRID, 1.0
    for _ in range(200):
        grid = grid.with_lines(moved_lines(grid, np.full((5, 2), 0.2501), np.ones(5)))
        width = np.diff(grid.arrays.lines, axis=1).min()
        assert width > 0.0
        narrowest = min(narrowest, width)
    assert narrowest < 1e-9
