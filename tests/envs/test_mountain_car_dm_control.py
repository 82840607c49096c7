"""Mountain Car as a dm_control environment: specs, starts, physics."""

import math

import numpy as np
import pytest
from helpers.mountain_cars import BOTTOM, TASKS, expected_step

import combrel_envs


class TestDmControl:
    @pytest.mark.parametrize("task", TASKS.values())
    def test_observations_and_actions_fit_the_specs(self, task):
        environment = combrel_envs.load("mountain_car", task, {"random": 0})
        spec = environment.action_spec()
        time_step = environment.reset()
        rng = np.random.default_rng(0)
        for action in rng.integers(spec.num_values, size=20):
            spec.validate(action)
            for name, observation_spec in environment.observation_spec().items():
                observation_spec.validate(time_step.observation[name])
            time_step = environment.step(action)
        assert list(time_step.observation) == ["position", "velocity"]

    def test_the_default_time_limit_is_4000_steps(self):
        environment = combrel_envs.load("mountain_car", "climb_2d", {"random": 0})
        environment.reset()
        steps = [environment.step(0) for _ in range(4000)]
        assert not any(step.last() for step in steps[:-1])
        assert steps[-1].last() and steps[-1].discount == 1.0

    def test_the_time_limit_can_be_set(self):
        environment = combrel_envs.load("mountain_car", "climb_4d", {"time_limit": 5})
        environment.reset()
        assert [environment.step(0).last() for _ in range(5)] == [False] * 4 + [True]

    @pytest.mark.parametrize("task", TASKS.values())
    def test_a_seed_decides_the_starts(self, task):
        def starts(seed):
            environment = combrel_envs.load("mountain_car", task, {"random": seed, "start": "random"})
            return [environment.reset().observation["position"].tolist() for _ in range(3)]

        assert starts(1) == starts(1)
        assert starts(1) == starts(np.random.RandomState(1))
        assert starts(1) != starts(2)

    def test_environment_kwargs_reach_the_environment(self):
        environment = combrel_envs.load(
            "mountain_car", "climb_4d", {"start": "fixed"}, {"flat_observation": True, "n_sub_steps": 2}
        )
        assert environment.reset().observation["observations"].shape == (4,)
        assert environment.control_timestep() == 2
        expected = [BOTTOM, BOTTOM, 0, 0]
        for _ in range(2):
            expected = expected_step(expected, 2)
        np.testing.assert_allclose(environment.step(2).observation["observations"], expected, rtol=0, atol=1e-15)

    def test_physics_states_can_be_saved_and_restored(self):
        physics = combrel_envs.load("mountain_car", "climb_4d", {"start": "fixed"}).physics
        with physics.reset_context():
            physics.set_car((0.1, -0.2), (0.03, 0.04))
        state = physics.get_state()
        physics.set_control([1.0, 0.0])
        physics.step(10)
        assert physics.push().tolist() == [1.0, 0.0] and physics.time() == 10
        physics.set_state(state)
        assert physics.car_position().tolist() == [0.1, -0.2]
        assert physics.car_velocity().tolist() == [0.03, 0.04]

    def test_the_drawn_car_stands_on_the_hill(self):
        physics = combrel_envs.load("mountain_car", "climb_4d").physics
        with physics.reset_context():
            physics.set_car((0.1, -0.9), (0.03, 0.0))
        x, y, z = physics.named.data.xpos["car"]
        height = 0.2 * (math.sin(3 * x) + math.sin(3 * y))
        assert (x, y) == (0.1, -0.9) and abs(z - height) < 0.01
        roof = physics.named.data.xmat["car"].reshape(3, 3)[:, 2]
        normal = np.array([-0.6 * math.cos(3 * x), -0.6 * math.cos(3 * y), 1])
        np.testing.assert_allclose(roof, normal / np.linalg.norm(normal), atol=1e-9)

    def test_in_6d_a_second_car_shows_the_third_axis(self):
        physics = combrel_envs.load("mountain_car", "climb_6d").physics
        with physics.reset_context():
            physics.set_car((0.1, -0.9, 0.3), (0.03, 0.0, 0.0))
        places = physics.named.data.xpos
        x, y, _ = places["car"]
        z, across, height = places["track_car"] - places["track"]
        assert (x, y) == (0.1, -0.9)
        assert (z, across) == pytest.approx((0.3, 0.0)) and abs(height - math.sin(3 * z) / 3) < 0.01
        assert (places["track_goal"] - places["track"])[[0, 2]] == pytest.approx((0.5, math.sin(1.5) / 3), abs=1e-3)
        assert places["goal"] == pytest.approx((0.5, 0.5, 0.4 * math.sin(1.5)), abs=1e-3)

    @pytest.mark.parametrize("n_axes", [1, 2])
    def test_the_flag_stands_where_the_goal_begins(self, n_axes):
        physics = combrel_envs.load("mountain_car", f"climb_{2 * n_axes}d").physics
        place = physics.named.data.xpos["goal"]
        assert place[:n_axes].tolist() == [0.5] * n_axes
        scale = {1: 1 / 3, 2: 0.2}[n_axes]
        assert place[2] == pytest.approx(scale * n_axes * math.sin(1.5), abs=1e-3)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("mountain_bike", "climb_2d"), "domain must be one of 'mountain_car'"),
            (("mountain_car", "climb"), "must be one of 'climb_2d', 'climb_4d', 'climb_6d', got 'climb'"),
            (("mountain_car", "climb_2d", {"start": "top"}), "start must be one of"),
        ],
    )
    def test_wrong_domains_tasks_and_starts_are_errors(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            combrel_envs.load(*arguments)
