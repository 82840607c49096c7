"""A kernel average that is restored from its instances has the lists and rows that it had learned one by one."""

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, KERNELS, N_ACTIONS, learn, make_model, random_transitions

from sb3_combrel.common.instances import BLOCK, Instances, put_instance_at
from sb3_combrel.models.kernel_refill import in_neighbourhoods


def restored(model, grid, kernel, max_instances=None):
    """A new model that takes over the state of another."""
    fresh = make_model(grid, kernel, max_instances=max_instances)
    fresh.set_state(model.get_state())
    return fresh


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_restored_lists_and_rows_are_the_same_to_the_last_bit(grid, kernel):
    model = make_model(grid, kernel)
    learn(model, random_transitions(3, len(grid[0]), 150))
    fresh = restored(model, grid, kernel)
    assert model.arrays.lists.length.max() > 1
    for name in ("entry", "total", "last_total", "known", "n_lists"):
        np.testing.assert_array_equal(getattr(fresh.arrays, name), getattr(model.arrays, name), err_msg=name)
    for name in ("modelled", "reward", "n_optimistic"):
        np.testing.assert_array_equal(getattr(fresh.mdp.arrays, name), getattr(model.mdp.arrays, name), err_msg=name)
    for pair in range(len(model.known)):
        for one, other in ((fresh.arrays.lists, model.arrays.lists), (fresh.mdp.arrays.rows, model.mdp.arrays.rows)):
            np.testing.assert_array_equal(one.entries(pair), other.entries(pair))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_restored_model_learns_on_as_the_original_to_the_last_bit(kernel):
    grid = GRIDS[3]
    model = make_model(grid, kernel)
    transitions = random_transitions(6, 2, 160)
    learn(model, transitions[:80])
    fresh = restored(model, grid, kernel)
    for transition in transitions[80:]:
        changed = model.add(*transition)
        np.testing.assert_array_equal(fresh.add(*transition), changed)
        for one in (model, fresh):
            one.update_rows(changed)
        np.testing.assert_array_equal(fresh.mdp.arrays.reward, model.mdp.arrays.reward)
    state, expected = fresh.get_state(), model.get_state()
    for name, array in expected.items():
        np.testing.assert_array_equal(state[name], array)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_model_that_replaced_instances_is_restored_to_what_it_is_without_them(kernel):
    grid = GRIDS[2]
    model = make_model(grid, kernel, max_instances=20)
    learn(model, random_transitions(4, 2, 200))
    fresh = restored(model, grid, kernel, max_instances=20)
    n_points = model.grid.n_points
    for pair in range(N_ACTIONS * n_points):
        action, at = pair // n_points, model.grid.points()[pair % n_points]
        apart = ((model.instances.state[action, :20] - at) ** 2).sum(axis=1)
        weights = np.where(model.arrays.n_lists[action, :20] > 0, np.exp(-apart / kernel["breadth"] ** 2), 0.0)
        kept, total = [], 0.0
        for i in np.argsort(-weights, kind="stable"):
            if weights[i] < kernel["min_weight"] or weights[i] < kernel["min_fraction"] * total:
                break
            kept.append(i)
            total += weights[i]
        np.testing.assert_array_equal(fresh.arrays.lists.entries(pair)[0], kept)
        assert fresh.own_weight[pair] == pytest.approx(total)
    assert fresh.known[model.known].mean() > 0.9, "pairs that were known stay known, unless nothing is left"


def test_saved_weights_that_do_not_fit_the_instances_are_not_taken_over():
    grid, kernel = GRIDS[2], KERNELS[0]
    model = make_model(grid, kernel)
    learn(model, random_transitions(5, 2, 60))
    fresh = make_model(grid, kernel)
    n = len(model.known)
    state = model.get_state()
    state["instances"][:, -1] = 1.0
    fresh.set_state({"instances": state["instances"], "known": np.ones(n), "total": np.full(n, 1e9)})
    np.testing.assert_allclose(fresh.own_weight, model.own_weight, rtol=1e-12)
    assert not fresh.known[fresh.arrays.lists.length == 0].any()


@pytest.mark.parametrize("d", [1, 2, 4, 5])
def test_the_order_along_the_curve_has_every_listed_instance_once(d):
    rng = np.random.default_rng(d)
    action = np.sort(rng.integers(3, size=200))
    columns = rng.random((200, d)), rng.normal(size=(200, d)), rng.normal(size=200), rng.random(200) < 0.5
    given = Instances.of_rows(3, action, *columns)
    listed = rng.random(200) < 0.6
    near, slots = in_neighbourhoods(given, listed)
    for a in range(3):
        n = near.size[a]
        np.testing.assert_array_equal(np.sort(slots[a, :n]), np.flatnonzero(listed[action == a]))
        np.testing.assert_array_equal(near.state[a, :n], given.state[a, slots[a, :n]])
        # Neighbours along the curve are nearer to each other than in the order in which they were added.
        steps = [np.linalg.norm(np.diff(states, axis=0), axis=1).mean() for states in (near.state[a, :n], columns[0])]
        assert steps[0] < 0.8 * steps[1]


def test_instances_given_at_once_are_as_those_given_one_by_one():
    rng = np.random.default_rng(0)
    state, effect = rng.random((50, 2)), rng.normal(size=(50, 2))
    action, reward, terminated = rng.integers(N_ACTIONS, size=50), rng.normal(size=50), rng.random(50) < 0.5
    one_by_one = Instances.empty(N_ACTIONS, 2)
    for i in range(50):
        a = int(action[i])
        slot = int(one_by_one.size[a])
        put_instance_at(one_by_one, (a, slot, state[i], state[i] + effect[i], float(reward[i]), bool(terminated[i])))
    at_once = Instances.of_rows(N_ACTIONS, action, state, effect, reward, terminated)
    np.testing.assert_array_equal(at_once.size, one_by_one.size)
    for a, n in enumerate(one_by_one.size):
        for name in ("state", "reward", "terminated"):
            np.testing.assert_array_equal(getattr(at_once, name)[a, :n], getattr(one_by_one, name)[a, :n])
        np.testing.assert_allclose(at_once.effect[a, :n], one_by_one.effect[a, :n], atol=1e-15)
        n_blocks = -(-n // BLOCK)
        for name in ("block_low", "block_high"):
            np.testing.assert_array_equal(getattr(at_once, name)[a, :, :n_blocks], getattr(one_by_one, name)[a, :, :n_blocks])


def test_instances_come_back_from_their_rows():
    rng = np.random.default_rng(1)
    action = np.sort(rng.integers(3, size=90))
    given = Instances.of_rows(
        3, action, rng.random((90, 2)), rng.normal(size=(90, 2)), rng.normal(size=90), rng.random(90) < 0.5
    )
    again = Instances.from_rows(3, given.rows())
    np.testing.assert_array_equal(again.rows(), given.rows())
    np.testing.assert_array_equal(again.size, given.size)
    np.testing.assert_array_equal(again.block_low, given.block_low)
    assert again.terminated.dtype == np.bool_
