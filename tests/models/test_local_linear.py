"""The local linear model against its definition in plain loops: exact states, sums, fits and rows on the grid."""

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, N_ACTIONS, PERIODIC_GRIDS, random_transitions
from helpers.linear_models import (
    LINEAR_KERNELS,
    assert_same_fits,
    assert_same_sums,
    finish_episode,
    learn_linear,
    linear_model_and_definition,
    make_linear_model,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.fit_updates import MAX_UNEXPLAINED
from sb3_combrel.models.linear_fits import TOLERANCE
from sb3_combrel.models.local_linear import ON_GRID

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=30)
problems = st.tuples(
    st.sampled_from(GRIDS),
    st.sampled_from(LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 60),
    st.sampled_from([0.3, 1.0, 4.0]),
)


def problem_learned(problem, **kwargs):
    grid, kernel, seed, n, threshold = problem
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold, **kwargs)
    learn_linear(model, naive, random_transitions(seed, len(grid[0]), n))
    return model, naive


@slow_and_repeatable
@given(problems, st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3))
def test_the_prediction_at_any_state_is_that_of_the_definition(problem, at):
    model, naive = problem_learned(problem)
    d = len(problem[0][0])
    for state in np.array([at[:d], model.instances.state[0, 0] if model.instances.size[0] else at[:d]]):
        prediction, given = model.predict_at(state)
        assert given is None
        predictions = model.predict(np.array([state] * N_ACTIONS), np.arange(N_ACTIONS))
        for action in range(N_ACTIONS):
            expected = naive.at_state(state, action)
            assert prediction.weight[action] == pytest.approx(expected.weight, rel=1e-9)
            assert prediction.modelled[action] == (expected.weight >= naive.threshold)
            assert predictions.weight[action] == prediction.weight[action]
            if expected.weight == 0.0:
                assert prediction.length[action] == 0 and prediction.reward[action] == 0.0
                continue
            assert prediction.reward[action] == predictions.reward[action] == pytest.approx(expected.reward, abs=1e-9)
            assert prediction.length[action] == (1 if expected.end < 1.0 else 0)
            if expected.end < 1.0:
                assert prediction.probability[action, 0] == pytest.approx(1.0 - expected.end, abs=1e-9)
                np.testing.assert_allclose(prediction.effect[action, 0], expected.effect, rtol=1e-7, atol=1e-8)
                assert predictions.probability[action, 0] == prediction.probability[action, 0]
                np.testing.assert_array_equal(predictions.effect[action, 0], prediction.effect[action, 0])


def test_what_was_asked_for_before_does_not_change_a_prediction():
    grid, kernel = ((2, 2), 1, (True, False)), LINEAR_KERNELS[0]
    transitions = random_transitions(5, 2, 90)
    model, fresh = (make_linear_model(grid, kernel) for _ in range(2))
    rng = np.random.default_rng(0)
    for number, transition in enumerate(transitions):
        model.add(*transition)
        fresh.add(*transition)
        model.predict_at(rng.random(2))
        if number % 10 == 9:
            state = rng.random(2)
            asked = [array.copy() for array in model.predict_at(state)[0]]
            fresh._near.length[:] = 0
            for one, other in zip(asked, fresh.predict_at(state)[0], strict=True):
                np.testing.assert_array_equal(one, other)


def test_an_action_becomes_known_at_a_state_when_the_weights_of_its_instances_reach_the_threshold():
    model = make_linear_model(((2,), 0), dict(breadth=0.2, min_weight=0.01, n_neighbors=8, outcome_breadth=0.05), n_actions=1)
    state, weight = np.array([0.5]), 0.4
    for number in range(1, 4):
        away = (-1.0) ** number * 0.2 * np.sqrt(-np.log(weight))
        model.add(state + away, 0, -1.0, state, False)
        prediction, _ = model.predict_at(state)
        assert prediction.weight[0] == pytest.approx(number * weight)
        assert prediction.modelled[0] == (number == 3)


