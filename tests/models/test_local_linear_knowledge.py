"""What decides what the local linear model knows narrows as long as no outcome has told states apart."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import N_ACTIONS, learn
from helpers.naive_local_linear import NaiveReplacement

from sb3_combrel.models.local_linear import CHECKED_EVERY

GRID, KERNEL, THRESHOLD = ((3,), 0), linear_models.LINEAR_KERNELS[0], 3.0
AN_END, ANOTHER_REWARD = (-1.0, True), (-2.0, False)


def uninformative(seed, n, reward=-1.0):
    """Transitions from everywhere, with one and the same reward and no end."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, 1))
    return [(state, i % N_ACTIONS, reward, state + rng.normal(0.0, 0.1, 1), False) for i, state in enumerate(states)]


def outcome_at(state, reward, terminated):
    return np.array([state]), 0, reward, np.array([state + 0.1]), terminated


def narrowing_of(model):
    return model.get_state()["narrowing"][0]


def assert_same_knowledge(model, naive):
    np.testing.assert_array_equal(model.known.reshape(naive.known.shape), naive.known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_allclose(model.own_weight.reshape(naive.known.shape), naive.total, rtol=1e-9)
    assert narrowing_of(model) == naive.narrowing and model.exploration_threshold == naive.threshold


@pytest.mark.parametrize(
    ("threshold", "outcome", "max_instances"), [(0.3, AN_END, None), (3.0, ANOTHER_REWARD, 25), (3.0, AN_END, 10)]
)
def test_what_is_known_is_that_of_the_definition_before_and_after_the_first_outcome(threshold, outcome, max_instances):
    # At 25 there are 50 instances for ever, at 10 never so many: transitions count, not instances.
    model, naive = linear_models.linear_model_and_definition(GRID, KERNEL, threshold=threshold, max_instances=max_instances)
    learner = naive if max_instances is None else NaiveReplacement(naive, max_instances)
    highest = 1.0
    for transition in [*uninformative(2, 120), outcome_at(0.5, *outcome), *uninformative(3, 20)]:
        linear_models.learn_linear(model, learner, [transition])
        assert_same_knowledge(model, naive)
        highest = max(highest, naive.narrowing)
    assert 2.0 <= highest <= 64.0 and naive.narrowing == 1.0
    linear_models.assert_same_sums(model, naive)
    linear_models.finish_episode(model)
    assert linear_models.assert_same_fits(model, naive) > 0


@pytest.mark.parametrize("n", [CHECKED_EVERY - 5, CHECKED_EVERY + 5, 2 * CHECKED_EVERY + 30])
def test_how_narrow_it_is_is_saved_and_restored(n):
    model, restored = (linear_models.make_linear_model(GRID, KERNEL, threshold=THRESHOLD) for _ in range(2))
    learn(model, uninformative(4, n))
    narrowing = narrowing_of(model)
    assert (narrowing > 1.0) == (n > CHECKED_EVERY)
    linear_models.assert_restored(model, restored, [])
    assert narrowing_of(restored) == narrowing
    # Transitions after which it is looked at again, and the first outcome.
    linear_models.assert_restored(model, restored, [*uninformative(5, CHECKED_EVERY), outcome_at(0.5, *AN_END)])
    assert narrowing_of(model) == narrowing_of(restored) == 1.0


def test_an_outcome_whose_instance_has_been_replaced_is_remembered_after_loading():
    model, restored = (linear_models.make_linear_model(GRID, KERNEL, threshold=THRESHOLD, max_instances=5) for _ in range(2))
    learn(model, [outcome_at(0.5, *AN_END), *uninformative(6, 90)])
    assert not model.instances.terminated[:, :5].any()
    linear_models.finish_episode(model)
    restored.set_state(model.get_state())
    for transition in uninformative(7, 2 * CHECKED_EVERY):
        model.update_rows(model.add(*transition))
        restored.update_rows(restored.add(*transition))
        np.testing.assert_array_equal(restored.known, model.known)
    assert narrowing_of(model) == narrowing_of(restored) == 1.0
