"""The local linear model demands more weight as long as no outcome has told states apart."""

import numpy as np
import pytest
from helpers.kernel_models import N_ACTIONS
from helpers.linear_models import (
    LINEAR_KERNELS,
    assert_restored,
    assert_same_fits,
    assert_same_sums,
    finish_episode,
    learn_linear,
    linear_model_and_definition,
    make_linear_model,
)
from helpers.naive_local_linear import NaiveLocalLinear, NaiveReplacement

from sb3_combrel.models.local_linear import CHECKED_EVERY, ON_GRID

GRID, KERNEL, THRESHOLD = ((3,), 0), LINEAR_KERNELS[0], 3.0
AN_END, ANOTHER_REWARD = (-1.0, True), (-2.0, False)


def uninformative(seed, n, reward=-1.0):
    """Transitions from everywhere, with one and the same reward and no end."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, 1))
    return [(state, i % N_ACTIONS, reward, state + rng.normal(0.0, 0.1, 1), False) for i, state in enumerate(states)]


def outcome_at(state, reward, terminated):
    return np.array([state]), 0, reward, np.array([state + 0.1]), terminated


def assert_same_knowledge(model, naive):
    np.testing.assert_array_equal(model.known.reshape(naive.known.shape), naive.known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_allclose(model.own_weight.reshape(naive.known.shape), naive.total, rtol=1e-9)
    assert model.exploration_threshold == naive.demand * naive.threshold


@pytest.mark.parametrize("outcome", [AN_END, ANOTHER_REWARD], ids=["an_end", "another_reward"])
def test_demand_doubles_and_pairs_are_forgotten_until_the_first_outcome_restores_them(outcome):
    model = make_linear_model(GRID, KERNEL, threshold=THRESHOLD)
    transitions = uninformative(0, CHECKED_EVERY)
    for transition in transitions[:-1]:
        model.update_rows(model.add(*transition))
    assert model.known.all() and model.exploration_threshold == THRESHOLD
    weight_before = model.own_weight.copy()
    changed = model.add(*transitions[-1])
    model.update_rows(changed)
    assert model.exploration_threshold == 2.0 * THRESHOLD
    forgotten = np.flatnonzero(~model.known)
    assert 0 < len(forgotten) < len(model.known)
    np.testing.assert_array_equal(model.known, model.own_weight >= 2.0 * THRESHOLD)
    assert np.isin(forgotten, changed).all() and not model.mdp.arrays.modelled[forgotten].any()
    assert (model.own_weight > weight_before).any(), "the weight of what was known has gone on growing"
    # One instance, and the pairs of both actions are known again.
    changed = model.add(*outcome_at(0.5, *outcome))
    model.update_rows(changed)
    assert model.exploration_threshold == THRESHOLD
    assert np.isin(forgotten, changed).all() and model.known.all() and model.mdp.arrays.modelled.all()


def test_the_same_reward_again_and_again_tells_nothing_and_pairs_need_the_full_threshold():
    model = make_linear_model(GRID, KERNEL, threshold=THRESHOLD)
    for transition in uninformative(1, 12):
        model.add(*transition)
        np.testing.assert_array_equal(model.known, model.own_weight >= THRESHOLD)
    between = ~model.known & (model.own_weight >= ON_GRID * THRESHOLD)
    assert between.any()
    model.add(*outcome_at(0.5, *AN_END))
    assert model.known[between].all()


def test_a_threshold_that_is_lowered_is_still_multiplied():
    model = make_linear_model(GRID, KERNEL, threshold=THRESHOLD)
    for transition in uninformative(0, CHECKED_EVERY):
        model.update_rows(model.add(*transition))
    model.lower_threshold(0.9 * THRESHOLD)
    assert model.exploration_threshold == pytest.approx(1.8 * THRESHOLD)
    np.testing.assert_array_equal(model.known, model.own_weight >= 1.8 * THRESHOLD)
    model.add(*outcome_at(0.5, *AN_END))
    assert model.exploration_threshold == pytest.approx(0.9 * THRESHOLD)


@pytest.mark.parametrize("max_instances", [None, 25, 10])
@pytest.mark.parametrize("threshold", [0.3, 3.0])
def test_what_is_known_is_that_of_the_definition_before_and_after_the_first_outcome(max_instances, threshold):
    # At 25 there are 50 instances for ever, at 10 never so many: transitions count, not instances.
    model, naive = linear_model_and_definition(GRID, KERNEL, threshold=threshold, max_instances=max_instances)
    learner: NaiveLocalLinear | NaiveReplacement = naive
    if max_instances is not None:
        learner = NaiveReplacement(naive, max_instances)
    highest = 1.0
    for transition in [*uninformative(2, 230), outcome_at(0.5, *AN_END), *uninformative(3, 60)]:
        learn_linear(model, learner, [transition])
        assert_same_knowledge(model, naive)
        highest = max(highest, naive.demand)
    assert 2.0 <= highest <= 16.0 and naive.demand == 1.0
    assert_same_sums(model, naive)
    finish_episode(model)
    assert assert_same_fits(model, naive) > 0


@pytest.mark.parametrize("n", [CHECKED_EVERY - 5, CHECKED_EVERY + 5, 2 * CHECKED_EVERY + 30])
def test_what_is_demanded_is_saved_and_restored(n):
    model, restored = (make_linear_model(GRID, KERNEL, threshold=THRESHOLD) for _ in range(2))
    for transition in uninformative(4, n):
        model.update_rows(model.add(*transition))
    demanded = model.exploration_threshold
    assert (demanded > THRESHOLD) == (n > CHECKED_EVERY)
    assert_restored(model, restored, [])
    assert restored.exploration_threshold == demanded
    # Transitions after which it is looked at again, and the first outcome.
    assert_restored(model, restored, [*uninformative(5, CHECKED_EVERY), outcome_at(0.5, *AN_END)])
    assert model.exploration_threshold == restored.exploration_threshold == THRESHOLD


def test_an_outcome_whose_instance_has_been_replaced_is_remembered_after_loading():
    model, restored = (make_linear_model(GRID, KERNEL, threshold=THRESHOLD, max_instances=5) for _ in range(2))
    model.update_rows(model.add(*outcome_at(0.5, *AN_END)))
    for transition in uninformative(6, 90):
        model.update_rows(model.add(*transition))
    assert not model.instances.terminated[:, :5].any()
    finish_episode(model)
    restored.set_state(model.get_state())
    for transition in uninformative(7, 2 * CHECKED_EVERY):
        model.update_rows(model.add(*transition))
        restored.update_rows(restored.add(*transition))
        np.testing.assert_array_equal(restored.known, model.known)
    assert model.exploration_threshold == restored.exploration_threshold == THRESHOLD
