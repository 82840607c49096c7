"""Instances: given one by one or at once, saved and read, with more room; and the curve along which neighbours are near."""

import numpy as np
import pytest

from sb3_combrel.common.instances import BLOCK, Instances, along_curve, put_instance_at


def test_instances_store_periodic_coordinates_within_one_period_and_effects_the_short_way():
    instances = Instances.empty(1, 2, BLOCK, periodic=[True, False])
    put_instance_at.call(instances, (0, 0, np.array([1.9, 1.9]), np.array([2.1, 2.1]), 0.0, False))
    put_instance_at.call(instances, (0, 1, np.array([0.95, 0.95]), np.array([0.05, 0.05]), 0.0, False))
    np.testing.assert_allclose(instances.state[0, :2], [[0.9, 1.9], [0.95, 0.95]])
    np.testing.assert_allclose(instances.effect[0, :2], [[0.2, 0.2], [0.1, -0.9]])
    again = Instances.from_rows(1, instances.rows(), instances.periodic)
    np.testing.assert_array_equal(again.rows(), instances.rows())
    for name in ("block_low", "block_high"):
        np.testing.assert_array_equal(getattr(again, name)[..., :1], getattr(instances, name)[..., :1], err_msg=name)
    for _ in range(BLOCK - 2):
        put_instance_at.call(instances, (0, int(instances.size[0]), np.zeros(2), np.ones(2), 0.0, False))
    larger = instances.enlarged(BLOCK + 1)
    assert larger.capacity == 2 * BLOCK and larger.enlarged(2 * BLOCK) is larger
    np.testing.assert_array_equal(larger.rows(), instances.rows())
    np.testing.assert_array_equal(larger.periodic, [True, False])


def test_instances_given_at_once_are_as_those_given_one_by_one():
    rng, n_actions = np.random.default_rng(0), 3
    state, effect = rng.random((50, 2)), rng.normal(size=(50, 2))
    action, reward, terminated = rng.integers(n_actions, size=50), rng.normal(size=50), rng.random(50) < 0.5
    one_by_one = Instances.empty(n_actions, 2)
    for i, a in enumerate(action.tolist()):
        slot, ended = int(one_by_one.size[a]), bool(terminated[i])
        put_instance_at.call(one_by_one, (a, slot, state[i], state[i] + effect[i], float(reward[i]), ended))
    at_once = Instances.of_rows(n_actions, action, state, effect, reward, terminated)
    np.testing.assert_allclose(at_once.rows(), one_by_one.rows(), atol=1e-15)
    for name in ("size", "block_low", "block_high"):
        np.testing.assert_array_equal(getattr(at_once, name), getattr(one_by_one, name), err_msg=name)


@pytest.mark.parametrize("d", [1, 2, 4, 5])
def test_neighbours_along_the_curve_are_nearer_to_each_other_than_others(d):
    states = np.random.default_rng(d).random((200, d))
    ordered = states[np.argsort(along_curve(states), kind="stable")]
    steps = [np.linalg.norm(np.diff(some, axis=0), axis=1).mean() for some in (ordered, states)]
    assert steps[0] < 0.8 * steps[1]
