"""Scales are found from observations, where the user gives no bounds."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from helpers.walk import Walk
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sb3_combrel import FittedRMax
from sb3_combrel.common.constants import BEYOND, TOO_WIDE
from sb3_combrel.fitted_rmax.scales import FoundScales, around_zero

NOT_PERIODIC = np.zeros(2, dtype=np.bool_)
OBSERVATIONS = arrays(np.float64, st.tuples(st.integers(1, 20), st.just(2)), elements=st.floats(-1e6, 1e6))


def box(low, high):
    return spaces.Box(np.array(low, dtype=np.float64), np.array(high, dtype=np.float64), dtype=np.float64)


UNBOUNDED = box([-np.inf, -np.inf], [np.inf, np.inf])


def note(scales, observations):
    """Let scales see observations, shape (n, n_variables)."""
    least, most = np.min(observations, axis=0), np.max(observations, axis=0)
    scales.observed[:] = np.minimum(scales.observed[0], least), np.maximum(scales.observed[1], most)


def after(observations, space=UNBOUNDED, episode_ended=True, bounds=None, periodic=NOT_PERIODIC):
    """Scales that have seen observations, renewed once."""
    scales = FoundScales(space, bounds, periodic)
    note(scales, observations)
    scales.renewed(episode_ended)
    return scales


@given(OBSERVATIONS)
def test_without_bounds_all_that_was_observed_lies_within(observations):
    scaling = after(observations).scaling
    tolerated = BEYOND * (scaling.high - scaling.low) + 1e-9
    assert (observations >= scaling.low - tolerated).all() and (observations <= scaling.high + tolerated).all()


@given(OBSERVATIONS, OBSERVATIONS)
def test_what_has_been_renewed_is_not_renewed_again_until_something_new_is_observed(observations, more):
    scales = after(observations)
    assert scales.renewed(episode_ended=True) is None and scales.renewed(episode_ended=False) is None
    low, high = scales.scaling.low, scales.scaling.high
    note(scales, more)
    beyond = ((more < low - BEYOND * (high - low)) | (more > high + BEYOND * (high - low))).any()
    renewed = scales.renewed(episode_ended=True)
    assert renewed is not None or not beyond


@given(OBSERVATIONS)
def test_what_lies_beyond_the_space_is_scaled_once(observations):
    scales = after(observations, box([-1.0, -1.0], [1.0, 1.0]))
    tolerated = BEYOND * (scales.scaling.high - scales.scaling.low) + 1e-9
    inside = (observations >= scales.scaling.low - tolerated) & (observations <= scales.scaling.high + tolerated)
    assert inside.all() and scales.renewed(episode_ended=True) is None
    np.testing.assert_array_equal(scales.beyond_space(), (np.abs(observations) > 1.0 + 2.0 * BEYOND).any(axis=0))


@pytest.mark.parametrize(("most", "beyond"), [(np.float64(np.float32(0.07)), False), (0.3, True)])
def test_rounding_is_not_beyond_a_space_with_one_bound(most, beyond):
    scales = FoundScales(box([-np.inf], [0.07]), None, np.zeros(1, dtype=np.bool_))
    note(scales, np.array([[-0.05], [most]]))
    assert scales.beyond_space().tolist() == [beyond]


class Wider(Walk):
    """It says that it ends halfway."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(np.float32([-1.0, 0.0]), np.float32([-0.5, 2.0]))


def test_an_environment_that_leaves_its_space_is_told_once():
    with pytest.warns(UserWarning, match=r"s0 from -\S+ to \S+, but the space says from -1 to -0\.5") as told:
        FittedRMax(Wider(), seed=0).learn(100)
    assert len([each for each in told if "observation space" in str(each.message)]) == 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_observation_that_is_beyond_them_changes_them_at_once(side):
    scales = after([[-1.0, -1.0], [1.0, 1.0]])
    np.testing.assert_array_equal([scales.scaling.low, scales.scaling.high], [[-1.0, -1.0], [1.0, 1.0]])
    for beyond, change in [(0.5 * BEYOND, False), (2 * BEYOND, True)]:
        for episode_ended in (False, True):
            scales = after([[-1.0, -1.0], [1.0, 1.0]])
            at = side * (1.0 + 2.0 * beyond)
            note(scales, [[at, 0.0]])
            renewed = scales.renewed(episode_ended)
            assert (renewed is not None) == change
            if renewed is not None:
                assert renewed is scales.scaling
                np.testing.assert_allclose([renewed.low[0], renewed.high[0]], [-abs(at), abs(at)])
                assert (renewed.low[1], renewed.high[1]) == (-1.0, 1.0), "the other variable stays as it was"


def test_bounds_of_the_space_come_first_and_give_way_at_an_episodes_end_if_they_are_too_wide():
    space, observed = box([0.0, 0.0], [100.0, 1.0]), [[30.0, 0.2], [40.0, 0.9]]
    scales = FoundScales(space, None, NOT_PERIODIC)
    assert (scales.scaling.low.tolist(), scales.scaling.high.tolist()) == ([0.0, 0.0], [100.0, 1.0])
    note(scales, observed)
    assert scales.renewed(episode_ended=False) is None
    renewed = scales.renewed(episode_ended=True)
    assert (renewed.low.tolist(), renewed.high.tolist()) == ([30.0, 0.0], [40.0, 1.0])


