"""Fitted R-Max keeps to what Stable-Baselines3 promises of its algorithms."""

import inspect
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy


class Walk(gym.Env):
    """A walk on a line with a start drawn at random; the right end is the goal. ``first`` numbers the actions."""

    def __init__(self, first=0, limit=30):
        self.observation_space = spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 2.0]))
        self.action_space = spaces.Discrete(2, start=first)
        self.first, self.limit = first, limit
        self.seen = []

    def observe(self):
        observation = np.array([self.at, 1.0], dtype=np.float32)
        self.seen.append(observation)
        return observation

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = self.np_random.uniform(-0.6, 0.0), 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.at = float(np.clip(self.at + (0.15 if action == self.first + 1 else -0.15), -1.0, 1.0))
        done = self.at > 0.9
        return self.observe(), -1.0, done, self.steps >= self.limit and not done, {}


def small(env=None, **kwargs):
    return FittedRMax(Walk() if env is None else env, **dict(model_breadth=0.15, resolution=3, seed=0) | kwargs)


OBSERVATIONS = np.column_stack([np.linspace(-1.0, 1.0, 21), np.ones(21)]).astype(np.float32)


def same_parameters(one, other):
    one, other = one.get_parameters()["policy"], other.get_parameters()["policy"]
    return one.keys() == other.keys() and all(th.equal(one[k], other[k]) for k in one)


class Recorder(BaseCallback):
    """Keeps what the callback is shown; stops or interrupts at a given call."""

    def __init__(self, stop_at=None, interrupt_at=None):
        super().__init__()
        self.stop_at, self.interrupt_at = stop_at, interrupt_at
        self.started = self.ended = 0
        self.shown = []

    def _on_training_start(self):
        self.started += 1

    def _on_step(self):
        self.shown.append({k: self.locals[k] for k in ("new_obs", "actions", "rewards", "dones", "infos")})
        if self.n_calls == self.interrupt_at:
            raise KeyboardInterrupt
        return self.n_calls != self.stop_at

    def _on_training_end(self):
        self.ended += 1


# ------------------------------------------------------------------- construction


def test_learn_takes_what_every_algorithm_takes():
    ours, theirs = inspect.signature(FittedRMax.learn).parameters, inspect.signature(BaseAlgorithm.learn).parameters
    assert list(ours) == list(theirs)
    assert all(ours[name].default is not inspect.Parameter.empty for name in ours if name != "self")
    assert ours["tb_log_name"].default == "FittedRMax"


@pytest.mark.parametrize(
    "make",
    [
        lambda env: FittedRMax(env, seed=0),
        lambda env: FittedRMax("FittedRMaxPolicy", env, seed=0),
        lambda env: FittedRMax("MlpPolicy", env, seed=0),
        lambda env: FittedRMax(FittedRMaxPolicy, env, seed=0),
        lambda env: FittedRMax(env, "MlpPolicy", seed=0),
        lambda env: FittedRMax(env=env, seed=0),
        lambda env: FittedRMax(env=env, policy="MlpPolicy", seed=0),
    ],
)
def test_environment_and_policy_come_in_either_order(make):
    model = make(Walk())
    assert isinstance(model.policy, FittedRMaxPolicy)
    assert model.n_envs == 1
    model.learn(10)


def test_an_environment_can_be_named():
    for model in (FittedRMax("MountainCar-v0"), FittedRMax("MlpPolicy", "MountainCar-v0")):
        assert model.env.get_attr("spec")[0].id == "MountainCar-v0"


def test_unknown_policies_are_refused():
    with pytest.raises(ValueError, match="NoSuchPolicy"):
        FittedRMax("NoSuchPolicy", Walk())


def test_actions_may_start_anywhere():
    model = small(Walk(first=5)).learn(60)
    action, _ = model.predict(OBSERVATIONS[0], deterministic=True)
    assert model.action_space.contains(int(action))
    assert model.policy.model.instances.count.sum() == 60


# ---------------------------------------------------------------------- callbacks


def test_callbacks_are_shown_every_step_and_told_of_start_and_end():
    recorder = Recorder()
    model = small().learn(25, callback=recorder)
    assert (recorder.started, recorder.ended, recorder.n_calls) == (1, 1, 25)
    assert model.num_timesteps == 25
    for shown in recorder.shown:
        assert shown["new_obs"].shape == (1, 2)
        assert shown["actions"].shape == shown["rewards"].shape == shown["dones"].shape == (1,)
        assert len(shown["infos"]) == 1