def test_instances_farther_than_min_weight_allows_do_not_count():
    kernel = dict(breadth=0.2, min_weight=0.1, n_neighbors=8, outcome_breadth=0.05)
    reach = 0.2 * np.sqrt(-np.log(0.1))
    model = make_linear_model(((2,), 0), kernel, n_actions=1)
    model.add(np.array([0.2]), 0, -1.0, np.array([0.3]), False)
    assert model.predict_at(np.array([0.2 + 0.999 * reach]))[0].weight[0] == pytest.approx(0.1, rel=0.01)
    assert model.predict_at(np.array([0.2 + 1.001 * reach]))[0].weight[0] == 0.0


def test_predicted_effects_stay_within_the_range_of_those_seen():
    model = make_linear_model(((2,), 0), dict(breadth=0.5, min_weight=0.01, n_neighbors=8, outcome_breadth=0.05), n_actions=1)
    for at in np.linspace(0.0, 0.5, 11):
        model.add(np.array([at]), 0, -1.0, np.array([at + 0.4 * at]), False)
    prediction, _ = model.predict_at(np.array([0.8]))
    assert prediction.effect[0, 0, 0] == pytest.approx(0.2), "the line goes on to 0.32"


@slow_and_repeatable
@given(problems)
def test_the_sums_of_every_pair_are_those_of_the_instances_within_its_reach(problem):
    assert_same_sums(*problem_learned(problem))


@slow_and_repeatable
@given(problems)
def test_what_is_known_and_how_narrow_kernels_are_is_right_after_every_instance(problem):
    grid, kernel, seed, n, threshold = problem
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold)
    for transition in random_transitions(seed, len(grid[0]), n):
        before = model.fits.reach.copy(), model.fits.limit.copy(), model.fits.n_counted.copy()
        learn_linear(model, naive, [transition])
        np.testing.assert_array_equal(model.known.reshape(N_ACTIONS, -1), naive.known)
        np.testing.assert_allclose(model.own_weight.reshape(N_ACTIONS, -1), naive.total, rtol=1e-12)
        np.testing.assert_allclose(model.fits.reach.reshape(N_ACTIONS, -1), naive.reach, rtol=1e-12)
        np.testing.assert_array_equal(model.fits.limit.reshape(N_ACTIONS, -1), naive.limit)
        narrower = np.flatnonzero(model.fits.reach != before[0])
        assert (model.fits.reach[narrower] < before[0][narrower]).all()
        assert (before[2][narrower] + 1 > before[1][narrower]).all(), "kernels narrow when the limit is exceeded"
        assert (model.fits.n_counted <= model.fits.limit)[model.known].all()
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~naive.known).sum(axis=0))


@pytest.mark.parametrize("threshold", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("ended", [True, False], ids=["after_an_end", "before_any_end"])
def test_a_grid_point_is_known_with_a_part_of_the_threshold_once_an_episode_has_ended(threshold, ended):
    model = make_linear_model(((1,), 0), LINEAR_KERNELS[0], threshold=threshold)
    model.add(np.array([0.5]), 1, -1.0, np.array([0.6]), ended)
    n = 0
    while not model.known[1]:
        model.add(np.array([0.5]), 0, -1.0, np.array([0.6]), False)
        n += 1
    assert n == np.ceil((ON_GRID if ended else 1.0) * threshold)


@slow_and_repeatable
@given(problems, st.sampled_from([1.0, 0.9]))
def test_at_an_episodes_end_every_row_is_the_one_of_the_definition(problem, gamma):
    grid, kernel, seed, n, threshold = problem
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold, gamma=gamma)
    transitions = random_transitions(seed, len(grid[0]), n)
    for first in range(0, n, 20):
        learn_linear(model, naive, transitions[first : first + 20])
        finish_episode(model)
        assert_same_fits(model, naive, gamma)
        assert (model.fits.unexplained[model.known] == 0.0).all()
    assert len(model.end_episode()) == 0, "nothing has happened since"


@pytest.mark.parametrize("grid", [((3, 2), 0), *PERIODIC_GRIDS], ids=str)
def test_sums_and_rows_are_right_after_arrays_have_grown(grid):
    model, naive = linear_model_and_definition(grid, LINEAR_KERNELS[1])
    capacity = model.instances.capacity
    learn_linear(model, naive, random_transitions(2, len(grid[0]), 300))
    assert model.instances.capacity > capacity
    finish_episode(model)
    assert_same_sums(model, naive)
    assert assert_same_fits(model, naive) > 10


