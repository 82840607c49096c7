"""What who has one slow environment, and old data, does by accident: nothing is lost, made up or mixed without a word."""

import copy
import warnings

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from helpers.agents import interrupted_after
from helpers.walk import walk_source
from stable_baselines3.common.callbacks import CallbackList, EvalCallback
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_combrel import COMBREL, FittedRMax, SourceInstances


class Line(gym.Env):
    """A point that is pushed along a line until it reaches 1; ``shared``: all observations are one array."""

    def __init__(self, shared=False, low=-1.0, high=1.5, cost=-1.0, names=None, start=0):
        self.observation_space = spaces.Box(np.array([low, -1.0]), np.array([high, 1.0]), dtype=np.float64)
        self.action_space = spaces.Discrete(3, start=start)
        self.shared, self.cost, self._seen = shared, cost, np.zeros(2)
        if names is not None:
            self.state_names = names

    def _observation(self):
        self._seen[:] = self.state
        return self._seen if self.shared else self._seen.copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.n_steps = np.array([self.np_random.uniform(0.0, 0.2), 0.0]), 0
        return self._observation(), {}

    def step(self, action):
        self.n_steps += 1
        push = 0.02 * (int(action) - int(self.action_space.start) - 1)
        speed = float(np.clip(self.state[1] + push, -0.1, 0.1))
        self.state = np.array([max(self.state[0] + speed, -0.5), speed])
        return self._observation(), self.cost, bool(self.state[0] >= 1.0), self.n_steps >= 100, {}


def log_of(env, n, **columns):
    """A table of random actions in an environment."""
    rows = SourceInstances.record(None, env, n, seed=0)
    return rows.to_table().assign(**columns)


def test_an_environment_may_change_the_array_that_it_has_returned():
    runs = [FittedRMax(Line(shared), seed=0).learn(300).source_instances() for shared in (False, True)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].next_states, runs[1].next_states)
    recorded = [SourceInstances.record(None, Line(shared), 200, seed=0) for shared in (False, True)]
    np.testing.assert_array_equal(recorded[0].next_states, recorded[1].next_states)
    assert (recorded[1].next_states[recorded[1].terminated, 0] >= 1.0).all()


def test_an_interrupt_while_past_data_are_taken_in_leaves_the_model_as_it_was(monkeypatch):
    model, twin = (FittedRMax(Line(), seed=0).learn(60) for _ in range(2))
    table, add = log_of(Line(), 100), model.agent.model.add
    calls = iter(range(1000))

    def interrupted(*transition):
        if next(calls) == 50:
            raise KeyboardInterrupt
        return add(*transition)

    with monkeypatch.context() as patched:
        patched.setattr(type(model.agent.model), "add", lambda self, *transition: interrupted(*transition))
        with pytest.raises(KeyboardInterrupt):
            model.load_instances(table)
    assert len(model.source_instances()) == 60
    for each in (model, twin):
        each.load_instances(table)
    assert len(model.source_instances()) == 160
    np.testing.assert_allclose(model.policy.agent.planner.values, twin.policy.agent.planner.values, atol=0.01)


def test_rewards_of_past_data_are_rounded_as_those_of_an_environment_are():
    table = log_of(Line(cost=-0.1), 50, reward=-0.1)
    model = FittedRMax(Line(cost=-0.1), seed=0).load_instances(table[~table.terminated]).learn(20)
    assert not model.agent.rewards.differ


def test_experience_can_be_taken_from_a_model_whose_workers_have_ended():
    env = SubprocVecEnv([Line, Line])
    model = FittedRMax(env, seed=0).learn(40)
    env.close()
    assert len(model.source_instances()) == 40


def test_a_loaded_model_keeps_its_names_and_refuses_others(tmp_path):
    FittedRMax(Line(names=["x", "v"]), seed=0).learn(20).save(tmp_path / "run_0.95")
    with pytest.raises(ValueError, match=r"state_names of the model, \['x', 'v'\], got \['v', 'x'\]"):
        FittedRMax.load(tmp_path / "run_0.95", env=Line(names=["v", "x"]))
    loaded = FittedRMax.load(tmp_path / "run_0.95", env=Line())
    assert list(loaded.agent.task.state_names) == ["x", "v"]
    # Whatever the name of its file ends in.
    assert len(FittedRMax(Line(names=["x", "v"])).load_instances(tmp_path / "run_0.95").source_instances()) == 20


def test_flags_of_periodic_variables_that_do_not_fit_the_observations_are_warned_of():
    env = Line()
    env.periodic = [True]
    with pytest.warns(UserWarning, match=r"periodic=\[True\] is not one bool for each of the 2 variables"):
        FittedRMax(env)


