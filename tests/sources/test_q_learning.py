"""The Q-learner that makes source instances."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.sources.q_learning import QLearning, TileCoding
from sb3_combrel.sources.source_instances import SourceInstances

MOUNTAIN_CAR = "combrel/MountainCar2D-v0"


class Chain(gym.Env):
    """Three places in a row; from each, action 0 ends the episode with -4 and action 1 goes on for -1, at last for +0."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = gym.spaces.Discrete(2, start=3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return np.array([0.0]), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.place += 1
        if action == 3:
            return np.array([self.place / 3]), -4.0, True, False, {}
        return np.array([self.place / 3]), -1.0, self.place == 3, False, {}


class TestTileCoding:
    @settings(max_examples=50)
    @given(st.lists(st.floats(-0.5, 1.5), min_size=2, max_size=2), st.integers(1, 9), st.integers(1, 9))
    def test_a_state_lies_in_one_tile_of_each_grid(self, state, n_tilings, n_tiles):
        coding = TileCoding(2, n_tilings, n_tiles)
        tiles = coding.tiles(np.array(state))
        assert (tiles // (n_tiles + 1) ** 2).tolist() == list(range(n_tilings)) and tiles.max() < coding.n_features

    @settings(max_examples=50)
    @given(st.lists(st.floats(0, 1), min_size=4, max_size=4))
    def test_near_states_share_tiles_and_far_states_do_not(self, numbers):
        coding = TileCoding(2, n_tilings=8, n_tiles=4)
        one, other = np.array(numbers[:2]), np.array(numbers[2:])
        shared = np.count_nonzero(coding.tiles(one) == coding.tiles(other))
        if np.abs(one - other).max() > 0.25:
            assert shared == 0
        if np.abs(one - other).max() < 1 / 32:
            # A step of one shift crosses at most one border along each variable.
            assert shared >= 6


class TestQLearning:
    @pytest.mark.parametrize("trace_decay", [0.0, 0.9])
    def test_the_values_of_a_chain(self, trace_decay):
        # One tile for each place, so that the values are exact: -3, -2, -1 to go on, -4 to give up.
        learner = QLearning(Chain(), n_tilings=1, n_tiles=3, epsilon=0.3, trace_decay=trace_decay, seed=0).learn(3000)
        np.testing.assert_allclose(learner.weights[:3], [[-4, -3], [-4, -2], [-4, -1]], atol=1e-3)
        assert learner.predict(np.array([0.0]), deterministic=True) == (4, None)
        assert learner.predict(np.array([[0.1], [0.9]]), deterministic=True)[0].tolist() == [4, 4]

    @pytest.mark.parametrize(("gamma", "trace_decay"), [(1.0, 0.9), (0.9, 0.5)])
    def test_values_are_those_of_traces_of_all_tiles(self, gamma, trace_decay):
        learner, steps = QLearning("MountainCar-v0", gamma=gamma, trace_decay=trace_decay, epsilon=0.2, seed=0), []
        learner.learn(700, lambda *step: steps.append(step))
        weights, traces, arrived = np.zeros_like(learner.weights), np.zeros_like(learner.weights), None
        for state, action, reward, following, terminated in steps:
            if arrived is None or not np.array_equal(state, arrived):
                traces[:] = 0.0
            tiles, next_tiles = (learner.coding.tiles(learner.scaling.to_unit(each)) for each in (state, following))
            values = weights[tiles].sum(axis=0)
            if values[action] < values.max():
                traces[:] = 0.0
            best = 0.0 if terminated else weights[next_tiles].sum(axis=0).max()
            traces *= gamma * trace_decay
            traces[tiles] = 0.0
            traces[tiles, action] = 1.0
            weights += 0.3 / 8 * (reward + gamma * best - values[action]) * traces
            arrived = following
        assert len(learner.episode_lengths) > 2 and weights.any()
        np.testing.assert_array_equal(learner.weights, weights)

    def test_it_solves_mountain_car_and_its_experience_is_a_source(self):
        source = SourceInstances.from_q_learning(MOUNTAIN_CAR, n_instances=1000, seed=0, total_timesteps=10_000)
        assert len(source) == 1000 and source.state_names == ("x", "v")
        assert source.action_names == ("Neutral", "Left", "Right") and source.origin["env"] == MOUNTAIN_CAR
        assert source.origin["recorder"] == "QLearning"
        # Terminal instances are those that reach the goal.
        np.testing.assert_array_equal(source.terminated, source.next_states[:, 0] >= 0.5)
        assert source.terminated.any()
        # Section 5.1: it covers the state space. Most of the cells that a car can be in at all hold some instance.
        cells = set(map(tuple, np.floor(source.scaling.to_unit(source.states) * 8).clip(0, 7).astype(int)))
        assert len(cells) >= 40 and np.bincount(source.actions).min() > 100

    def test_the_greedy_policy_is_near_the_optimum_of_103_steps(self):
        learner = QLearning(MOUNTAIN_CAR, seed=1).learn(15_000)
        assert SourceInstances.record(learner, MOUNTAIN_CAR, 200, seed=5, deterministic=True).terminated.any()

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"epsilon": 2.0}, "epsilon must be between 0 and 1, got 2.0"),
            ({"learning_rate": -0.1}, "learning_rate must be between 0 and 1"),
            ({"n_tiles": 10_000}, "choose a smaller n_tiles"),
            ({"n_tiles": 0}, "n_tiles must be a whole number from 1 to 10,000,000, got 0"),
            ({"env": "Pendulum-v1"}, "action space must be Discrete"),
            ({"env": "CartPole-v1"}, "bounds"),
        ],
    )
    def test_wrong_arguments_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            QLearning(**{"env": "MountainCar-v0", **arguments})