@slow_and_repeatable
@given(problems, st.floats(0.05, 0.9))
def test_a_lower_threshold_makes_those_pairs_known_whose_weight_reaches_it(problem, threshold):
    model, naive = problem_learned(problem)
    before = model.known.copy()
    newly_known = model.lower_threshold(threshold)
    naive.lower_threshold(threshold)
    np.testing.assert_array_equal(newly_known, np.flatnonzero(~before & naive.known.reshape(-1)))
    model.update_rows(newly_known)
    finish_episode(model)
    assert_same_fits(model, naive)


@slow_and_repeatable
@given(problems)
def test_pairs_that_are_accepted_are_known_from_what_they_have_if_they_have_anything(problem):
    model, naive = problem_learned(problem)
    asked = np.arange(0, len(model.known), 2)
    newly_known = model.accept(asked)
    np.testing.assert_array_equal(newly_known, [p for p in asked if not naive.known.flat[p] and naive.total.flat[p] > 0.0])
    model.update_rows(newly_known)
    finish_episode(model)
    naive.known.flat[newly_known] = True
    assert_same_fits(model, naive)


@slow_and_repeatable
@given(problems)
def test_within_an_episode_pairs_are_fitted_again_before_too_much_is_left_unexplained(problem):
    grid, kernel, seed, n, threshold = problem
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold)
    fits, d = model.fits, len(grid[0])
    for transition in random_transitions(seed, d, n):
        known_before, unexplained_before = model.known.copy(), fits.unexplained.copy()
        learn_linear(model, naive, [transition])
        assert (fits.unexplained[model.known] <= MAX_UNEXPLAINED).all()
        gained = (fits.unexplained != unexplained_before) & model.known
        for pair in np.flatnonzero(gained & (fits.unexplained == 0.0)):
            action, point = divmod(int(pair), naive.n_points)
            expected = naive.at_pair(action, point)
            # As the effects are: twice their mean size, and no less than a part of a cell.
            apart = np.abs(fits.row[pair, :d] - expected.effect)
            assert (apart <= TOLERANCE * fits.effect_scale[action] + 1e-8).all()
            assert abs(fits.row[pair, d] - expected.reward) <= TOLERANCE * abs(expected.reward) + 1e-8
            assert abs(fits.row[pair, d + 1] - expected.end) <= TOLERANCE + 1e-8
        assert (fits.unexplained[model.known & ~known_before] == 0.0).all(), "the first fit is made at once"


@slow_and_repeatable
@given(st.integers(0, 10**6), st.integers(1, 3), st.floats(0.0, 0.5))
def test_where_all_instances_are_at_one_state_rows_are_as_near_to_the_fit_as_is_promised(seed, d, spread):
    # The fit is the mean then, which each instance moves by its share of what it differs by.
    rng = np.random.default_rng(seed)
    kernel = dict(breadth=0.3, min_weight=0.01, n_neighbors=30, outcome_breadth=0.3)
    model, naive = linear_model_and_definition(((2,) * d, 0), kernel, n_actions=1)
    state, largest_scale = rng.random(d), 0.0
    for _ in range(40):
        effect = 0.1 + spread * rng.normal(size=d)
        learn_linear(model, naive, [(state, 0, -1.0, state + effect, False)])
        largest_scale = np.maximum(largest_scale, model.fits.effect_scale[0])
        for pair in np.flatnonzero(model.known):
            apart = np.abs(model.fits.row[pair, :d] - naive.at_pair(0, int(pair)).effect)
            assert (apart <= (MAX_UNEXPLAINED + TOLERANCE) * largest_scale + 1e-8).all()


def test_most_instances_that_agree_with_the_fit_change_no_row():
    model = make_linear_model(((3, 3), 0), LINEAR_KERNELS[0], n_actions=1)
    rng = np.random.default_rng(0)
    n_changed = []
    for state in rng.random((400, 2)):
        n_changed.append(len(model.add(state, 0, -1.0, state + 0.1 + 0.05 * state, False)))
    assert np.mean(n_changed[200:]) < 0.2 * np.mean(n_changed[:20])
