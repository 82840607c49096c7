"""Whether an episode ends is a function of where one arrives: against the definition, and what follows from it."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import N_ACTIONS, random_transitions
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel.common.compiled import compiled
from sb3_combrel.models.ends import end_at

KERNEL = dict(breadth=0.5, min_weight=0.01, n_neighbors=8, outcome_breadth=0.1)


@compiled
def call_end_at(state, near, outcome_breadth, arrivals, ends, found):
    end_at(state, near, outcome_breadth, arrivals, ends, found)


def found_at(model, state, near=np.inf):
    """Probability of an end, and what it pays."""
    found = np.empty(2)
    call_end_at(state, near, model.kernel.outcome_breadth, model.arrivals, model.ends, found)
    return found


@settings(deadline=None, derandomize=True, max_examples=25)
@given(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.ENDS_BY_ARRIVAL),
    st.integers(0, 10**6),
    st.integers(1, 120),
    st.sampled_from([None, 10]),
)
def test_the_arrivals_nearest_to_a_state_decide_however_near_some_arrival_is_said_to_be(grid, kernel, seed, n, most):
    model, naive = linear_models.linear_model_and_definition(grid, kernel, max_instances=most)
    d, rng = len(grid[0]), np.random.default_rng(seed)
    for transition in random_transitions(seed, d, n):
        model.add(*transition)
        naive.add(*transition)
    arrivals = [i.state + i.effect for i in naive.transitions if i.until == np.inf]
    for state in [*rng.uniform(-0.3, 1.3, (10, d)), *arrivals[:3], arrivals[0] + 1e-5]:
        expected = naive.end_at(state, naive.now)
        nearest = min(naive.squared(state, arrival) for arrival in arrivals)
        for near in (np.inf, nearest, nearest + rng.exponential(0.1)):
            np.testing.assert_allclose(found_at(model, state, near), expected, rtol=1e-9, atol=1e-12)


def line_model(ends_from=0.75, reward=7.0, n=31):
    """Steps of 0.05 to the right from all along a line; those that arrive at ``ends_from`` or beyond end the episode."""
    model, naive = linear_models.linear_model_and_definition(((4,), 1), KERNEL, gamma=0.9)
    for at in np.linspace(0.0, 0.9, n):
        ended = at + 0.05 >= ends_from
        linear_models.learn_linear(
            model, naive, [(np.array([at]), 0, reward if ended else -1.0, np.array([at + 0.05]), ended)]
        )
    return model, naive


def test_an_arrival_that_was_made_before_decides_for_itself():
    model, naive = line_model()
    for transition in naive.transitions:
        end, pays = found_at(model, transition.state + transition.effect)
        assert end == pytest.approx(float(transition.terminated), abs=1e-12)
        assert pays == (7.0 if transition.terminated else 0.0)


def test_beyond_an_edge_at_which_episodes_end_states_count_as_ended_and_far_from_it_none_does():
    model, _ = line_model()
    for state in (0.8, 0.93, 1.0, 1.1, 2.0):
        np.testing.assert_allclose(found_at(model, np.array([state])), [1.0, 7.0], atol=1e-12)
    for state in (-1.0, 0.0, 0.3, 0.5, 0.6):
        assert found_at(model, np.array([state])).tolist() == [0.0, 0.0]
    prediction = model.predict_at(np.array([0.72]))[0]
    assert prediction.length[0] == 0 and prediction.reward[0] == pytest.approx(7.0, abs=1e-6)
    prediction = model.predict_at(np.array([0.5]))[0]
    assert prediction.probability[0, 0] == 1.0 and prediction.reward[0] == pytest.approx(-1.0)


def test_an_end_that_one_action_has_found_counts_for_those_that_lead_to_the_same_place():
    model, naive = line_model()
    back = [(np.array([at]), 1, -1.0, np.array([at - 0.02]), False) for at in np.linspace(0.0, 0.7, 20)]
    linear_models.learn_linear(model, naive, back)
    # Never tried there, action 1 would lead to where action 0 has ended episodes.
    prediction = model.predict_at(np.array([0.85]))[0]
    assert prediction.modelled[1] and prediction.length[1] == 0 and prediction.reward[1] == pytest.approx(7.0)
    model.update_all(np.arange(len(model.known)))
    assert linear_models.assert_same_rows(model, naive) > 0


def test_what_an_end_pays_is_not_mixed_into_the_rewards_of_going_on():
    model, naive = line_model(reward=1000.0)
    model.update_all(np.arange(len(model.known)))
    linear_models.assert_same_rows(model, naive)
    reward, at = model.mdp.arrays.reward[:, 0], model.grid.points()[:, 0]
    held_for_a_cell = -(1.0 - 0.9**1.25) / (1.0 - 0.9)
    for point in np.flatnonzero(model.known[: model.grid.n_points] & (at >= 0.0) & (at < 0.55)):
        assert reward[point] >= -2.0 and reward[point] < 0.0, "no part of a thousand"
        assert reward[point] == pytest.approx(held_for_a_cell, abs=0.15)


def test_ends_on_the_other_side_of_an_origin_are_near():
    grid = ((3,), 0, (True,))
    model, naive = linear_models.linear_model_and_definition(grid, KERNEL)
    transitions = [(np.array([at]), 0, -1.0, np.array([at + 0.05]), at > 0.94) for at in (0.3, 0.5, 0.7, 0.9, 0.96)]
    linear_models.learn_linear(model, naive, transitions)
    for state, ended in ((0.0, 1.0), (0.01, 1.0), (1.01, 1.0), (0.02, 1.0), (0.55, 0.0)):
        assert found_at(model, np.array([state]))[0] == pytest.approx(ended, abs=1e-6)
        assert naive.end_at(np.array([state]), naive.now)[0] == pytest.approx(ended, abs=1e-6)


def noisy_line_model(noise, n=300):
    """Steps of 0.05 to the right, with noise; those that arrive beyond 0.75 end the episode."""
    model, naive = linear_models.linear_model_and_definition(((4,), 1), KERNEL | dict(n_neighbors=20), gamma=0.9)
    rng = np.random.default_rng(0)
    for at in rng.uniform(0.0, 0.75, n):
        to = at + 0.05 + noise * rng.normal()
        transition = np.array([at]), 0, 7.0 if to > 0.75 else -1.0, np.array([to]), bool(to > 0.75)
        model.add(*transition)
        naive.add(*transition)
    return model, naive


def test_near_an_edge_noise_ends_as_many_episodes_as_it_does():
    noise = 0.02
    model, naive = noisy_line_model(noise)
    errors = []
    for at in np.linspace(0.66, 0.74, 30):
        prediction = model.predict_at(np.array([at]))[0]
        end = 1.0 - prediction.probability[0, 0] if prediction.length[0] else 1.0
        errors.append(end - stats.norm.cdf((at + 0.05 - 0.75) / noise))
        linear_models.assert_same_prediction(model, naive, np.array([at]))
    # Twenty instances say it to a tenth; judged where the mean effect leads, the error would be 0.24.
    assert abs(np.mean(errors)) < 0.1 and np.sqrt(np.mean(np.square(errors))) < 0.15
    assert model.predict_at(np.array([0.6]))[0].probability[0, 0] == 1.0


def test_without_noise_an_end_is_judged_where_the_mean_effect_leads():
    model, naive = noisy_line_model(0.0)
    ends = [model.predict_at(np.array([at]))[0].length[0] == 0 for at in (0.6, 0.68, 0.69, 0.71, 0.72, 0.74)]
    assert ends == [False] * 3 + [True] * 3
    model.update_all(np.arange(len(model.known)))
    assert linear_models.assert_same_rows(model, naive) > 0


@pytest.mark.parametrize("outcome_breadth", [1e-3, 1e-2])
def test_rewards_far_from_all_instances_are_numbers_however_narrow_the_kernel_of_ends_is(outcome_breadth):
    model, naive = linear_models.linear_model_and_definition(((3,), 0), KERNEL | dict(outcome_breadth=outcome_breadth))
    transitions = [
        (np.array([0.0]), a, r, np.array([0.05]), e) for a in range(N_ACTIONS) for r, e in ((-1.0, False), (3.0, True))
    ]
    linear_models.learn_linear(model, naive, transitions)
    model.update_all(np.arange(len(model.known)))
    assert linear_models.assert_same_rows(model, naive) > 0 and np.isfinite(model.mdp.arrays.reward).all()
    linear_models.assert_same_prediction(model, naive, np.array([0.4]))
