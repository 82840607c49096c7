"""Lists that are filled again pair by pair are those that learning made instance by instance."""

import numpy as np
import pytest
from numba import njit
from test_kernel_average import GRIDS, KERNELS, N_ACTIONS, model_and_definition, random_transitions

from sb3_combrel.common.instances import BLOCK, InstanceArrays, put_instance
from sb3_combrel.models.refilling import in_neighbourhoods
from sb3_combrel.planning.corrections import CorrectionArrays, find_cell


def restored(model, grid, kernel, max_instances=None):
    """A model with the same instances, and what a file keeps of the rest."""
    fresh, _ = model_and_definition(grid, kernel, max_instances=max_instances)
    fresh.instances = model.instances
    listed = np.concatenate([model.arrays.members[a, :n] > 0 for a, n in enumerate(model.instances.count)])
    fresh.restore(listed, model.arrays.known, model.arrays.total)
    return fresh


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_restored_lists_and_rows_are_the_same_to_the_last_bit(grid, kernel):
    model, _ = model_and_definition(grid, kernel)
    for transition in random_transitions(3, len(grid[0]), 150):
        model.settle(model.add(*transition))
    fresh = restored(model, grid, kernel)
    assert model.arrays.lists.length.max() > 1
    for name in ("entry", "total", "known", "settled", "reward", "n_optimistic", "heard", "members"):
        np.testing.assert_array_equal(getattr(fresh.arrays, name), getattr(model.arrays, name), err_msg=name)
    for pair in range(len(model.arrays.total)):
        for pool in ("lists", "rows"):
            index, weight = getattr(fresh.arrays, pool).entries(pair)
            same_index, same_weight = getattr(model.arrays, pool).entries(pair)
            np.testing.assert_array_equal(index, same_index)
            np.testing.assert_array_equal(weight, same_weight)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_model_that_gave_up_instances_is_restored_to_what_it_is_without_them(kernel):
    grid = GRIDS[2]
    model, _ = model_and_definition(grid, kernel, max_instances=20)
    for transition in random_transitions(4, 2, 200):
        model.settle(model.add(*transition))
    fresh = restored(model, grid, kernel, max_instances=20)
    n_points = model.grid.n_points
    for pair in range(N_ACTIONS * n_points):
        action, at = pair // n_points, model.grid.points()[pair % n_points]
        apart = ((model.instances.state[action, :20] - at) ** 2).sum(axis=1)
        weights = np.where(model.arrays.members[action, :20] > 0, np.exp(-apart / kernel["breadth"] ** 2), 0.0)
        kept, total = [], 0.0
        for i in np.argsort(-weights, kind="stable"):
            if weights[i] < kernel["min_weight"] or weights[i] < kernel["min_fraction"] * total:
                break
            kept.append(i)
            total += weights[i]
        np.testing.assert_array_equal(fresh.arrays.lists.entries(pair)[0], kept)
        assert fresh.arrays.total[pair] == pytest.approx(total)
    assert fresh.arrays.known[model.arrays.known].mean() > 0.9, "known by history, unless nothing is left"


def test_totals_that_cannot_be_are_not_taken_over():
    grid, kernel = GRIDS[2], KERNELS[0]
    model, _ = model_and_definition(grid, kernel)
    for transition in random_transitions(5, 2, 60):
        model.settle(model.add(*transition))
    fresh, _ = model_and_definition(grid, kernel)
    fresh.instances = model.instances
    n = len(model.arrays.total)
    fresh.restore(np.ones(model.n_instances, dtype=bool), np.ones(n, dtype=bool), np.full(n, 1e9))
    np.testing.assert_allclose(fresh.arrays.total, model.arrays.total, rtol=1e-12)
    assert not fresh.arrays.known[fresh.arrays.lists.length == 0].any()


@pytest.mark.parametrize("d", [1, 2, 4, 5])
def test_the_order_along_the_curve_keeps_every_listed_instance_once(d):
    rng = np.random.default_rng(d)
    action = np.sort(rng.integers(3, size=200))
    columns = rng.random((200, d)), rng.normal(size=(200, d)), rng.normal(size=200), rng.random(200) < 0.5
    held = InstanceArrays.of_rows(3, action, *columns)
    listed = rng.random(200) < 0.6
    near, slots = in_neighbourhoods(held, listed)
    for a in range(3):
        places = slots[a, : near.count[a]]
        np.testing.assert_array_equal(np.sort(places), np.flatnonzero(listed[action == a]))
        np.testing.assert_array_equal(near.state[a, : near.count[a]], held.state[a, places])
        # Neighbours along the curve are nearer to each other than in the order in which they came.
        steps = [
            np.linalg.norm(np.diff(states, axis=0), axis=1).mean() for states in (near.state[a, : near.count[a]], columns[0])
        ]
        assert steps[0] < 0.8 * steps[1]


def test_instances_given_at_once_are_as_those_given_one_by_one():
    rng = np.random.default_rng(0)
    state, effect = rng.random((50, 2)), rng.normal(size=(50, 2))
    action, reward, terminated = rng.integers(N_ACTIONS, size=50), rng.normal(size=50), rng.random(50) < 0.5
    one_by_one = InstanceArrays.empty(N_ACTIONS, 2)
    for i in range(50):
        a = action[i]
        put_instance.py_func(one_by_one, a, one_by_one.count[a], state[i], state[i] + effect[i], reward[i], terminated[i])
    at_once = InstanceArrays.of_rows(N_ACTIONS, action, state, effect, reward, terminated)
    np.testing.assert_array_equal(at_once.count, one_by_one.count)
    for a, n in enumerate(one_by_one.count):
        for name in ("state", "reward", "terminated"):
            np.testing.assert_array_equal(getattr(at_once, name)[a, :n], getattr(one_by_one, name)[a, :n])
        np.testing.assert_allclose(at_once.effect[a, :n], one_by_one.effect[a, :n], atol=1e-15)
        n_blocks = -(-n // BLOCK)
        for name in ("block_low", "block_high"):
            np.testing.assert_array_equal(getattr(at_once, name)[a, :, :n_blocks], getattr(one_by_one, name)[a, :, :n_blocks])


def test_corrections_given_at_once_are_found_by_their_cells():
    rng = np.random.default_rng(0)
    key, value, state = rng.permutation(10_000)[:700], rng.normal(size=700), rng.random((700, 2))
    corrections = CorrectionArrays.of_rows(key, value, state)
    assert corrections.count[0] == 700
    find = njit(find_cell.py_func)
    for m in range(700):
        assert corrections.table[find(corrections, key[m])] == m
    assert corrections.table[find(corrections, 10_001)] == -1
    np.testing.assert_array_equal(corrections.value[:700], value)
    np.testing.assert_array_equal(corrections.state[:700], state)