def test_a_callback_can_stop_the_learning():
    recorder = Recorder(stop_at=7)
    model = small().learn(1000, callback=recorder)
    assert (model.num_timesteps, recorder.ended) == (7, 1)
    episodes = StopTrainingOnMaxEpisodes(3)
    model = small().learn(100_000, callback=episodes)
    assert model.num_timesteps < 100
    assert model._episode_num == 3, "the episode that ended with the stop counts"


def test_an_interrupt_ends_the_training_and_leaves_a_model_that_saves_and_goes_on(tmp_path):
    recorder = Recorder(interrupt_at=12)
    model = small()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=recorder)
    assert recorder.ended == 1
    assert model.policy.model.n_instances == 12
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert same_parameters(model, loaded)
    for resumed in (model, loaded):
        resumed.learn(20, reset_num_timesteps=False)
        assert resumed.num_timesteps == 32
        assert resumed.policy.model.n_instances == 32


def test_progress_bar_and_functions_as_callbacks():
    calls = []
    small().learn(10, callback=lambda local, _: calls.append(local["self"]) or True, progress_bar=True)
    assert len(calls) == 10


def test_evaluation_and_checkpoints_in_mid_episode_hold_all_that_was_learned_so_far(tmp_path):
    model = small()
    evaluation = EvalCallback(Monitor(Walk()), eval_freq=20, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(45, callback=[CheckpointCallback(7, str(tmp_path), "at"), evaluation])
    for steps in (7, 14, 42):
        assert FittedRMax.load(tmp_path / f"at_{steps}_steps").policy.model.n_instances == steps
    assert FittedRMax.load(tmp_path / "best_model").policy.model.n_instances in (20, 40)


def test_evaluate_policy():
    model = small().learn(200)
    mean, _ = evaluate_policy(model, Monitor(Walk()), n_eval_episodes=10)
    assert -11.0 <= mean <= -5.0


# ------------------------------------------------------------------ environments


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_several_environments_feed_one_model(vec_env):
    env = make_vec_env(Walk, n_envs=3, seed=0, vec_env_cls=vec_env)
    recorder = Recorder()
    try:
        model = small(env).learn(61, callback=recorder)
    finally:
        env.close()
    assert model.num_timesteps == 63
    assert model.policy.model.n_instances == 63
    assert recorder.shown[0]["new_obs"].shape == (3, 2)


def stored(model):
    """(state, next state, reward, terminated) of all instances, raw units, sorted."""
    instances, rows = model.policy.model.instances, []
    for action in range(2):
        n = instances.count[action]
        state, end = instances.state[action, :n], instances.state[action, :n] + instances.effect[action, :n]
        raw = model.policy.scaling.to_raw(state), model.policy.scaling.to_raw(end)
        rows.append(np.column_stack([*raw, instances.reward[action, :n], instances.terminated[action, :n]]))
    return np.vstack(rows)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_true_last_observation_is_stored_and_a_time_limit_is_not_terminal(n_envs):
    model = small(DummyVecEnv([lambda: Walk(limit=7)] * n_envs)).learn(300)
    rows = stored(model)
    # Every step moves by 0.15 or stays at the left end; the reset states that follow an episode are farther away.
    moved = np.abs(rows[:, 2] - rows[:, 0])
    assert ((np.abs(moved - 0.15) < 1e-6) | (np.abs(np.abs(rows[:, 2]) - 1.0) < 1e-6)).all()
    np.testing.assert_array_equal(rows[:, 5] > 0, rows[:, 2] > 0.9 - 1e-6)
    assert rows[:, 5].any(), "some episodes reached the goal"
    assert model._episode_num > rows[:, 5].sum(), "and some ran into the limit"


def test_monitor_files_see_every_episode(tmp_path):
    model = small(Monitor(Walk(), str(tmp_path / "monitor"))).learn(100)
    lines = (tmp_path / "monitor.monitor.csv").read_text().splitlines()
    assert len(lines) - 2 == model._episode_num > 0
    assert len(model.ep_info_buffer) == model._episode_num


def test_normalized_observations_are_refused_by_constructor_and_set_env():
    normalized = VecNormalize(DummyVecEnv([Walk]))
    with pytest.raises(ValueError, match="norm_obs"):
        small(normalized)
    model = small()
    with pytest.raises(ValueError, match="norm_obs"):
        model.set_env(normalized)
    assert model.get_env() is not normalized, "refused before anything was changed"
    model.learn(5)


def test_of_normalized_rewards_the_original_ones_are_stored():
    env = VecNormalize(VecMonitor(DummyVecEnv([Walk])), norm_obs=False, norm_reward=True)
    recorder = Recorder()
    model = small(env).learn(50, callback=recorder)
    assert (stored(model)[:, 4] == -1.0).all()
    assert any(shown["rewards"][0] != -1.0 for shown in recorder.shown), "the environment did normalize"
    model = small()
    model.set_env(VecNormalize(DummyVecEnv([Walk]), norm_obs=False))
    assert (stored(model.learn(50))[:, 4] == -1.0).all()


def test_set_env_goes_on_with_what_was_learned():
    model = small().learn(20)
    other = DummyVecEnv([Walk])
    model.set_env(other)
    assert model.get_env() is other
    model.learn(10)
    assert model.policy.model.n_instances == 30
    with pytest.raises(AssertionError):
        model.set_env(DummyVecEnv([Walk, Walk]))


# ------------------------------------------------------------------------- predict


@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_takes_one_observation_or_a_batch(deterministic):
    model = small().learn(100)
    one, state = model.predict(OBSERVATIONS[3], deterministic=deterministic)
    assert state is None
    assert np.shape(one) == () and one in (0, 1)
    batch, _ = model.predict(OBSERVATIONS, deterministic=deterministic)
    assert batch.shape == (21,) and set(batch) <= {0, 1}


def test_deterministic_predictions_do_not_change_and_draw_nothing():
    model = small().learn(40)
    chance = model._rng.bit_generator.state
    first, _ = model.predict(OBSERVATIONS, deterministic=True)
    for _ in range(3):
        np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], first)
    assert model._rng.bit_generator.state == chance


