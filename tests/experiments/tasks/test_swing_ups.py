"""Tasks with a few forces: what the forces do, what the state says, and that seeds decide."""

from itertools import pairwise

import numpy as np
import pytest

from sb3_combrel.experiments.suite.tasks import TASKS
from sb3_combrel.experiments.tasks import swing_ups

MADE = [swing_ups.make_car, swing_ups.make_pendulum, swing_ups.make_dm_pendulum, swing_ups.make_dm_cart_pole]


@pytest.mark.parametrize("make", MADE)
def test_episodes_follow_from_their_seed_and_stay_in_their_spaces(make):
    with make() as env, make() as other:
        (state, _), (same, _) = env.reset(seed=3), other.reset(seed=3)
        np.testing.assert_array_equal(state, same)
        for action in np.random.default_rng(0).integers(env.action_space.n, size=40):
            (state, reward, *_), (same, other_reward, *_) = env.step(action), other.step(action)
            np.testing.assert_array_equal(state, same)
            assert reward == other_reward and env.observation_space.contains(state)
        # One seed decides all episodes that follow, and another makes others.
        (again, _), (after, _) = env.reset(), other.reset()
        np.testing.assert_array_equal(again, after)
        assert not np.array_equal(again, env.reset(seed=4)[0])


@pytest.mark.parametrize(("make", "speed"), [(MADE[0], 1), (MADE[1], 1), (MADE[2], 1), (MADE[3], 2)])
def test_the_first_force_pushes_one_way_and_the_last_the_other(make, speed):
    speeds = []
    with make() as env:
        for action in (0, env.action_space.n - 1):
            env.reset(seed=5)
            speeds.append(env.step(action)[0][speed])
    assert speeds[0] < speeds[1]


def test_a_pendulum_has_the_five_torques_of_the_whole_range():
    with swing_ups.make_pendulum() as env:
        assert [float(env.env.func(action)[0]) for action in range(5)] == [-2.0, -1.0, 0.0, 1.0, 2.0]


@pytest.mark.parametrize(("make", "angle"), [(swing_ups.make_dm_pendulum, 0), (swing_ups.make_dm_cart_pole, 1)])
def test_angles_of_dm_control_turn_with_their_speed_and_are_periodic(make, angle):
    with make() as env:
        before, _ = env.reset(seed=1)
        states = [before, *(env.step(0)[0] for _ in range(30))]
        assert list(env.get_wrapper_attr("periodic")) == [k == angle for k in range(len(before))]
        for state, after in pairwise(states):
            mean_speed = (state[-1] + after[-1]) / 2.0
            turned = (after[angle] - state[angle] + np.pi) % (2 * np.pi) - np.pi
            # A decision lasts two control steps: of 0.02 seconds for the pendulum, of 0.01 for the cart.
            assert turned == pytest.approx((0.02 if angle else 0.04) * mean_speed, abs=0.01)


def test_episodes_of_dm_control_end_after_500_decisions_by_a_time_limit():
    with swing_ups.make_dm_pendulum() as env:
        env.reset(seed=2)
        ends = [env.step(2)[2:4] for _ in range(500)]
    assert ends == [(False, False)] * 499 + [(False, True)]


def test_the_learner_is_told_nothing_of_the_suite_but_of_a_target_of_transfer():
    assert {name for name, task in TASKS.items() if task.learner} == {"CartPole-long"}
