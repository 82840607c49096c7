"""Angles in place of cosines and sines: the wrapper alone, in Gymnasium, in vectorised environments, and with Fitted R-Max."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3
from stable_baselines3.common.env_util import make_vec_env

from sb3_combrel import FittedRMax
from sb3_combrel.wrappers import AngleObservation


class Given(gym.Env):
    """Observations as they are given.

    :param low: of the observation space; ``high``: the same
    """

    action_space = gym.spaces.Discrete(2)

    def __init__(self, low=(-1.0,) * 5, high=(1.0,) * 5, dtype=np.float64):
        self.observation_space = gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
        self.next = np.zeros(len(low), dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.next, {}

    def step(self, action):
        return self.next, 0.0, False, False, {}


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.permutations(range(5)), st.integers(1, 2), st.lists(st.floats(-3.1, 3.1), min_size=5, max_size=5), st.booleans())
def test_each_angle_stands_where_its_cosine_was(order, n_pairs, values, single):
    pairs = [(order[2 * p], order[2 * p + 1]) for p in range(n_pairs)]
    env, state = Given(dtype=np.float32 if single else np.float64), dict(enumerate(values))
    for cos, sin in pairs:
        env.next[cos], env.next[sin] = np.cos(state[cos]), np.sin(state[cos])
    for k in order[2 * n_pairs :]:
        env.next[k] = np.sin(state[k])
    wrapper = AngleObservation(env, pairs)
    sines, cosines = {sin for _, sin in pairs}, {cos for cos, _ in pairs}
    kept = [k for k in range(5) if k not in sines]
    expected = [state[k] if k in cosines else np.sin(state[k]) for k in kept]
    obs, _ = wrapper.reset()
    np.testing.assert_allclose(obs, expected, atol=1e-6)
    np.testing.assert_allclose(wrapper.step(0)[0], expected, atol=1e-6)
    assert wrapper.periodic == tuple(k in cosines for k in kept)
    assert wrapper.state_names == tuple(f"angle_s{k}" if k in cosines else f"s{k}" for k in kept)
    box = wrapper.observation_space
    assert obs.dtype == box.dtype == env.next.dtype and box.contains(obs)
    np.testing.assert_allclose(box.high, [np.pi if k in cosines else 1.0 for k in kept])


@pytest.mark.parametrize(
    ("env_id", "names", "periodic"),
    [
        ("Acrobot-v1", ("theta1", "theta2", "theta1_dot", "theta2_dot"), (True, True, False, False)),
        ("Pendulum-v1", ("theta", "theta_dot"), (True, False)),
    ],
)
def test_the_layouts_of_acrobot_and_pendulum_are_known(env_id, names, periodic):
    env = AngleObservation(gym.make(env_id))
    assert env.state_names == names and env.periodic == periodic
    env.reset(seed=0)
    for _ in range(100):
        obs, *_ = env.step(env.action_space.sample())
        state = env.unwrapped.state
        np.testing.assert_allclose(np.cos(obs[: sum(periodic)]), np.cos(state[: sum(periodic)]), atol=1e-5)
        np.testing.assert_allclose(np.sin(obs[: sum(periodic)]), np.sin(state[: sum(periodic)]), atol=1e-5)
        np.testing.assert_allclose(obs[sum(periodic) :], state[sum(periodic) :], atol=1e-5)


@pytest.mark.parametrize("env_id", ["Acrobot-v1", "Pendulum-v1"])
@pytest.mark.filterwarnings("ignore:.*render:UserWarning")
def test_the_checkers_find_nothing(env_id):
    check_env(AngleObservation(gym.make(env_id, disable_env_checker=True)), skip_render_check=True)
    check_env_of_sb3(AngleObservation(gym.make(env_id)))


def test_names_and_flags_of_the_environment_are_kept():
    env = Given()
    env.state_names, env.periodic = ("a", "b", "c", "d", "e"), (False, False, True, False, False)
    wrapper = AngleObservation(env, [[3, 1]])
    assert wrapper.state_names == ("a", "c", "angle_d", "e") and wrapper.periodic == (False, True, True, False)


def test_other_pairs_of_a_known_environment_have_other_names():
    assert AngleObservation(gym.make("Acrobot-v1"), [(2, 3)]).state_names == ("s0", "s1", "angle_s2", "s4", "s5")
    assert AngleObservation(gym.make("Acrobot-v1"), [[2, 3], [0, 1]]).state_names[0] == "theta1"


def test_the_wrapper_is_made_again_from_its_specification_and_pickled():
    env = AngleObservation(gym.make("Acrobot-v1"), [(0, 1)])
    again = gym.make(env.spec)
    assert again.observation_space == env.observation_space and again.get_wrapper_attr("periodic") == env.periodic
    assert pickle.loads(pickle.dumps(AngleObservation(Given(), [(0, 1)]))).periodic == (True, False, False, False)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        *[(None, "not known"), ([], r"got \[\]"), ([(0, 0)], r"got \[\(0, 0\)\]")],
        *[([(0, 1), (1, 2)], "each index once"), ([(0, 5)], "whole number from 0 to 4, got 5"), ([(0, -1)], "got -1")],
        *[([(0, 1.0)], "got 1.0"), ([0, 1], r"got \[0, 1\]"), ("01", "got '01'")],
        *[([(0, 1, 2)], r"got \[\(0, 1, 2\)\]"), ([(0, 2)], "variable 2 is from -8 to 8")],
    ],
)
def test_wrong_pairs_are_named(pairs, message):
    high = np.array([1.0, 1.0, 8.0, np.inf, np.inf])
    with pytest.raises(ValueError, match=message) as caught:
        AngleObservation(Given(-high, high), pairs)
    assert str(caught.value).startswith("pairs")


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "Blackjack-v1"])
def test_other_observation_spaces_are_refused(env_id):
    with pytest.raises(ValueError, match="env must have observations in a one-dimensional Box"):
        AngleObservation(gym.make(env_id), [(0, 1)])


def test_an_unbounded_cosine_is_accepted():
    env = AngleObservation(Given((-np.inf,) * 5, (np.inf,) * 5), [(0, 1)])
    np.testing.assert_allclose(env.observation_space.high, [np.pi] + [np.inf] * 3, rtol=1e-6)


def test_fitted_rmax_needs_no_argument_for_a_wrapped_environment():
    env = make_vec_env("Acrobot-v1", n_envs=2, seed=0, wrapper_class=AngleObservation)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = FittedRMax(env, seed=0, resolution=2, model_breadth=0.5, gamma=0.99).learn(60)
    assert model.agent.periodic == (True, True, False, False)
    assert model.agent.task.state_names == ("theta1", "theta2", "theta1_dot", "theta2_dot")
    assert model.agent.grid.arrays.shape.tolist() == [4, 4, 5, 5]


def test_what_are_no_cosines_and_sines_any_more_is_refused():
    rescaled = gym.wrappers.RescaleObservation(gym.make("Acrobot-v1"), np.float32(0.0), np.float32(1.0))
    with pytest.raises(ValueError, match="for this environment they are not known"):
        AngleObservation(rescaled)
    with pytest.raises(ValueError, match=r"must add up to 1, got \[1.2.* for pairs=\[\(0, 1\)\]: wrap the env.* before"):
        AngleObservation(rescaled, pairs=[(0, 1)]).reset(seed=0)


def test_observations_may_be_lists_and_whole_numbers():
    env = Given((-1.0,) * 2, (1.0,) * 2, np.float32)
    wrapped = AngleObservation(env, pairs=[(0, 1)])
    for env.next in ([0, 1], np.array([0, 1])):
        found, _ = wrapped.reset()
        assert found.dtype == np.float32 and found == pytest.approx([np.pi / 2])