def test_predictions_leave_no_trace_in_the_model():
    model, before = small().learn(40), small().learn(40)
    model.predict(OBSERVATIONS, deterministic=True)
    model.predict(OBSERVATIONS, deterministic=False)
    assert same_parameters(model, before)


def test_what_was_learned_is_the_way_to_the_goal():
    model = small().learn(400)
    np.testing.assert_array_equal(model.predict(OBSERVATIONS[3:18], deterministic=True)[0], 1)


# ---------------------------------------------------------------------- save, load


def test_save_and_load_keep_everything(tmp_path):
    model = small(max_backups=3).learn(150)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert same_parameters(model, loaded)
    for name in ("min_fraction", "model_breadth", "resolution", "max_backups", "gamma", "max_value", "num_timesteps"):
        assert getattr(loaded, name) == getattr(model, name)
    np.testing.assert_array_equal(
        loaded.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )
    for observation in OBSERVATIONS:
        unit = model.policy.to_unit(observation)
        np.testing.assert_array_equal(loaded.policy.q_values(unit), model.policy.q_values(unit))
    for array in ("entry", "total", "known", "settled", "reward", "n_optimistic"):
        np.testing.assert_array_equal(getattr(loaded.policy.model.arrays, array), getattr(model.policy.model.arrays, array))
    loaded.learn(50, reset_num_timesteps=False)
    assert loaded.num_timesteps == 200
    assert loaded.policy.model.n_instances == 200


def test_pairs_that_are_known_by_history_alone_are_saved(tmp_path):
    model = small(min_fraction=0.6, model_breadth=0.5, resolution=1)
    for state, next_state in [(0.1, 0.2), (0.1, 0.2), (0.45, 0.95)]:
        model.policy.learn_from(np.array([state, 0.5]), 0, -1.0, np.array([next_state, 0.5]), False)
    arrays = model.policy.model.arrays
    assert (arrays.known & (arrays.total < 1.0)).any(), "the case that this test is about"
    model.save(tmp_path / "model")
    np.testing.assert_array_equal(FittedRMax.load(tmp_path / "model").policy.model.arrays.known, arrays.known)


def test_a_full_model_with_a_cap_on_instances_survives_saving(tmp_path):
    model = small(max_instances=10).learn(100)
    assert model.policy.model.n_instances <= 20
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk()).learn(100)
    assert loaded.policy.model.n_instances <= 20


def test_a_saved_model_can_be_loaded_for_more_environments(tmp_path):
    small().learn(50).save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=DummyVecEnv([Walk, Walk])).learn(20)
    assert loaded.n_envs == 2
    assert loaded.policy.model.n_instances == 70


