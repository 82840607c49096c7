"""Warnings where learning makes no progress: of episodes that cost nothing, and of returns that are all alike; no others."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import DiscretizeAction

import combrel_envs  # noqa: F401 - registers the environments
from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.progress import EQUAL_RETURNS, IDLE_EPISODES, ProgressWatch
from sb3_combrel.wrappers import AngleObservation


def shown(watch, episodes, explores=True):
    """What a watch warns of when it sees episodes (rewards, terminated), as (number of the episode, message)."""
    messages = []
    for n, (rewards, terminated) in enumerate(episodes, 1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            watch.note(rewards, terminated, n if explores else 0)
        assert all(warning.category is UserWarning for warning in caught)
        messages += [(n, str(warning.message)) for warning in caught]
    return messages


@pytest.mark.parametrize(("max_value", "gamma"), [(0.0, 1.0), (0.0, 0.9), (5.0, 1.0)])
def test_episodes_that_cost_nothing_give_one_warning(max_value, gamma):
    watch = ProgressWatch(max_value, gamma, 1e-3)
    episodes = [([-1.0, 0.0], False), *[([0.0, -1e-9], False)] * 10, ([-1.0], True), *[([0.0], False)] * 10]
    [(number, message)] = shown(watch, episodes, explores=False)
    assert number == 1 + IDLE_EPISODES
    assert f"max_value={max_value:g} with gamma={gamma:g}" in message and "gamma=0.99" in message


@pytest.mark.parametrize(
    ("max_value", "gamma", "episode"),
    [
        (5.0, 0.9, ([0.0, 0.0], False)),  # a discounted max_value falls where nothing is gained
        (0.0, 1.0, ([0.0, 0.0], True)),  # it ended
        (0.0, 1.0, ([-0.01, 0.0], False)),  # it cost something
        (100.0, 0.99, ([1.0, 1.0], False)),  # a pole in balance
    ],
)
def test_other_episodes_give_no_warning_of_their_cost(max_value, gamma, episode):
    assert not shown(ProgressWatch(max_value, gamma, 1e-3), [episode] * 50, explores=False)


def test_equal_returns_give_one_warning_while_exploration_goes_on():
    alike = ([-1.0, -1.0], False)
    watch = ProgressWatch(7.0, 0.95, 1e-3)
    [(number, message)] = shown(watch, [([-1.0], True), *[alike] * 3, ([-1.0], False), *[alike] * 60])
    assert number == 5 + EQUAL_RETURNS
    assert (
        f"the last {EQUAL_RETURNS} returns are all -2" in message and "max_value=7" in message and "model_breadth" in message
    )


@pytest.mark.parametrize(
    ("episodes", "explores"),
    [
        ([([-1.0, -1.0], False)] * 60, False),
        ([([-1.0, -1.0], True)] * 60, True),
        ([([1.0, 1.0], False)] * 60, True),
        ([([-1.0, -1.0], False), ([-1.0], False)] * 30, True),
        ([*[([-1.0, -1.0], False)] * (EQUAL_RETURNS - 1), ([-1.0, -1.0], True)] * 3, True),
    ],
    ids=["no exploration", "the goal is reached", "rewards are collected", "different returns", "now and then the goal"],
)
def test_other_returns_give_no_warning(episodes, explores):
    assert not shown(ProgressWatch(0.0, 1.0, 1e-3), episodes, explores)


def discrete(env_id, **kwargs):
    return DiscretizeAction(gym.make(env_id, **kwargs), bins=5)


def test_a_car_that_need_not_drive_gives_a_warning():
    env = discrete("MountainCarContinuous-v0", max_episode_steps=300)
    with pytest.warns(UserWarning, match="max_value=0 with gamma=1") as caught:
        model = FittedRMax(env, seed=0).learn(4500)
    of_progress = [warning for warning in caught if "max_value" in str(warning.message)]
    assert len(of_progress) == 1 and of_progress[0].filename == __file__, "once, and it names the line that learns"
    assert all(abs(info["r"]) < 1e-3 for info in list(model.ep_info_buffer)[-3:]), "what the warning is about"


class Corridor(gym.Env):
    """A long corridor, whose end is out of reach; each step costs 1."""

    observation_space = gym.spaces.Box(0.0, 1000.0, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(1, np.float32)
        return self.at.copy(), {}

    def step(self, action):
        self.at[0] = max(0.0, self.at[0] + (1.0 if action else -1.0))
        return self.at.copy(), -1.0, False, False, {}


def test_a_goal_out_of_reach_gives_a_warning():
    env = gym.wrappers.TimeLimit(Corridor(), 20)
    with pytest.warns(UserWarning, match=re.escape("the last 20 returns are all -20")):
        FittedRMax(env, seed=0, model_breadth=0.002, exploration_threshold=100.0, resolution=9, gamma=0.99).learn(600)


NORMAL = {
    "MountainCar": (lambda: gym.make("MountainCar-v0"), 4000, {}),
    "MountainCar2D": (lambda: gym.make("combrel/MountainCar2D-v0"), 3000, {}),
    "CartPole": (
        lambda: gym.make("CartPole-v1"),
        3000,
        dict(
            bounds=([-4.8, -3.0, -0.23, -3.2], [4.8, 3.0, 0.23, 3.2]),
            exploration_threshold=0.5,
            resolution=4,
            gamma=0.99,
            max_value=100.0,
        ),
    ),
    "Acrobot": (lambda: AngleObservation(gym.make("Acrobot-v1")), 5000, dict(gamma=0.99)),
    "Pendulum": (lambda: AngleObservation(discrete("Pendulum-v1")), 3000, dict(gamma=0.97)),
    "MountainCarContinuous": (lambda: discrete("MountainCarContinuous-v0"), 4000, dict(gamma=0.999, max_value=100.0)),
}


@pytest.mark.parametrize("task", NORMAL)
def test_normal_tasks_give_no_warning(task):
    make, n_steps, arguments = NORMAL[task]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*max_value")
        FittedRMax(make(), seed=0, **arguments).learn(n_steps)


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "n_steps"), [("ICubTorsoStrike", 4000), ("ICubArmStrike", 12000)])
def test_the_icub_gives_no_warning(env_id, n_steps):
    breadth = dict(model_breadth=0.2) if env_id == "ICubArmStrike" else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*max_value")
        FittedRMax(f"combrel/{env_id}-v0", seed=0, max_value=100.0, **breadth).learn(n_steps)
