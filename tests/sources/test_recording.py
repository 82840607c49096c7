"""Recording source instances with a behaviour, and while an SB3 algorithm learns."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from helpers.sources import Corridor, assert_same, check_corridor
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_combrel import SourceInstances
from sb3_combrel.sources.source_recorder import SourceRecorder
from sb3_combrel.sources.transitions import TransitionLog


class TestRecord:
    def test_random_actions_are_recorded_with_terminal_and_cut_off_transitions(self):
        source = SourceInstances.record(None, Corridor(), n_instances=300, seed=1)
        assert len(source) == 300
        check_corridor(source)
        assert source.terminated.any()
        # Cut off at the limit: neither terminal nor joined to the first state of the next episode.
        assert ((source.next_states[:, 1] == 6) & ~source.terminated).any() and source.state_names == ("place", "time")
        assert source.action_names == ("back", "forth") and set(source.actions.tolist()) == {0, 1}

    def test_the_seed_decides_everything(self):
        one, same, other = (SourceInstances.record(None, "MountainCar-v0", 30, seed=seed) for seed in (0, 0, 1))
        assert_same(one, same)
        assert not np.array_equal(one.states, other.states) and one.origin["env"] == "MountainCar-v0"
        assert one.origin["recorder"] == "random actions" and one.origin["seed"] == 0

    def test_a_function_of_the_state_is_recorded(self):
        source = SourceInstances.record(lambda state: 0 if state[0] < 0.6 else -1, Corridor(), 50, seed=0)
        check_corridor(source)
        np.testing.assert_array_equal(source.actions, np.where(source.states[:, 0] < 0.6, 1, 0))

    def test_an_action_may_be_an_array_of_one_number(self):
        plain = SourceInstances.record(lambda state: 0, Corridor(), 20, seed=0)
        for made in (np.array([0]), np.float32(0.0), [0], np.array([[0]])):
            assert_same(SourceInstances.record(lambda state, made=made: made, Corridor(), 20, seed=0), plain)

    @pytest.mark.parametrize("answer", [0.5, -2, 1, np.nan, None, "left", np.array([0, 0]), np.array([])])
    def test_what_is_no_action_is_refused_at_the_first_step(self, answer):
        seen = []
        with pytest.raises(ValueError, match=r"model must return a whole number from -1 to 0, got .*number of the nearest"):
            SourceInstances.record(lambda state: (seen.append(state), answer)[1], Corridor(), 20, seed=0)
        assert len(seen) == 1

    def test_a_model_with_continuous_actions_is_refused_at_the_first_step(self):
        model = PPO("MlpPolicy", "Pendulum-v1", seed=0, n_steps=8, batch_size=8)
        pendulum = gym.wrappers.DiscretizeAction(gym.make("Pendulum-v1"), bins=5)
        with pytest.raises(ValueError, match=r"model must return a whole number from 0 to 4, got .*number of the nearest"):
            SourceInstances.record(model, pendulum, 20, seed=0)

    @pytest.mark.parametrize("vec_env", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.long)])
    def test_vectorised_environments_are_recorded_and_left_open(self, vec_env):
        env = vec_env([lambda: Monitor(Corridor()), lambda: Monitor(Corridor(limit=4)), lambda: Monitor(Corridor())])
        try:
            source = SourceInstances.record(None, env, 100, seed=0)
            # It is the user's environment: still open.
            env.reset()
        finally:
            env.close()
        assert len(source) == 100
        check_corridor(source)
        assert source.terminated.any() and source.action_names == ("back", "forth")

    def test_an_sb3_model_is_recorded_without_a_trace_on_global_generators(self):
        model = DQN("MlpPolicy", "MountainCar-v0", seed=0, exploration_initial_eps=0.5)
        np.random.seed(5)
        th.manual_seed(5)
        before = np.random.get_state()[1].copy(), th.get_rng_state()
        one = SourceInstances.record(model, "MountainCar-v0", 250, seed=3)
        assert np.array_equal(before[0], np.random.get_state()[1]) and th.equal(before[1], th.get_rng_state())
        assert_same(one, SourceInstances.record(model, "MountainCar-v0", 250, seed=3))
        # 200 steps make an episode: the cut-off is no terminal state, and the next episode begins anew.
        assert not one.terminated.any() and (one.next_states[:199] == one.states[1:200]).all()
        assert (one.next_states[199] != one.states[200]).any()
        greedy = SourceInstances.record(model, "MountainCar-v0", 50, seed=3, deterministic=True)
        np.testing.assert_array_equal(greedy.actions, model.predict(greedy.states.astype(np.float32), deterministic=True)[0])
        assert greedy.origin["recorder"] == "DQN"

    def test_normalised_environments_give_original_states_and_rewards(self):
        env, seen = VecNormalize(DummyVecEnv([Corridor])), []

        class Remembers:
            action_space = env.action_space

            def predict(self, observation, state=None, episode_start=None, deterministic=False):
                seen.append(observation.min())
                return np.array([self.action_space.sample() for _ in observation]), state

        check_corridor(SourceInstances.record(Remembers(), env, 200, seed=0))
        # The corridor's states are never negative.
        assert min(seen) < 0

    def test_bounds_of_unbounded_variables_are_found_and_others_stay(self):
        source = SourceInstances.record(None, "CartPole-v1", 200, seed=0)
        both = np.concatenate([source.states, source.next_states])
        box = gym.make("CartPole-v1").observation_space
        for k, unbounded in enumerate((False, True, False, True)):
            if unbounded:
                far = np.abs(both[:, k]).max()
                assert (source.low[k], source.high[k]) == (-far, far)
            else:
                assert (source.low[k], source.high[k]) == (box.low[k], box.high[k])
        source = SourceInstances.record(None, "CartPole-v1", 60, seed=0, bounds=(-5, 5))
        assert source.low.tolist() == [-5] * 4 and source.terminated.any()

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((None, "Pendulum-v1"), "action space must be Discrete"),
            ((None, "FrozenLake-v1"), "must be a one-dimensional Box"),
            (("ppo", "MountainCar-v0"), "model must be an SB3 model or policy, .* got 'ppo'"),
        ],
    )
    def test_wrong_arguments_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            SourceInstances.record(*arguments)


class OneAction(gym.ActionWrapper):
    """DQN and PPO want actions from 0 on."""

    action_space = gym.spaces.Discrete(2)

    def action(self, action):
        return int(action) - 1


class TestSourceRecorder:
    @pytest.mark.parametrize("normalised", [False, True])
    @pytest.mark.parametrize("algorithm", ["DQN", "PPO"])
    def test_everything_that_is_learned_from_is_recorded(self, algorithm, normalised):
        env = DummyVecEnv([lambda: Monitor(OneAction(Corridor())) for _ in range(2)])
        env = VecNormalize(env) if normalised else env
        model = PPO("MlpPolicy", env, n_steps=32, n_epochs=1, seed=0) if algorithm == "PPO" else DQN("MlpPolicy", env, seed=0)
        recorder = SourceRecorder()
        # The evaluation environment's steps must not be recorded.
        evaluation = EvalCallback(Monitor(OneAction(Corridor())), eval_freq=20, verbose=0, warn=False)
        model.learn(128, callback=[recorder, evaluation] if not normalised else recorder)
        source = recorder.source_instances()
        assert len(source) == 128
        check_corridor(source)
        assert source.terminated.any() and source.origin["recorder"] == algorithm
        model.learn(64, callback=recorder, reset_num_timesteps=False)
        assert len(recorder.source_instances()) == 192
        check_corridor(recorder.source_instances())

    def test_bounded_memory_keeps_a_sample_of_all(self):
        env = DummyVecEnv([lambda: OneAction(Corridor())])
        recorder = SourceRecorder(max_instances=20, seed=0)
        PPO("MlpPolicy", env, n_steps=128, n_epochs=1, seed=0).learn(256, callback=recorder)
        source = recorder.source_instances()
        assert len(source) == len(recorder.log) == 20 and source.origin["n_seen"] == 256
        check_corridor(source)

    def test_the_sample_of_a_bounded_log_is_uniform(self):
        counts = np.zeros(30)
        for seed in range(400):
            log = TransitionLog(10, seed)
            for i in range(30):
                log.add(np.array([float(i)]), 0, 0.0, np.array([0.0]), False)
            kept = log.transitions((np.array([0.0]), np.array([30.0])), 1, {}, {}).states[:, 0].astype(int)
            counts[kept] += 1
        # 400 draws of probability 1/3: 5 standard deviations are 47.
        assert abs(counts - 400 / 3).max() < 47

    def test_other_spaces_are_refused_at_once_and_an_empty_recorder_says_so(self):
        recorder = SourceRecorder()
        with pytest.raises(ValueError, match="Discrete"):
            PPO("MlpPolicy", "Pendulum-v1").learn(100, callback=recorder)
        with pytest.raises(ValueError, match="nothing has been recorded"):
            recorder.source_instances()


class Renamed(gym.Wrapper):
    """Has names that do not fit it, as wrappers do that add a variable."""

    def __init__(self, env, names):
        super().__init__(env)
        self.state_names = names


@pytest.mark.parametrize("names", [("place",), "ab", lambda: ["place", "time"], {0: "place", 1: "time"}])
def test_names_that_do_not_fit_are_warned_of_and_ignored(names):
    with pytest.warns(UserWarning, match="state_names=.* is not one str for each of the 2 variables, and is ignored"):
        source = SourceInstances.record(None, Renamed(Corridor(), names), 50, 0)
    assert source.state_names == ("s0", "s1") and source.action_names == ("back", "forth")
    recorder = SourceRecorder()
    with pytest.warns(UserWarning, match="is ignored"):
        DQN("MlpPolicy", DummyVecEnv([lambda: Renamed(Corridor(), names)]), device="cpu").learn(60, callback=recorder)
    assert recorder.source_instances().state_names == ("s0", "s1")