def test_a_policy_can_be_saved_and_loaded_by_itself(tmp_path):
    model = small().learn(100)
    model.policy.save(tmp_path / "policy.pth")
    policy = FittedRMaxPolicy.load(tmp_path / "policy.pth")
    np.testing.assert_array_equal(
        policy.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )


def test_parameters_go_back_and_forth():
    """As SB3's own test of every algorithm does: random values of any kind must load without an error."""
    model, other = small().learn(60), small(seed=1).learn(30)
    parameters = model.get_parameters()
    assert list(parameters) == ["policy"]
    other.set_parameters(parameters, exact_match=True)
    assert same_parameters(model, other)
    th.manual_seed(0)
    randomized = {"policy": {k: th.rand_like(v) for k, v in parameters["policy"].items()}}
    assert all(v.dtype == th.float64 for v in parameters["policy"].values())
    model.set_parameters(randomized, exact_match=True)
    model.predict(OBSERVATIONS)
    model.learn(20)
    other.set_parameters(parameters, exact_match=True)
    other.learn(20)
    with pytest.raises(ValueError):
        model.set_parameters({"policy": parameters["policy"], "stranger": {}}, exact_match=True)


def test_handing_out_parameters_hands_out_copies():
    model = small().learn(30)
    model.get_parameters()["policy"]["values"].fill_(-77.0)
    assert not (model.policy.planner.values == -77.0).any()


# ------------------------------------------------------------------------- chance


def test_the_same_seed_gives_the_same_run_to_the_last_bit():
    one, other, third = small(seed=3).learn(150), small(seed=3).learn(150), small(seed=4).learn(150)
    assert same_parameters(one, other)
    assert not same_parameters(one, third)


def test_without_a_seed_numpys_decides():
    runs = []
    for seed in (1, 1, 2, 3, 4, 5):
        np.random.seed(seed)
        runs.append(small(seed=None))
        runs[-1].env.seed(0)
        runs[-1].learn(80)
    assert same_parameters(runs[0], runs[1])
    assert not all(same_parameters(runs[0], other) for other in runs[2:])


# --------------------------------------------------------------------------- logs


def test_logs_have_the_groups_that_sb3_has(tmp_path):
    model = small()
    model.set_logger(configure(str(tmp_path), ["csv", "json"]))
    model.learn(150, log_interval=2)
    header = (tmp_path / "progress.csv").read_text().splitlines()
    assert {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/episodes", "time/total_timesteps"} <= set(
        header[0].split(",")
    )
    assert len(header) - 1 == model._episode_num // 2
    model.dump_logs()
    assert len((tmp_path / "progress.csv").read_text().splitlines()) == len(header) + 1


def test_without_a_log_interval_nothing_is_logged(tmp_path):
    model = small()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=None)
    assert (tmp_path / "progress.csv").read_text() == ""


def test_tensorboard_logs_are_named_after_the_algorithm(tmp_path):
    model = small(tensorboard_log=str(tmp_path)).learn(60, log_interval=1)
    assert len(list((tmp_path / "FittedRMax_1").glob("events.*"))) == 1
    model.learn(60, tb_log_name="again")
    assert (tmp_path / "again_1").is_dir()


def test_logging_to_the_screen(capsys):
    small(verbose=1).learn(60, log_interval=1)
    assert "ep_rew_mean" in capsys.readouterr().out


# ------------------------------------------------------------------------- import


def test_importing_is_light_and_compiles_nothing():
    code = (
        "import sys, sb3_combrel\n"
        "heavy = {'mujoco', 'dm_control', 'rl_zoo3', 'matplotlib', 'pandas', 'minari', 'optuna'} & set(sys.modules)\n"
        "from numba.core.dispatcher import Dispatcher\n"
        "import gc\n"
        "ours = [d for d in gc.get_objects() if isinstance(d, Dispatcher) and 'sb3_combrel' in d.py_func.__module__]\n"
        "assert ours\n"
        "compiled = [d for d in ours if d.signatures]\n"
        "sys.exit(f'{heavy} {compiled}' if heavy or compiled else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_dqn_users_find_their_way():
    """The calls of a script for DQN work unchanged, but for the name."""
    for algorithm in (DQN, FittedRMax):
        kwargs = dict(buffer_size=100) if algorithm is DQN else {}
        model = algorithm("MlpPolicy", Walk(), verbose=0, seed=0, **kwargs)
        model.learn(total_timesteps=20, log_interval=4)
        obs = model.get_env().reset()
        action, _states = model.predict(obs, deterministic=True)
        model.get_env().step(action)
