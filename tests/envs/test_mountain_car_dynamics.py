"""Mountain Car: the equations, and plans that are known to reach the goal."""

import gymnasium
import numpy as np
import pytest
from helpers.mountain_cars import ID_2D, ID_4D, IDS, PLANS, TASKS, actions_of, env_in, expected_step, possible_states
from hypothesis import given, settings
from hypothesis import strategies as st

import combrel_envs


class TestDynamics:
    @given(state=possible_states(2), action=st.integers(0, 4))
    def test_a_step_in_4d_follows_the_equations(self, state, action):
        env = env_in(ID_4D, state)
        env.step(action)
        np.testing.assert_allclose(env.unwrapped.state, expected_step(state, action), rtol=0, atol=1e-15)

    @given(state=possible_states(1), action=st.integers(0, 2))
    def test_a_step_in_2d_follows_the_equations(self, state, action):
        env = env_in(ID_2D, state)
        env.step(action)
        np.testing.assert_allclose(env.unwrapped.state, expected_step(state, action), rtol=0, atol=1e-15)

    def test_2d_moves_as_gymnasiums_mountain_car(self):
        reference = gymnasium.make("MountainCar-v0", max_episode_steps=2000).unwrapped
        reference.reset(seed=0)
        env = env_in(ID_2D, list(reference.state))
        theirs = {0: 1, 1: 0, 2: 2}
        rng = np.random.default_rng(0)
        for action in np.repeat(rng.integers(3, size=100), 15):
            _, _, done, _, _ = reference.step(theirs[int(action)])
            _, _, terminated, _, _ = env.step(action)
            np.testing.assert_allclose(env.unwrapped.state, reference.state, rtol=0, atol=1e-12)
            assert terminated == done
            if done:
                break

    @pytest.mark.parametrize("env_id", IDS)
    @settings(max_examples=20, deadline=None)
    @given(data=st.data())
    def test_states_and_observations_stay_within_the_bounds(self, env_id, data):
        env = gymnasium.make(env_id, start="random")
        env.reset(seed=data.draw(st.integers(0, 1000)))
        n_actions = int(env.action_space.n)
        runs = data.draw(st.lists(st.tuples(st.integers(0, n_actions - 1), st.integers(1, 40)), max_size=10))
        for action in (action for action, length in runs for _ in range(length)):
            observation, *_ = env.step(action)
            assert env.observation_space.contains(observation)
            positions, velocities = np.split(env.unwrapped.state, 2)
            assert np.all((positions >= -1.2) & (positions <= 0.6) & (np.abs(velocities) <= 0.07))

    @given(state=possible_states(2), action=st.integers(0, 2))
    def test_a_step_along_one_axis_does_not_depend_on_the_other(self, state, action):
        x, y, vx, vy = state
        plane, line = env_in(ID_4D, state), env_in(ID_2D, [x, vx])
        plane.step(action)
        line.step(action)
        assert plane.unwrapped.state[[0, 2]].tolist() == line.unwrapped.state.tolist()
        line.reset(options={"state": [y, vy]})
        line.step(0)
        assert plane.unwrapped.state[[1, 3]].tolist() == line.unwrapped.state.tolist()

    def test_the_left_wall_stops_the_car(self):
        env = env_in(ID_2D, [-1.19, -0.05])
        env.step(1)
        assert env.unwrapped.state.tolist() == [-1.2, 0.0]

    def test_the_right_wall_stops_one_axis_only(self):
        env = env_in(ID_4D, [0.59, -0.8, 0.05, 0.03])
        env.step(0)
        x, y, vx, vy = env.unwrapped.state
        assert (x, vx) == (0.6, 0.0)
        assert y > -0.8 and vy > 0.03

    def test_a_car_at_a_wall_can_drive_away(self):
        env = env_in(ID_2D, [-1.2, 0.0])
        env.step(2)
        assert np.all(env.unwrapped.state > [-1.2, 0.0])

    @pytest.mark.parametrize(("state", "action", "speed"), [([0.0, -0.0699], 1, -0.07), ([-1.1, 0.0699], 2, 0.07)])
    def test_the_speed_is_limited(self, state, action, speed):
        env = env_in(ID_2D, state)
        env.step(action)
        assert env.unwrapped.state[1] == speed

    def test_full_power_from_the_bottom_doesnt_reach_the_goal(self):
        env = gymnasium.make(ID_2D, start="fixed")
        env.reset()
        assert not any(env.step(2)[2] for _ in range(1000))


class TestPlans:
    @pytest.mark.parametrize(("env_id", "length"), [(ID_2D, 103), (ID_4D, 146)])
    def test_a_known_plan_reaches_the_goal_on_its_last_step(self, env_id, length):
        env = gymnasium.make(env_id, start="fixed")
        env.reset()
        steps = [env.step(action) for action in actions_of(PLANS[env_id], env)]
        assert len(steps) == length
        assert [step[2] for step in steps] == [False] * (length - 1) + [True]
        assert [step[4]["is_success"] for step in steps] == [False] * (length - 1) + [True]
        assert {step[1] for step in steps} == {-1.0}
        assert not any(step[3] for step in steps)

    @pytest.mark.parametrize("env_id", IDS)
    def test_both_interfaces_compute_the_same_states_bit_for_bit(self, env_id):
        env = gymnasium.make(env_id, start="fixed")
        env.reset()
        environment = combrel_envs.load("mountain_car", TASKS[env_id], {"start": "fixed"}, {"flat_observation": True})
        environment.reset()
        for action in actions_of(PLANS[env_id], env):
            time_step = environment.step(action)
            terminated = env.step(action)[2]
            assert time_step.observation["observations"].tolist() == env.unwrapped.state.tolist()
            assert (time_step.last(), time_step.discount) == (terminated, 0.0 if terminated else 1.0)
            assert time_step.reward == -1.0
        assert terminated

    def test_one_axis_at_the_goal_isnt_enough_in_4d(self):
        env = env_in(ID_4D, [0.55, 0.3, 0.0, 0.0])
        assert not env.step(0)[2]
        env.reset(options={"state": [0.55, 0.55, 0.0, 0.0]})
        assert env.step(0)[2]
