"""Mountain Car: the equations, and plans that are known to reach the goal."""

import gymnasium
import numpy as np
import pytest
from helpers.mountain_cars import (
    ID_2D,
    ID_4D,
    ID_6D,
    IDS,
    N_AXES,
    PLANS,
    TASKS,
    actions_of,
    env_in,
    expected_step,
    possible_states,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import combrel_envs


class TestDynamics:
    @pytest.mark.parametrize("env_id", IDS)
    @given(data=st.data())
    def test_a_step_follows_the_equations(self, env_id, data):
        state = data.draw(possible_states(N_AXES[env_id]))
        action = data.draw(st.integers(0, 2 * N_AXES[env_id]))
        env = env_in(env_id, state)
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

    @pytest.mark.parametrize("env_id", [ID_4D, ID_6D])
    @given(data=st.data())
    def test_every_axis_moves_as_a_car_in_2d(self, env_id, data):
        n_axes = N_AXES[env_id]
        state = data.draw(possible_states(n_axes))
        pushed, direction = data.draw(st.integers(0, n_axes - 1)), data.draw(st.integers(1, 2))
        env = env_in(env_id, state)
        env.step(2 * pushed + direction)
        for axis in range(n_axes):
            line = env_in(ID_2D, state[axis::n_axes])
            line.step(direction if axis == pushed else 0)
            assert env.unwrapped.state[axis::n_axes].tolist() == line.unwrapped.state.tolist()

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
    @pytest.mark.parametrize(("env_id", "length"), [(ID_2D, 103), (ID_4D, 146), (ID_6D, 200)])
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

    @pytest.mark.parametrize("env_id", [ID_4D, ID_6D])
    def test_every_axis_must_be_at_the_goal(self, env_id):
        n_axes = N_AXES[env_id]
        still = [0.0] * n_axes
        for missing in range(n_axes):
            env = env_in(env_id, [0.3 if axis == missing else 0.55 for axis in range(n_axes)] + still)
            assert not env.step(0)[2]
        assert env_in(env_id, [0.55] * n_axes + still).step(0)[2]


class TestActionNoise:
    """In the middle of the slope the velocity after one step tells which action was executed."""

    STEPS = 2000

    @staticmethod
    def executed(states, n_axes):
        place = [-0.5] * n_axes + [0.0] * n_axes
        outcomes = [expected_step(place, action) for action in range(2 * n_axes + 1)]
        return np.array([np.argmin([np.abs(state - outcome).sum() for outcome in outcomes]) for state in states])

    def gymnasium_actions(self, env_id, action_noise, action, seed=0):
        env = gymnasium.make(env_id, action_noise=action_noise)
        env.reset(seed=seed)
        states = []
        for _ in range(self.STEPS):
            env.reset(options={"state": [-0.5] * N_AXES[env_id] + [0.0] * N_AXES[env_id]})
            env.step(action)
            states.append(env.unwrapped.state)
        return self.executed(states, N_AXES[env_id])

    def dm_control_actions(self, env_id, action_noise, action, seed=0):
        n_axes = N_AXES[env_id]
        task_kwargs = {"action_noise": action_noise, "random": seed}
        environment = combrel_envs.load("mountain_car", TASKS[env_id], task_kwargs, {"flat_observation": True})
        environment.reset()
        states = []
        for _ in range(self.STEPS):
            environment.physics.set_car([-0.5] * n_axes, [0.0] * n_axes)
            states.append(environment.step(action).observation["observations"])
        return self.executed(states, n_axes)

    @pytest.mark.parametrize("env_id", IDS)
    @pytest.mark.parametrize("interface", ["gymnasium_actions", "dm_control_actions"])
    def test_random_actions_come_with_the_given_probability(self, env_id, interface):
        n_actions = 2 * N_AXES[env_id] + 1
        shares = np.bincount(getattr(self, interface)(env_id, 0.4, 1), minlength=n_actions) / self.STEPS
        expected = np.full(n_actions, 0.4 / n_actions)
        expected[1] += 0.6
        # Four standard deviations.
        np.testing.assert_array_less(np.abs(shares - expected), 4 * np.sqrt(expected * (1 - expected) / self.STEPS))

    def test_a_seed_decides_the_random_actions(self):
        first, same, other = (self.gymnasium_actions(ID_6D, 0.5, 0, seed).tolist() for seed in (1, 1, 2))
        assert first == same != other

    @pytest.mark.parametrize("interface", ["gymnasium_actions", "dm_control_actions"])
    def test_without_noise_the_chosen_action_is_executed(self, interface):
        assert set(getattr(self, interface)(ID_6D, 0.0, 5).tolist()) == {5}

    def test_without_noise_no_random_numbers_are_drawn(self):
        env = gymnasium.make(ID_4D)
        env.reset(seed=0)
        before = env.unwrapped.np_random.bit_generator.state
        env.step(2)
        assert env.unwrapped.np_random.bit_generator.state == before

    def test_impossible_actions_are_errors_with_noise_too(self):
        env = gymnasium.make(ID_6D, action_noise=1.0)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action must be an integer from 0 to 6, got 7"):
            env.step(7)

    @pytest.mark.parametrize("action_noise", [-0.1, 1.1, float("nan"), True, "much", None])
    def test_only_probabilities_are_possible(self, action_noise):
        with pytest.raises(ValueError, match=r"action_noise must be a probability, .* got "):
            gymnasium.make(ID_2D, action_noise=action_noise)
        with pytest.raises(ValueError, match=r"action_noise must be a probability, .* got "):
            combrel_envs.load("mountain_car", "climb_2d", {"action_noise": action_noise})
