"""Source instances: recording, selection, files, Minari."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_combrel.sources.recording import SourceRecorder, TransitionLog
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.sources.subsets import covering_rows


class Corridor(gym.Env):
    """A cart that is pushed along [0, 1]: ends at 1, and is cut off after ``limit`` steps. The second variable counts."""

    observation_space = spaces.Box(np.float32([0, 0]), np.float32([1, 100]), dtype=np.float32)
    action_space = spaces.Discrete(2, start=-1)
    state_names = ("place", "time")
    action_names = ("back", "forth")

    def __init__(self, limit=6, step_size=0.25):
        self.limit = limit
        self.step_size = step_size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.integers(2) * 0.25, 0.0], dtype=np.float32)
        return self.state.copy(), {}

    def step(self, action):
        push = 1 if action == 0 else -1
        self.state = np.array([np.clip(self.state[0] + push * self.step_size, 0, 1), self.state[1] + 1], dtype=np.float32)
        goal = bool(self.state[0] >= 1)
        return self.state.copy(), -0.5 if push > 0 else -1.0, goal, not goal and self.state[1] >= self.limit, {}


def check_corridor(source, step_size=0.25):
    """Every transition, terminal and cut-off ones too, is one of the corridor's."""
    push = np.where(source.actions == 1, 1, -1)
    np.testing.assert_allclose(source.next_states[:, 0], np.clip(source.states[:, 0] + push * step_size, 0, 1), atol=1e-6)
    np.testing.assert_allclose(source.next_states[:, 1], source.states[:, 1] + 1)
    np.testing.assert_array_equal(source.rewards, np.where(push > 0, -0.5, -1.0))
    # VecNormalize gives the last state of an episode normalised only; undoing that is exact up to rounding.
    np.testing.assert_array_equal(source.terminated, source.next_states[:, 0] > 1 - 1e-6)


def some_source(n=40, seed=0):
    rng = np.random.default_rng(seed)
    return SourceInstances(
        rng.random((n, 2)),
        rng.integers(3, size=n),
        -np.ones(n),
        rng.random((n, 2)),
        np.arange(n) % 10 == 9,
        np.zeros(2),
        np.ones(2),
        3,
        ("x", "v"),
        ("Neutral", "Left", "Right"),
        {"env": "Some-v0", "seed": seed},
    )


def assert_same(one, other):
    for name in ("states", "actions", "rewards", "next_states", "terminated", "low", "high"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(one, name).dtype == getattr(other, name).dtype
    assert (one.n_actions, one.state_names, one.action_names) == (other.n_actions, other.state_names, other.action_names)
    assert one.origin == other.origin


def arguments(**changes):
    source = some_source(4)
    names = ("states", "actions", "rewards", "next_states", "terminated", "low", "high", "n_actions")
    return {**{name: getattr(source, name) for name in names}, **changes}


class TestSourceInstances:
    def test_names_have_defaults_and_arrays_are_fixed(self):
        source = SourceInstances(**arguments())
        assert source.state_names == ("s0", "s1")
        assert source.action_names == ("a0", "a1", "a2")
        assert (len(source), source.n_variables) == (4, 2)
        np.testing.assert_array_equal(source.scaling.to_unit(source.states), source.states)
        with pytest.raises(ValueError, match="read-only"):
            source.states[0] = 0
        assert "4 source instances of an unnamed task" in repr(source)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"states": np.zeros((0, 2)), "actions": []}, "at least one instance"),
            ({"states": np.full((4, 2), np.nan)}, "states must be finite, .* instance 0"),
            ({"next_states": np.zeros((4, 3))}, r"next_states must have the shape \(4, 2\), got \(4, 3\)"),
            ({"rewards": np.array([0, 0, np.inf, 0])}, "rewards must be finite, got inf for instance 2"),
            ({"actions": np.array([0, 1, 2, 3])}, "n_actions - 1 = 2, got 0 to 3"),
            ({"actions": np.zeros(4)}, "actions must be integers"),
            ({"terminated": np.zeros(4)}, "terminated must be booleans"),
            ({"low": np.ones(2)}, "below its upper bound"),
            ({"state_names": ("x",)}, "state_names must hold 2 names"),
            ({"action_names": ("x",)}, "action_names must hold 3 names"),
            ({"origin": {"env": object()}}, "origin must be a dict that JSON can hold"),
        ],
    )
    def test_wrong_arguments_are_named(self, changes, message):
        with pytest.raises(ValueError, match=message):
            SourceInstances(**arguments(**changes))

    def test_the_task_of_a_source_can_be_checked(self):
        source = SourceInstances.record(None, "MountainCar-v0", 5, seed=0)
        task = gym.make("MountainCar-v0")
        source.check_spaces(task.observation_space, task.action_space)
        with pytest.raises(ValueError, match="record them in this task"):
            source.check_spaces(Corridor.observation_space, Corridor.action_space)
        with pytest.raises(ValueError, match=r"states between \[-1.2"):
            source.check_spaces(spaces.Box(0, 1, (2,)), task.action_space)
        with pytest.raises(ValueError, match="action space must be Discrete"):
            source.check_spaces(task.observation_space, spaces.Box(0, 1, (1,)))