@pytest.mark.parametrize("names", [["x"], "xv", ["x", 3], np.array([1.0, 2.0])])
def test_names_that_do_not_fit_the_task_are_warned_of(names):
    with pytest.warns(UserWarning, match="state_names=.* is not one str for each of the 2 variables, and is ignored"):
        model = FittedRMax(Line(names=names))
    assert model.agent.task.state_names == ("s0", "s1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert FittedRMax(Line(names=["x", "v"])).agent.task.state_names == ("x", "v")
        for none in ((), None):
            env = Line()
            env.state_names = none
            FittedRMax(env)


def test_a_log_that_does_not_say_where_episodes_end_is_warned_of():
    table = log_of(Line(), 60)
    following = [name for name in table.columns if name.startswith("next_")]
    with pytest.warns(
        UserWarning, match="all 60 rows are taken as one episode that does not end: add 'episode' or 'truncated'"
    ):
        assert len(FittedRMax(Line()).load_instances(table.drop(columns=[*following, "terminated"])).source_instances()) == 59
    with pytest.warns(UserWarning, match="no transition is taken to end an episode: add 'terminated'"):
        FittedRMax(Line()).load_instances(table.drop(columns="terminated"))
    with pytest.warns(UserWarning, match="no transition is taken to end an episode"):
        FittedRMax(Line()).load_instances(table.drop(columns="terminated").assign(episode=0))
    arrived = table.drop(columns=[*following, "terminated"])
    arrived["action"] = arrived["action"].astype(float).mask(arrived.index == 30)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FittedRMax(Line()).load_instances(table)
        FittedRMax(Line()).load_instances(arrived)
        FittedRMax(Line()).load_instances(table.drop(columns=following).assign(terminated=False, episode=0))


def test_a_warning_points_at_the_line_of_the_user_whichever_way_it_comes(tmp_path):
    table = log_of(Line(), 60).drop(columns="terminated")
    table.to_csv(tmp_path / "log.csv", index=False)
    for warned in (
        lambda: SourceInstances.from_table(table),
        lambda: FittedRMax(Line()).load_instances(table),
        lambda: FittedRMax(Line(), instances=tmp_path / "log.csv"),
        lambda: FittedRMax(Line(), transfer=COMBREL(tmp_path / "log.csv")),
        lambda: FittedRMax(Line(names=["x"])),
    ):
        with pytest.warns(UserWarning) as caught:
            warned()
        assert [each.filename for each in caught] == [__file__]


def test_actions_that_may_be_counted_from_another_number_are_warned_of():
    table = log_of(Line(), 60)
    table = table[table.action > 0]
    with pytest.warns(UserWarning, match="from 1 to 2, which count from 0 on; those of the environment count from 1"):
        FittedRMax(Line(start=1)).load_instances(table)


def test_degrees_and_errors_of_sensors_are_warned_of():
    table = log_of(Line(low=-np.inf, high=np.inf), 200)
    far = table.copy()
    far.loc[100, "s0"] = -9999.0
    with pytest.warns(UserWarning, match="s0=-9999, far from nearly all others"):
        FittedRMax(Line(low=-np.inf, high=np.inf)).load_instances(far)
    angle = table.assign(s0=np.linspace(-180.0, 180.0, len(table)))
    with pytest.warns(UserWarning, match=r"s0 from -180 to 180, many periods of 6.283"):
        FittedRMax(Line(low=-np.pi, high=np.pi), periodic=[True, False]).load_instances(angle)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FittedRMax(Line(low=-np.inf, high=np.inf)).load_instances(table)


class Glitch(gym.ObservationWrapper):
    """Its sensor is wrong once, at observation ``at``."""

    at, n = 200, 0

    def observation(self, observation):
        self.n += 1
        return np.array([-9999.0, observation[1]]) if self.n == self.at else observation


def test_an_error_of_a_sensor_while_it_learns_is_warned_of_once():
    model = FittedRMax(Glitch(Line(low=-np.inf, high=np.inf)), seed=0)
    with pytest.warns(
        UserWarning, match=r"s0=-9999 is far from all observations before, from .* bounds=\(low, high\)"
    ) as all_:
        model.learn(400)
    assert sum("is far from all" in str(each.message) for each in all_) == 1
    early = Glitch(Line(low=-np.inf, high=np.inf))
    early.at = 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Few observations are no measure of what is far, and a space with bounds says what there can be.
        FittedRMax(early, seed=0).learn(150)
        FittedRMax(Line(low=-np.inf, high=np.inf), seed=0).learn(400)
        FittedRMax(Glitch(Line(low=-10_000.0, high=10_000.0)), seed=0).learn(400)


def test_evaluating_in_the_environment_that_is_learned_in_is_warned_of():
    model = FittedRMax(Line(), seed=0)
    shared = EvalCallback(model.get_env(), n_eval_episodes=1, eval_freq=1000, verbose=0)
    own = EvalCallback(Line(), n_eval_episodes=1, eval_freq=1000, verbose=0)
    with pytest.warns(UserWarning, match="EvalCallback evaluates in the environment that the model learns in"):
        model.learn(5, CallbackList([own, shared]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(5, copy.copy(own))


def test_tables_are_the_same_frame_after_being_read():
    table = log_of(Line(), 30)
    assert isinstance(table, pd.DataFrame) and len(SourceInstances.from_table(table)) == 30


@pytest.mark.parametrize("transfer", [None, COMBREL(walk_source()), COMBREL(walk_source(), use="instances")])
@pytest.mark.parametrize("after", [0, 7, 25])
def test_an_interrupt_while_scales_are_computed_anew_leaves_the_model_as_it_was(monkeypatch, transfer, after):
    model = FittedRMax(Line(low=-np.inf, high=np.inf), transfer=transfer, seed=0).learn(40)
    agent, before = model.agent, model.source_instances()
    state = {name: array.copy() for name, array in agent.get_state().items()}
    model.policy.scales.observed[1] += 1.0
    with interrupted_after(monkeypatch, agent, after):
        model.policy.follow_scales(episode_ended=True)
    assert agent.task.scaling == model.policy.scales.scaling
    for name, array in agent.get_state().items():
        np.testing.assert_array_equal(array, state[name], err_msg=name)
    np.testing.assert_array_equal(model.source_instances().next_states, before.next_states)
    model.learn(40, reset_num_timesteps=False)
    assert len(model.source_instances()) == 80
