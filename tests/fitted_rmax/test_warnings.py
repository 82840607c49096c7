"""What is said of what does not suit: too many variables, bounds that are too narrow, no end, files of other versions."""

import json
import warnings
import zipfile

import gymnasium as gym
import numpy as np
import pytest

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.progress import MANY_STEPS


class Drift(gym.Env):
    """A point that goes right, from 0 on, by 0.1 a step, for ``limit`` steps; -1 a step."""

    def __init__(self, n_variables=1, limit=10):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (n_variables,))
        self.action_space = gym.spaces.Discrete(2)
        self.limit = limit

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self._observation(), {}

    def step(self, action):
        self.n += 1
        return self._observation(), -1.0, False, self.n >= self.limit, {}

    def _observation(self):
        return np.full(self.observation_space.shape, 0.1 * self.n, dtype=np.float32)


def said_by(act):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        act()
    return [str(each.message) for each in caught]


def test_more_than_six_state_variables_are_said_to_be_many_with_the_cost_and_what_else_there_is():
    said = said_by(lambda: FittedRMax(Drift(7), bounds=(-1.0, 2.0)))
    assert any("7 state variables are many for a grid" in text and "a step" in text and "DQN" in text for text in said)
    assert not any("are many" in text for text in said_by(lambda: FittedRMax(Drift(2), bounds=(-1.0, 2.0))))


def test_the_share_of_observations_outside_given_bounds_is_said_with_bounds_that_hold_them():
    said = said_by(lambda: FittedRMax(Drift(), bounds=(0.0, 0.5)).learn(50))
    [text] = [text for text in said if "observations were outside the bounds" in text]
    assert "s0 in " in text and "bounds=([0.0], [1.0])" in text
    assert not [text for text in said_by(lambda: FittedRMax(Drift(), bounds=(0.0, 1.0)).learn(50)) if "outside" in text]
    assert not [text for text in said_by(lambda: FittedRMax(Drift()).learn(50)) if "outside" in text]


@pytest.mark.parametrize(("gamma", "warns"), [(1.0, True), (0.99, False), (None, False)])
def test_episodes_that_never_end_are_no_task_for_gamma_1(gamma, warns):
    said = said_by(lambda: FittedRMax(Drift(limit=3), gamma=gamma, bounds=(0.0, 1.0)).learn(80))
    assert any("all 20 episodes have ended by their time limit" in text for text in said) == warns


@pytest.mark.parametrize(("limited", "gamma", "warns"), [(False, None, True), (True, None, False), (False, 0.99, False)])
def test_where_nothing_limits_an_episode_it_is_said_once_it_is_long(limited, gamma, warns):
    env = Drift(limit=10**9)
    env = gym.wrappers.TimeLimit(env, 10**6) if limited else env
    model = FittedRMax(env, gamma=gamma, bounds=(0.0, 1.0), resolution=1)
    assert not [text for text in said_by(lambda: model.learn(MANY_STEPS - 1)) if "no episode has ended" in text]
    said = said_by(lambda: model.learn(1, reset_num_timesteps=False))
    assert any(f"after {MANY_STEPS} steps no episode has ended" in text for text in said) == warns


def test_bounds_of_an_angle_are_a_period_apart_or_that_is_told():
    class Angle(Drift):
        def __init__(self, turns):
            super().__init__()
            self.observation_space = gym.spaces.Box(np.float32([-np.pi * turns]), np.float32([np.pi * turns]))

    def said(turns, *bounds):
        return said_by(lambda: FittedRMax(Angle(turns), periodic=[True], bounds=bounds))

    assert "apart, which counts as its period" in "".join(said(1, -1.6, 1.6))
    assert "apart, which counts as its period" in "".join(said(1, -np.pi, 3 * np.pi))
    assert not said(1, -np.pi, np.pi) and not said(1, 0.0, 2 * np.pi) and not said(10, -np.pi, np.pi)


def test_a_file_names_its_version_and_one_of_another_version_that_does_not_fit_says_which_can_load_it(tmp_path):
    model = FittedRMax(Drift(), bounds=(0.0, 1.0)).learn(20)
    model.save(tmp_path / "model")
    assert FittedRMax.load(tmp_path / "model").package_version
    with zipfile.ZipFile(tmp_path / "model.zip") as given, zipfile.ZipFile(tmp_path / "old.zip", "w") as written:
        for name in given.namelist():
            content = given.read(name)
            if name == "data":
                content = json.dumps({**json.loads(content), "package_version": "0.0.7"}).encode()
            written.writestr(name, content if name != "policy.pth" else b"of another layout")
    with pytest.raises(ValueError, match=r"it was saved by sb3_combrel 0\.0\.7, which can load it"):
        FittedRMax.load(tmp_path / "old.zip")


def test_of_many_variables_there_is_one_warning_alone():
    """Not also that the resolution, which nobody has given, is too coarse, and too fine."""
    said = said_by(lambda: FittedRMax(Drift(12), seed=0))
    assert ["12 state variables are many" in text for text in said] == [True]


def test_a_model_without_an_environment_is_refused():
    with pytest.raises(ValueError, match="env is missing"):
        FittedRMax()