class TestSubset:
    @pytest.mark.parametrize("method", ["random", "covering"])
    @settings(max_examples=25, deadline=None)
    @given(n=st.integers(1, 60), seed=st.integers(0, 5))
    def test_a_subset_holds_different_instances_in_order_and_a_terminal_one(self, method, n, seed):
        source = some_source(40)
        subset = source.subset(n, method, seed)
        rows = [int(np.flatnonzero((source.states == state).all(axis=1))[0]) for state in subset.states]
        assert rows == sorted(set(rows))
        assert len(rows) == min(n, 40)
        np.testing.assert_array_equal(subset.rewards, source.rewards[rows])
        np.testing.assert_array_equal(subset.next_states, source.next_states[rows])
        assert subset.terminated.any()
        assert_same(subset, source.subset(n, method, seed))
        assert subset.origin["subset"] == {"method": method, "seed": seed, "chosen_from": 40}

    def test_a_covering_subset_is_never_farther_than_twice_the_best(self):
        # Farthest-point selection leaves no state farther than the least distance between two selected ones.
        rng = np.random.default_rng(3)
        points = rng.random((300, 2))
        rows = covering_rows(points, np.zeros(300, dtype=int), np.zeros(300, dtype=bool), 20, rng)
        distance = np.linalg.norm(points[:, None] - points[rows], axis=2)
        between = distance[rows]
        assert distance.min(axis=1).max() <= between[~np.eye(20, dtype=bool)].min()

    def test_a_covering_subset_shares_equally_among_actions(self):
        actions = np.repeat([0, 1, 2], [100, 5, 195])
        points = np.random.default_rng(0).random((300, 2))
        rows = covering_rows(points, actions, np.zeros(300, dtype=bool), 65, np.random.default_rng(0))
        assert np.bincount(actions[rows]).tolist() == [30, 5, 30]

    def test_equal_states_are_not_chosen_twice(self):
        rows = covering_rows(np.zeros((9, 2)), np.zeros(9, dtype=int), np.zeros(9, dtype=bool), 7, np.random.default_rng(0))
        assert len(set(rows.tolist())) == 7

    def test_wrong_arguments_are_named(self):
        with pytest.raises(ValueError, match="method must be 'random' or 'covering', got 'best'"):
            some_source().subset(3, "best")
        with pytest.raises(ValueError, match="n_instances must be at least 1, got 0"):
            some_source().subset(0)


