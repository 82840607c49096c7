"""What must not go wrong without a word: dropped arguments, invented periods, transitions that never were."""

import gymnasium as gym
import numpy as np
import pytest
from helpers.walk import Walk, small, walk_source
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.sources.source_recorder import SourceRecorder

STRIDE = 0.15


class Open(Walk):
    """The walk in a space without bounds; ``periodic``: whether it says that the place is an angle."""

    def __init__(self, periodic=False):
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), dtype=np.float32)
        self.periodic = (periodic, False)


def moves(model):
    """How far each transition of a model goes."""
    found = model.source_instances()
    return np.abs(found.next_states - found.states)[:, 0]


@pytest.mark.parametrize("second", [COMBREL(walk_source()), Walk(), 5])
def test_what_is_neither_policy_nor_environment_is_refused(second):
    with pytest.raises(ValueError, match="others be given by name, such as transfer=COMBREL"):
        FittedRMax(Walk(), second)
    assert FittedRMax(Walk(), "MlpPolicy").env is not None


def test_a_period_that_nobody_knows_is_not_invented():
    for make in (lambda: small(Open(periodic=True)), lambda: SourceInstances.record(None, Open(periodic=True), 50, seed=0)):
        with pytest.raises(ValueError, match=r"finite bounds, one period apart, got none for variable\(s\) \[0\]"):
            make()
    with pytest.raises(ValueError, match="one period apart"):
        small(Open(), periodic=[True, False])
    recorder = SourceRecorder()
    with pytest.raises(ValueError, match="one period apart"):
        DQN("MlpPolicy", Open(periodic=True), learning_starts=10**6).learn(5, callback=recorder)
    assert small(Open(periodic=True), bounds=([-1.0, 0.0], [1.0, 2.0])).agent.periodic == (True, False)


def test_a_variable_between_bounds_without_a_width_is_one_that_never_changes():
    class Constant(Walk):
        def __init__(self):
            super().__init__()
            self.observation_space = gym.spaces.Box(np.float32([-1.0, 1.0]), np.float32([1.0, 1.0]))

    model = small(Constant()).learn(100)
    assert model.policy.scales.scaling.low[1] < 1.0 <= model.policy.scales.scaling.high[1]
    source = SourceInstances.record(None, Constant(), 20, seed=0)
    assert source.low[1] < 1.0 < source.high[1]


@pytest.mark.parametrize("where", ["update", "act"])
def test_an_interrupt_while_planning_leaves_no_transition_that_never_was(monkeypatch, where):
    model, real = small(Walk(limit=100), seed=1).learn(41), getattr(FittedRMaxAgent, where)

    def interrupted(self, *arguments, **more):
        found = real(self, *arguments, **more)
        raise KeyboardInterrupt(found)

    monkeypatch.setattr(FittedRMaxAgent, where, interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(10, reset_num_timesteps=False)
    monkeypatch.setattr(FittedRMaxAgent, where, real)
    assert (moves(model.learn(10, reset_num_timesteps=False)) < STRIDE + 1e-6).all()


class RaisesAtAnEnd(BaseCallback):
    """Raises when an episode ends."""

    def _on_step(self):
        if self.locals["dones"].any():
            raise RuntimeError("enough")
        return True


def test_an_episode_that_ends_in_a_callbacks_error_has_ended():
    model = small()
    with pytest.raises(RuntimeError, match="enough"):
        model.learn(100, callback=RaisesAtAnEnd())
    assert model._episode_num == 1 and model.agent.rewards.n_ended + model.agent.rewards.n_truncated == 1


def test_past_data_may_come_while_the_model_learns():
    data = walk_source()

    def give(found, _):
        model = found["self"]
        if model.num_timesteps == 5:
            model.load_instances(data)
        return True

    model = small(Open()).learn(40, callback=give)
    assert model.agent.model.n_instances == 40 + len(data)
    assert (moves(model) < STRIDE + 1e-6).all()
    with pytest.raises(ValueError, match="instances must be data while the model learns"):
        model.learn(5, callback=lambda found, _: found["self"].load_instances(lambda state: 1, 20))
    assert model.load_instances(lambda state: 1, 20).agent.model.n_instances == 61 + len(data)


def test_a_recorder_that_is_not_called_at_every_step_says_so():
    with pytest.raises(ValueError, match="must be called at every step, got one call for 10 steps"):
        small().learn(50, callback=EveryNTimesteps(10, SourceRecorder()))


def test_names_that_do_not_tell_variables_apart_are_refused():
    class Named(Walk):
        state_names = "place", "place"

    with pytest.raises(ValueError, match="state_names must be different names"):
        small(Named())
    data = walk_source()
    fields = data.states, data.actions, data.rewards, data.next_states, data.terminated, data.low, data.high, 2
    with pytest.raises(ValueError, match="state_names must be different names"):
        SourceInstances(*fields, state_names=("place", "place"))
    command = SourceInstances(*fields, state_names=("place", "action"))
    with pytest.raises(ValueError, match=r"must have other names than .*, got \['action'\]"):
        command.to_table()
    with pytest.raises(ValueError, match="must have other names than"):
        SourceInstances.from_table(data.to_table(), state_names=["s0", "reward"])


def test_a_buffer_that_does_not_know_time_limits_says_so():
    given = dict(handle_timeout_termination=False)
    model = DQN("MlpPolicy", Walk(), buffer_size=100, learning_starts=10**6, replay_buffer_kwargs=given, seed=0).learn(90)
    with pytest.warns(UserWarning, match="does not say which episodes a time limit ended"):
        small().load_instances(model)


def test_actions_numbered_as_the_environment_has_them_are_named():
    table = walk_source().to_table()
    table["action"] += 1
    with pytest.raises(ValueError, match="actions are numbered from 0 on, those of the environment from 1: subtract that"):
        small(Walk(first=1)).load_instances(table)
    with pytest.raises(ValueError, match="the table has no column of a state variable"):
        small().load_instances(table[["action", "reward", "next_s0"]])


def test_numbers_of_numpy_are_numbers():
    for seed in np.arange(2):
        assert small(seed=seed, stats_window_size=np.int64(5)).seed == seed


def test_combinations_of_actions_that_begin_elsewhere_are_numbered_so():
    class Many(Walk):
        def __init__(self):
            super().__init__()
            self.action_space = gym.spaces.MultiDiscrete([3, 2], start=[1, 1])

    with pytest.raises(ValueError, match=r"unravel_index\(action, \(3, 2\)\)\) \+ \[1, 1\], gymnasium.spaces.Discrete\(6\)"):
        FittedRMax(Many())
