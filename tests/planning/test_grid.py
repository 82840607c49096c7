"""The grid of states against plain loops: its points, interpolation between them, and its size."""

import warnings

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, make_grid
from helpers.naive_fitted_rmax import NaiveGrid
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning.grid import StateGrid, fitting_grid


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.sampled_from(GRIDS), st.integers(0, 10**6))
def test_interpolation_is_multilinear_between_grid_points_and_constant_beyond_them(grid, seed):
    rng = np.random.default_rng(seed)
    own, naive = make_grid(grid), NaiveGrid(*grid)
    values = rng.normal(size=own.n_points)
    assert own.n_points == np.prod(naive.shape)
    np.testing.assert_allclose([own.interpolate(values, state) for state in own.points()], values)
    for state in rng.uniform(-0.8, 1.8, (10, own.n_variables)):
        expected = sum(weight * values[point] for point, weight in naive.corners(state).items())
        assert own.interpolate(values, state) == pytest.approx(expected, abs=1e-12)


def test_one_resolution_counts_for_all_variables():
    np.testing.assert_array_equal(StateGrid(3, 2).points(), StateGrid(3, (2, 2, 2)).points())


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