class TestFiles:
    @pytest.mark.parametrize("name", ["source.npz", "source", "source.v2"])
    def test_saving_and_loading_changes_nothing(self, tmp_path, name):
        source = some_source()
        written = source.save(tmp_path / "new folder" / name)
        assert written.suffix == ".npz"
        assert_same(SourceInstances.load(tmp_path / "new folder" / name), source)
        assert_same(SourceInstances.load(written), source)
        # Nothing else is left in the folder.
        assert list(written.parent.iterdir()) == [written]

    def test_a_failed_save_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = some_source().save(tmp_path / "source")
        monkeypatch.setattr(np, "savez_compressed", lambda *args, **kwargs: (_ for _ in ()).throw(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            some_source(3, seed=1).save(path)
        assert_same(SourceInstances.load(path), some_source())
        assert list(tmp_path.iterdir()) == [path]

    def test_a_missing_file_is_said_to_be_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"no source file .*nowhere\.npz"):
            SourceInstances.load(tmp_path / "nowhere")

    @pytest.mark.parametrize("kept", [0.0, 0.3, 0.99])
    def test_a_truncated_file_is_reported(self, tmp_path, kept):
        path = some_source().save(tmp_path / "source")
        content = path.read_bytes()
        path.write_bytes(content[: int(kept * len(content))])
        with pytest.raises(ValueError, match=r"source\.npz is damaged or not a file of source instances"):
            SourceInstances.load(path)

    def test_no_damage_escapes_as_another_error(self, tmp_path):
        path = some_source(5).save(tmp_path / "source")
        content = path.read_bytes()
        rng = np.random.default_rng(0)
        refused = 0
        for _ in range(300):
            damaged = bytearray(content)
            for place in rng.integers(len(content), size=2):
                damaged[place] = rng.integers(256)
            path.write_bytes(damaged)
            try:
                SourceInstances.load(path)
            except ValueError as error:
                refused += 1
                assert "damaged" in str(error)
        assert refused > 100

    @pytest.mark.parametrize(
        "content",
        [
            {"a": np.zeros(3)},
            {"header": np.array("not json")},
            {"header": np.array('{"format": "other"}')},
            {"header": np.array('{"format": "sb3_combrel.SourceInstances", "version": 99}')},
            {"header": np.array('["a list"]')},
            {"header": np.array([{"pickled": "object"}], dtype=object)},
        ],
    )
    def test_foreign_archives_are_reported(self, tmp_path, content):
        np.savez(tmp_path / "foreign.npz", **content)
        with pytest.raises(ValueError, match="not a file of source instances"):
            SourceInstances.load(tmp_path / "foreign")

    def test_pickles_and_single_arrays_are_reported(self, tmp_path):
        np.save(tmp_path / "array.npy", np.zeros(3))
        th.save({"a": 1}, tmp_path / "model.npz")
        for name in ("array.npy", "model.npz"):
            with pytest.raises(ValueError, match="not a file of source instances"):
                SourceInstances.load(tmp_path / name)

    def test_a_file_with_impossible_contents_is_reported(self, tmp_path):
        path = some_source().save(tmp_path / "source")
        with np.load(path) as archive:
            arrays = dict(archive)
        np.savez(path, **{**arrays, "rewards": np.full(40, np.nan)})
        with pytest.raises(ValueError, match=r"damaged .*rewards must be finite"):
            SourceInstances.load(path)


class TestRecord:
    def test_random_actions_terminal_and_cut_off_transitions(self):
        source = SourceInstances.record(None, Corridor(), n_instances=300, seed=1)
        assert len(source) == 300
        check_corridor(source)
        assert source.terminated.any()
        # Cut off at the limit: neither terminal nor joined to the first state of the next episode.
        assert ((source.next_states[:, 1] == 6) & ~source.terminated).any()
        assert source.state_names == ("place", "time")
        assert source.action_names == ("back", "forth")
        assert set(source.actions.tolist()) == {0, 1}

    def test_the_seed_decides_everything(self):
        one, same, other = (SourceInstances.record(None, "MountainCar-v0", 30, seed=seed) for seed in (0, 0, 1))
        assert_same(one, same)
        assert not np.array_equal(one.states, other.states)
        assert one.origin["env"] == "MountainCar-v0"
        assert one.origin["recorder"] == "random actions"
        assert one.origin["seed"] == 0

    def test_a_function_of_the_state(self):
        source = SourceInstances.record(lambda state: 0 if state[0] < 0.6 else -1, Corridor(), 50, seed=0)
        check_corridor(source)
        np.testing.assert_array_equal(source.actions, np.where(source.states[:, 0] < 0.6, 1, 0))

    @pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
    def test_vectorised_environments(self, vec_env):
        env = vec_env([lambda: Monitor(Corridor()), lambda: Monitor(Corridor(limit=4)), lambda: Monitor(Corridor())])
        try:
            source = SourceInstances.record(None, env, 100, seed=0)
            # It is the user's environment: still open.
            env.reset()
        finally:
            env.close()
        assert len(source) == 100
        check_corridor(source)
        assert source.terminated.any()
        assert source.action_names == ("back", "forth")

    def test_an_sb3_model_and_no_trace_on_global_generators(self):
        model = DQN("MlpPolicy", "MountainCar-v0", seed=0, exploration_initial_eps=0.5)
        np.random.seed(5)
        th.manual_seed(5)
        before = np.random.get_state()[1].copy(), th.get_rng_state()
        one = SourceInstances.record(model, "MountainCar-v0", 250, seed=3)
        assert np.array_equal(before[0], np.random.get_state()[1])
        assert th.equal(before[1], th.get_rng_state())
        assert_same(one, SourceInstances.record(model, "MountainCar-v0", 250, seed=3))
        # 200 steps make an episode: the cut-off is no terminal state, and the next episode begins anew.
        assert not one.terminated.any()
        assert (one.next_states[:199] == one.states[1:200]).all()
        assert (one.next_states[199] != one.states[200]).any()
        greedy = SourceInstances.record(model, "MountainCar-v0", 50, seed=3, deterministic=True)
        np.testing.assert_array_equal(greedy.actions, model.predict(greedy.states.astype(np.float32), deterministic=True)[0])
        assert greedy.origin["recorder"] == "DQN"

    def test_normalised_environments_give_original_states_and_rewards(self):
        env = VecNormalize(DummyVecEnv([Corridor]))
        model = SeesNormalised(env)
        source = SourceInstances.record(model, env, 200, seed=0)
        check_corridor(source)
        assert model.saw_negative

    def test_unbounded_spaces_need_bounds(self):
        with pytest.raises(ValueError, match="bounds"):
            SourceInstances.record(None, "CartPole-v1", 10)
        source = SourceInstances.record(None, "CartPole-v1", 60, seed=0, bounds=(-5, 5))
        assert source.low.tolist() == [-5] * 4
        assert source.terminated.any()

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((None, "Pendulum-v1"), "action space must be Discrete"),
            ((None, "FrozenLake-v1"), "must be a one-dimensional Box"),
            ((None, "MountainCar-v0", 0), "n_instances must be at least 1, got 0"),
            (("ppo", "MountainCar-v0"), "model must be an SB3 model or policy, .* got 'ppo'"),
        ],
    )
    def test_wrong_arguments_are_named(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            SourceInstances.record(*arguments)


class SeesNormalised:
    """Random actions; remembers whether what it sees is normalised (the corridor's states are never negative)."""

    def __init__(self, env):
        self.action_space = env.action_space
        self.saw_negative = False

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.saw_negative |= bool((observation < 0).any())
        return np.array([self.action_space.sample() for _ in observation]), state


class OneAction(gym.ActionWrapper):
    """DQN and PPO want actions from 0 on."""

    action_space = spaces.Discrete(2)

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
        assert source.terminated.any()
        assert source.origin["recorder"] == algorithm
        model.learn(64, callback=recorder, reset_num_timesteps=False)
        assert len(recorder.source_instances()) == 192
        check_corridor(recorder.source_instances())

    def test_bounded_memory_keeps_a_sample_of_all(self):
        env = DummyVecEnv([lambda: OneAction(Corridor())])
        recorder = SourceRecorder(max_instances=20, seed=0)
        PPO("MlpPolicy", env, n_steps=128, n_epochs=1, seed=0).learn(256, callback=recorder)
        source = recorder.source_instances()
        assert len(source) == len(recorder.log) == 20
        assert source.origin["n_seen"] == 256
        check_corridor(source)

    def test_the_sample_is_uniform(self):
        counts = np.zeros(30)
        for seed in range(400):
            log = TransitionLog(10, seed)
            for i in range(30):
                log.add(np.array([float(i)]), 0, 0.0, np.array([0.0]), False)
            kept = [int(row[1][0]) for row in log._rows]
            counts[kept] += 1
        # 400 draws of probability 1/3: 5 standard deviations are 47.
        assert abs(counts - 400 / 3).max() < 47

    def test_a_recorder_that_saw_nothing_says_so(self):
        with pytest.raises(ValueError, match="nothing has been recorded"):
            SourceRecorder().source_instances()

    def test_unbounded_spaces_are_refused_at_once(self):
        with pytest.raises(ValueError, match="bounds"):
            PPO("MlpPolicy", "CartPole-v1").learn(100, callback=SourceRecorder())


class TestMinari:
    @pytest.fixture(autouse=True)
    def datasets(self, tmp_path, monkeypatch):
        pytest.importorskip("minari")
        pytest.importorskip("h5py")
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        return Path(tmp_path)

    def test_to_minari_and_back_changes_nothing(self):
        source = SourceInstances.record(None, Corridor(), 60, seed=0).subset(40, seed=0)
        dataset = source.to_minari("combrel/corridor-v0", author="someone")
        assert dataset.total_steps == 40
        assert_same(SourceInstances.from_minari("combrel/corridor-v0"), source)
        assert_same(SourceInstances.from_minari(dataset), source)
        assert len(SourceInstances.from_minari(dataset, n_instances=10, seed=0)) == 10

    def test_instances_that_follow_one_another_are_one_episode(self):
        source = SourceInstances.record(lambda state: 0, Corridor(step_size=0.125), 20, seed=0)
        episodes = list(source.to_minari("corridor-v0").iterate_episodes())
        lengths = [len(episode.actions) for episode in episodes]
        assert sum(lengths) == 20
        assert max(lengths) == 6
        assert all(bool(episode.terminations[-1]) != bool(episode.truncations[-1]) for episode in episodes)

    def test_a_missing_minari_is_named_with_its_remedy(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "minari", None)
        for call in (lambda: SourceInstances.from_minari("x-v0"), lambda: some_source().to_minari("x-v0")):
            with pytest.raises(ImportError, match=r'pip install "sb3-combrel\[minari\]"'):
                call()
