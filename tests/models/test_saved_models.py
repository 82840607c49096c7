"""Models saved and restored: what a new model takes over is the same to the last bit, and learns the same from there on."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import GRIDS, KERNELS, learn, make_model, random_transitions
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.models.local_linear import LocalLinear


@settings(deadline=None, derandomize=True, max_examples=15)
@given(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(0, 60),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
def test_a_restored_local_linear_model_is_and_learns_the_same_to_the_last_bit(grid, kernel, seed, n, small, informed, ended):
    d = len(grid[0])
    effect = linear_models.CurvedDynamics(0, d).effect
    model, restored = (
        linear_models.make_linear_model(
            grid, kernel, gamma=0.9, prior=linear_models.StubPrior(effect, linear_models.left_half) if informed else None
        )
        for _ in range(2)
    )
    model.update_rows(model.renew_prior())
    transitions = random_transitions(seed, d, n + 30)
    learn(model, linear_models.small_steps(seed, d, n, ends=bool(seed % 2)) if small else transitions[:n])
    if ended:
        linear_models.finish_episode(model)
    linear_models.assert_restored(model, restored, transitions[n:])


@pytest.mark.parametrize("seed", range(3))
def test_what_is_predicted_of_states_is_the_same_after_instances_were_replaced(seed):
    grid, kernel = ((2, 2), 1, (True, False)), linear_models.LINEAR_KERNELS[seed]
    model, restored = (linear_models.make_linear_model(grid, kernel, max_instances=15) for _ in range(2))
    transitions = random_transitions(seed, 2, 220)
    learn(model, transitions[:200])
    restored.set_state(model.get_state())
    linear_models.assert_same_predictions(model, restored)
    rows = [np.unique(one.instances.rows(), axis=0) for one in (model, restored)]
    np.testing.assert_array_equal(*rows)
    assert restored.n_added == 200
    for one in (model, restored):
        learn(one, transitions[200:])
        one.update_all(np.arange(len(one.known)))
    for name in ("known", "length", "fitted_at"):
        np.testing.assert_array_equal(getattr(model.pairs, name), getattr(restored.pairs, name), err_msg=name)
    np.testing.assert_allclose(model.mdp.arrays.reward, restored.mdp.arrays.reward, rtol=1e-9)


def test_an_outcome_whose_instance_has_been_replaced_is_remembered_after_loading():
    model, restored = (
        linear_models.make_linear_model(((3,), 0), linear_models.LINEAR_KERNELS[0], threshold=3.0, max_instances=5)
        for _ in range(2)
    )
    learn(model, [(np.array([0.5]), 0, -1.0, np.array([0.6]), True), *linear_models.small_steps(1, 1, 60)])
    assert not model.instances.terminated[:, :5].any() and model.known.any()
    restored.set_state(model.get_state())
    for one in (model, restored):
        one.update_all(np.arange(len(one.known)))
    np.testing.assert_array_equal(restored.known, model.known)


@pytest.mark.parametrize(("grid", "kernel"), [(grid, KERNELS[i % 4]) for i, grid in enumerate(GRIDS) if i % 3 == 2], ids=str)
def test_a_restored_kernel_average_is_and_learns_on_as_the_original_to_the_last_bit(grid, kernel):
    model, restored = make_model(grid, kernel, 0.9), make_model(grid, kernel, 0.9)
    transitions = random_transitions(3, len(grid[0]), 130)
    learn(model, transitions[:100])
    linear_models.assert_restored(model, restored, transitions[100:])


class NoInstances:
    """A transfer method that has none."""

    use = "instances"

    def transferred(self, states, actions, own_weight):
        return TransferredInstances.empty(*states.shape)

    def transferred_to_sample(self, points, actions, own_weight):
        return TransferredInstances.empty(len(points), 1)


@pytest.mark.parametrize("model_class", [KernelAverage, LocalLinear])
def test_a_model_that_knows_everything_is_restored_with_a_transfer_method_that_is_not_needed_any_more(model_class):
    grid, kernel = ((2,), 0), dict(breadth=0.5, min_weight=0.01, min_fraction=0.1)
    model, restored = (make_model(grid, kernel, transfer=NoInstances(), model_class=model_class) for _ in range(2))
    learn(model, random_transitions(0, 1, 200))
    assert model.known.all()
    restored.set_state(model.get_state())
    linear_models.assert_same_to_the_last_bit(model, restored)


def test_transitions_come_back_in_the_order_in_which_they_came():
    expected = random_transitions(7, 2, 150)
    model = linear_models.make_linear_model(((2, 2), 0), linear_models.LINEAR_KERNELS[0])
    learn(model, expected)
    for (state, action, reward, after, ended), other in zip(model.transitions(), expected, strict=True):
        assert (action, reward, ended) == (other[1], other[2], other[4])
        np.testing.assert_allclose([state, after], [other[0], other[3]], atol=1e-12)
