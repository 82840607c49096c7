"""Warnings where learning makes no progress: returns above max_value, idle episodes, returns that are alike; a wall."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.optimism import RewardRange
from sb3_combrel.fitted_rmax.progress import EQUAL_RETURNS, IDLE_EPISODES, ProgressWatch
from sb3_combrel.wrappers import AngleObservation


def watch_with(max_value, gamma):
    return ProgressWatch(RewardRange(gamma, max_value), 1e-3)


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


def test_where_no_max_value_is_found_the_warning_says_why():
    # What is given can be larger; with gamma 1 and rewards above 0 none is found, however large.
    [(_, found)] = shown(watch_with(None, 1.0), [([1.0] * 4, True)], explores=False)
    assert "with gamma=1 and rewards above 0 none is found: leave gamma out" in found and "a larger max_value" not in found
    [(_, given)] = shown(watch_with(2.0, 1.0), [([1.0] * 4, True)], explores=False)
    assert "pass a larger max_value, or" in given


@pytest.mark.parametrize(
    ("max_value", "gamma", "rewards", "terminated", "observed"),
    [
        *[(3.0, 1.0, [1.0] * 4, False, "4"), (2.9, 0.5, [-9.0, 2.0, 2.0], True, "3")],
        *[(2.9, 0.5, [-9.0, 2.0, 2.0], False, None), (4.0, 1.0, [1.0] * 4, True, None), (0.0, 1.0, [-1.0], True, None)],
    ],
)
def test_returns_above_max_value_give_one_warning(max_value, gamma, rewards, terminated, observed):
    found = shown(watch_with(max_value, gamma), [(rewards, terminated)] * 3, explores=False)
    assert len(found) == (0 if observed is None else 1)
    for number, message in found:
        assert number == 1 and f"max_value={max_value:g}" in message and f"a return of {observed} was observed" in message


@pytest.mark.parametrize(("max_value", "gamma"), [(0.0, 1.0), (0.0, 0.9), (5.0, 1.0)])
def test_episodes_that_cost_nothing_give_one_warning(max_value, gamma):
    watch = watch_with(max_value, gamma)
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
    watch = watch_with(max_value, gamma)
    watch.rewards.note(-1.0, True)
    assert not shown(watch, [episode] * 50, explores=False)


def test_equal_returns_give_one_warning_while_exploration_goes_on():
    alike = ([-1.0, -1.0], False)
    watch = watch_with(7.0, 0.95)
    watch.rewards.note(-1.0, True)
    [(number, message)] = shown(watch, [([-1.0], True), *[alike] * 3, ([-1.0], False), *[alike] * 60])
    assert number == 5 + EQUAL_RETURNS and f"the last {EQUAL_RETURNS} returns are all -2" in message
    assert "max_value=7" in message and "model_breadth" in message


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
    watch = watch_with(100.0, 1.0)
    watch.rewards.note(-1.0, True)
    assert not shown(watch, [([-1.0], True), *episodes], explores)


@pytest.mark.parametrize(
    ("rewards", "terminated"), [([-1.0, -1.0], True), ([0.0, 1.0], True), ([1.0, 1.0], True), ([1.0, 1.0], False)]
)
def test_a_run_none_of_whose_returns_differ_gives_one_warning(rewards, terminated):
    [(number, message)] = shown(watch_with(100.0, 0.9), [(rewards, terminated)] * 60)
    assert number == EQUAL_RETURNS and f"all {EQUAL_RETURNS} episodes so far have the same return" in message
    assert f"{rewards[0] + 0.9 * rewards[1]:g} (discounted with gamma=0.9)" in message and "gamma=0.99" not in message


def test_returns_that_were_alike_only_later_or_without_exploration_give_no_such_warning():
    alike = [([0.0, 1.0], True)] * 60
    assert not shown(watch_with(100.0, 0.9), alike, explores=False)
    # With a discount it matters when the goal is reached.
    assert not shown(watch_with(100.0, 0.9), [([0.0, 0.0, 1.0], True), *alike])
    [(_, message)] = shown(watch_with(100.0, 1.0), [([0.0, 0.0, 1.0], True), *alike])
    assert message.endswith("as it does with gamma=0.99")


def test_equal_returns_give_one_warning_as_long_as_nothing_has_told_states_apart():
    """All actions have been tried wherever the agent gets to."""
    watch = watch_with(100.0, 0.99)
    watch.rewards.note(-1.0, False)
    [(number, message)] = shown(watch, [([-1.0, -1.0], False)] * 60, explores=False)
    assert number == EQUAL_RETURNS and "nothing that it has reached makes a difference" in message


class Corridor(gym.Env):
    """A long corridor, whose end is out of reach."""

    observation_space, action_space = gym.spaces.Box(0.0, 1000.0, (1,)), gym.spaces.Discrete(2)

    def __init__(self, reward):
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(1, np.float32)
        return self.at.copy(), {}

    def step(self, action):
        self.at[0] = max(0.0, self.at[0] + (1.0 if action else -1.0))
        return self.at.copy(), self.reward, False, False, {}


@pytest.mark.parametrize(
    ("reward", "gamma", "message"),
    [
        (1.0, 1.0, "a return of 20 was observed"),
        (0.0, 1.0, "max_value=1 with gamma=1"),
        (-1.0, 0.99, "the last 20 returns are all -20"),
    ],
)
def test_each_warning_is_given_once_and_names_the_line_that_learns(reward, gamma, message):
    arguments = dict(seed=0, model_breadth=0.002, exploration_threshold=100.0, resolution=9, gamma=gamma)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        FittedRMax(gym.wrappers.TimeLimit(Corridor(reward), 20), **arguments).learn(600)
    [warning] = [warning for warning in caught if message in str(warning.message)]
    assert warning.filename == __file__


@pytest.mark.long
@pytest.mark.parametrize(
    ("env_id", "wrap", "arguments"),
    [("MountainCar-v0", lambda env: env, {}), ("Acrobot-v1", AngleObservation, dict(gamma=0.99))],
)
def test_normal_tasks_give_no_warning(env_id, wrap, arguments):
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*max_value")
        FittedRMax(wrap(gym.make(env_id)), seed=0, **arguments).learn(4000)


# The agent does not run against a wall for ever.
STEP_LIMIT = 100
FEWEST_STEPS = 34


class TwoJoints(gym.Env):
    """Two joints, each action moves one of them a little; a block that they can't enter stands between start and goal."""

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), dtype=np.float64)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joints = np.zeros(2)
        return self.joints.copy(), {}

    def step(self, action):
        to = self.joints.copy()
        to[action // 2] += 0.05 if action % 2 else -0.05
        to = np.clip(to, 0.0, 1.0)
        if not (0.4 < to[0] < 0.6 and to[1] < 0.75):
            self.joints = to
        return self.joints.copy(), -1.0, bool((np.abs(self.joints - 0.9) <= 0.06).all()), False, {}


@pytest.mark.parametrize("seed", range(3))
def test_the_way_around_a_block_is_learned(seed):
    model = FittedRMax(gym.wrappers.TimeLimit(TwoJoints(), STEP_LIMIT), seed=seed)
    monitor = model.get_env().envs[0]
    model.learn(10**6, callback=StopTrainingOnMaxEpisodes(40))
    lengths = monitor.get_episode_lengths()
    assert lengths[0] == STEP_LIMIT and np.median(lengths[-10:]) <= FEWEST_STEPS + 2