@given(st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_bounds_are_too_wide_if_less_than_half_of_them_is_used(part, where):
    least = where * (1.0 - part)
    scales = after([[least, 0.0], [least + part, 1.0]], box([0.0, 0.0], [1.0, 1.0]))
    assert (scales.scaling.low[0] > 0.0 or scales.scaling.high[0] < 1.0) == (TOO_WIDE * ((least + part) - least) < 1.0)


def test_they_never_reach_beyond_the_space():
    scales = after([[0.1, -2.9], [0.4, 5.0]], box([0.0, -3.0], [100.0, 100.0]))
    assert scales.scaling.low.tolist() == [0.1, -3.0] and scales.scaling.high.tolist() == [0.4, 5.0]


def test_a_variable_that_never_changes_keeps_its_bounds_or_gets_some_around_it():
    assert after([[5.0, 5.0]] * 3, box([0.0, 0.0], [1000.0, 10.0])).scaling.high.tolist() == [1000.0, 10.0]
    scaling = after([[5.0, 0.0]] * 3).scaling
    assert scaling.low[0] < 5.0 < scaling.high[0] and (scaling.low[1], scaling.high[1]) == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("low", "high", "wanted"),
    [
        (-1.0, 1.6, (-1.6, 1.6)),
        (-5.0, 3.0, (-5.0, 5.0)),
        (-1.0, 9.0, (-1.0, 9.0)),
        (2.0, 3.0, (2.0, 3.0)),
        (-3.0, -2.0, (-3.0, -2.0)),
    ],
)
def test_zero_is_in_the_middle_of_bounds_that_reach_about_as_far_on_either_side(low, high, wanted):
    assert tuple(float(each[0]) for each in around_zero(np.array([low]), np.array([high]))) == wanted


@given(OBSERVATIONS, st.booleans())
def test_given_bounds_and_those_of_periodic_variables_stay(observations, given_bounds):
    if given_bounds:
        scales = after(observations, bounds=([-1.0, -2.0], [3.0, 4.0]))
        assert scales.fixed
    else:
        scales = after(observations, box([-1.0, -2.0], [3.0, 4.0]), periodic=np.array([True, True]))
    assert scales.scaling.low.tolist() == [-1.0, -2.0] and scales.scaling.high.tolist() == [3.0, 4.0]


@given(st.one_of(st.none(), OBSERVATIONS), OBSERVATIONS)
def test_they_come_back_from_their_state_and_go_on(before, later):
    scales = FoundScales(UNBOUNDED, None, NOT_PERIODIC) if before is None else after(before)
    state = scales.get_state()
    assert state.shape == (9,) and np.isfinite(state).all()
    restored = FoundScales(UNBOUNDED, None, NOT_PERIODIC)
    restored.set_state(state)
    for each in (scales, restored):
        note(each, later)
    assert restored.renewed(True) == scales.renewed(True) and restored.scaling == scales.scaling
    np.testing.assert_array_equal(restored.observed, scales.observed)


class Far(gym.Env):
    """A walk of growing steps on a line without ends."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = 0.0, 0
        return np.array([self.at, 0.0]), {}

    def step(self, action):
        self.steps += 1
        before = self.at
        self.at += (1.0 if action else -1.0) * self.steps
        return np.array([self.at, self.at - before]), -1.0, abs(self.at) > 300.0, self.steps >= 40, {}


@pytest.mark.filterwarnings("error")
def test_a_learner_follows_its_scales_and_keeps_its_transitions():
    model = FittedRMax(Far(), seed=0, resolution=3)
    assert model.policy.scales.scaling.high.tolist() == [1.0, 1.0]
    model.learn(200)
    scaling, agent = model.policy.scales.scaling, model.agent
    assert (scaling.high > 10.0).all() and agent.task.scaling == scaling
    transitions = agent.model.transitions()
    assert len(transitions) == 200
    for state, action, _, after_it, _ in transitions:
        (x, _), (y, step) = scaling.to_raw(state), scaling.to_raw(after_it)
        assert y - x == pytest.approx(step, abs=1e-9) and (step > 0.0) == (action == 1)
    units = np.array([state for state, *_ in transitions])
    assert units.min() > -BEYOND - 1e-9 and units.max() < 1.0 + BEYOND + 1e-9


def test_given_bounds_of_a_learner_stay():
    model = FittedRMax(Walk(), bounds=([-5.0, 0.0], [5.0, 2.0]), seed=0, resolution=3).learn(100)
    assert (model.policy.scales.scaling.low.tolist(), model.policy.scales.scaling.high.tolist()) == ([-5.0, 0.0], [5.0, 2.0])
    model = FittedRMax(Walk(), seed=0, resolution=3).learn(100)
    assert model.policy.scales.scaling.high.tolist() == [1.0, 2.0], "it uses most of its range"


@pytest.mark.filterwarnings("error")
def test_cart_pole_is_learned_from_without_any_argument():
    model = FittedRMax("CartPole-v1", seed=0).learn(150)
    assert model.agent.model.n_instances == 150 and np.isfinite(model.agent.planner.values).all()
    assert (model.policy.scales.scaling.high - model.policy.scales.scaling.low < 10.0).all()
    assert (model.agent.mdp.gamma, model.agent.planner.bounds[1]) == (0.99, pytest.approx(100.0))
