"""Evaluation without exploration by the dashboard: its scalars, and that it changes nothing of what is learned."""

import gymnasium as gym
import numpy as np
import pytest
import yaml
from helpers.dashboard import NamedWalk, Still, events, run_folder, scalars, walker
from helpers.walk import Walk, same_parameters
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.callbacks import DashboardCallback
from sb3_combrel.runs.episodes import EVALUATION_SEED, play

RETURN, STEPS = "eval/mean_reward", "eval/mean_ep_length"


class Played(BaseCallback):
    """Plays by itself what the dashboard should have played, with an environment of its own that it goes on with."""

    def __init__(self, seed):
        super().__init__()
        self.env, self.seed, self.found = NamedWalk(), seed, {}

    def _on_step(self):
        if self.num_timesteps % 50 == 0:
            self.found[self.num_timesteps] = play(self.model, self.env, 3, self.seed)
            # As a vectorized environment does after its last episode.
            self.env.reset()
            self.seed = None
        return True


@pytest.fixture
def walk_id():
    gym.register("DashboardWalk-v0", NamedWalk)
    yield "DashboardWalk-v0"
    del gym.registry["DashboardWalk-v0"]


class WideWalk(NamedWalk):
    """The walk, in a space without bounds for its first variable: scales follow what is observed."""

    def __init__(self):
        super().__init__(limit=10)
        self.observation_space = gym.spaces.Box(np.float32([-np.inf, 0.0]), np.float32([np.inf, 2.0]))


class FarWalk(WideWalk):
    """One that sees what the other does not."""

    def observe(self):
        return 100 * super().observe()


@pytest.mark.parametrize("use", ["none", "instances", "prior"])
@pytest.mark.parametrize("kind", [NamedWalk, WideWalk])
def test_what_is_learned_is_the_same_with_and_without(use, kind, tmp_path):
    source = SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0)
    transfer = None if use == "none" else COMBREL(source, use=use)
    played = FarWalk() if kind is WideWalk else NamedWalk()
    dashboard = DashboardCallback(None, eval_env=played, eval_freq=7, n_eval_episodes=1)
    with_it = walker(tmp_path, transfer, kind()).learn(150, dashboard, log_interval=1)
    assert same_parameters(walker(transfer=transfer, env=kind()).learn(150), with_it)
    assert list(scalars(events(run_folder(tmp_path)), RETURN)) == list(range(7, 151, 7))


@pytest.mark.parametrize("log_interval", [1, None])
def test_an_environment_by_its_id_is_played_greedily_from_a_seed_that_no_run_has(log_interval, walk_id, tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(NamedWalk, "close", lambda self: closed.append(self.spec and self.spec.id))
    witness = Played(EVALUATION_SEED)
    dashboard = DashboardCallback(None, eval_env=walk_id, eval_freq=50, n_eval_episodes=3)
    walker(tmp_path).learn(220, [witness, dashboard], log_interval=log_interval)
    found = events(run_folder(tmp_path))
    assert list(witness.found) == [50, 100, 150, 200]
    for tag, column in ((RETURN, "returns"), (STEPS, "steps")):
        expected = {step: np.float32(np.mean(getattr(played, column))) for step, played in witness.found.items()}
        assert scalars(found, tag) == expected
    assert len(set(scalars(found, RETURN).values())) > 1, "an untrained policy and a trained one do not do equally well"
    assert closed == [walk_id], "what was made here is closed here"


@pytest.mark.parametrize(("n_envs", "freq", "steps"), [(1, "auto", range(30, 241, 30)), (4, 50, [52, 100, 152, 200])])
def test_evaluations_are_so_many_environment_steps_apart(n_envs, freq, steps, tmp_path):
    env = make_vec_env(NamedWalk, n_envs, seed=0)
    walker(tmp_path, env=env).learn(240, DashboardCallback(None, eval_env=NamedWalk(), eval_freq=freq, n_eval_episodes=1))
    assert list(scalars(events(run_folder(tmp_path)), STEPS)) == list(steps)


def test_without_an_environment_for_it_or_a_log_nothing_is_evaluated(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.evaluate_policy", lambda *_, **__: pytest.fail("nobody asked"))
    walker(tmp_path).learn(60, DashboardCallback(None))
    walker().learn(60, DashboardCallback(None, eval_env=NamedWalk(), eval_freq=1))


@pytest.mark.parametrize("layers", [lambda env: env, lambda env: make_vec_env(lambda: gym.wrappers.TimeLimit(env, 99))])
def test_the_environment_that_is_learned_is_refused(layers, tmp_path):
    env = NamedWalk()
    with pytest.raises(ValueError, match="eval_env must be another environment than the one that is learned, or an id, got "):
        walker(tmp_path, env=env).learn(10, DashboardCallback(eval_env=layers(env)))


def test_what_cannot_be_evaluated_is_refused_before_the_first_step(tmp_path):
    for name, value in (("eval_freq", 0), ("eval_freq", None), ("n_eval_episodes", 0), ("picture_freq", "often")):
        with pytest.raises(ValueError, match=f"{name} must be"):
            DashboardCallback(**{name: value})
    other = Still(np.float32([0]), np.float32([1]))
    with pytest.raises(ValueError, match=r"eval_env must have the spaces of the environment that is learned, .*, got .*Box"):
        walker(tmp_path).learn(10, DashboardCallback(eval_env=other))
    with pytest.raises(ValueError, match=r"needs VecNormalize.norm_obs=False"):
        walker(tmp_path).learn(10, DashboardCallback(eval_env=VecNormalize(make_vec_env(NamedWalk))))
    with pytest.raises(gym.error.NameNotFound, match="Nowhere"):
        walker(tmp_path).learn(10, DashboardCallback(eval_env="Nowhere-v0"))


def test_rewards_that_are_normalized_for_learning_are_the_environments_own_in_evaluations(tmp_path):
    env = VecNormalize(make_vec_env(lambda: Walk(limit=5), seed=0), norm_obs=False)
    dashboard = DashboardCallback(None, eval_env=Walk(limit=5, start=-0.9), eval_freq=20)
    walker(tmp_path, env=env).learn(20, dashboard)
    assert scalars(events(run_folder(tmp_path)), RETURN) == {20: -5.0}


def test_it_is_asked_for_in_a_file_of_rl_zoo_as_well(tmp_path):
    get_callback_list = pytest.importorskip("rl_zoo3.utils").get_callback_list
    entry = """
callback:
  - sb3_combrel.callbacks.DashboardCallback:
      picture_freq: null
      eval_env: MountainCar-v0
      eval_freq: 300
      n_eval_episodes: 1
"""
    callbacks = get_callback_list(yaml.safe_load(entry))
    FittedRMax("MountainCar-v0", seed=0, resolution=4, tensorboard_log=str(tmp_path)).learn(300, callbacks)
    assert scalars(events(run_folder(tmp_path)), RETURN)[300] <= -80.0
