"""Mountain Car: the equations, known plans, both faces, starts, seeds, conventions and pictures."""

import math
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from gymnasium.wrappers import RecordVideo
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import combrel_envs
from combrel_envs import mountain_car_dynamics as dynamics

ID_2D, ID_4D = "combrel/MountainCar2D-v0", "combrel/MountainCar4D-v0"
IDS = (ID_2D, ID_4D)
TASKS = {ID_2D: "climb_2d", ID_4D: "climb_4d"}
BOTTOM = -math.pi / 6

# Found by search over the equations, from rest at the bottom; "19 Right" is 19 steps of Right.
PLAN_2D = "19 Right, 36 Left, 2 Neutral, 45 Right, 1 Neutral"
PLAN_4D = "9 West, 21 North, 16 East, 21 South, 20 West, 25 North, 27 East, 6 North, 1 Neutral"
PLANS = {ID_2D: PLAN_2D, ID_4D: PLAN_4D}


def actions_of(plan, env):
    """The numbers of the actions of a plan."""
    runs = (run.split() for run in plan.split(", "))
    return [env.unwrapped.action_names.index(name) for count, name in runs for _ in range(int(count))]


def expected_step(state, action):
    """The equations of the task, written down a second time, with arrays."""
    state = np.asarray(state, dtype=np.float64)
    n = len(state) // 2
    force = np.zeros(n)
    if action > 0:
        axis, direction = (action - 1) // 2, (action - 1) % 2
        force[axis] = 0.001 if direction else -0.001
    v = np.clip(state[n:] + force - 0.0025 * np.cos(3.0 * state[:n]), -0.07, 0.07)
    x = np.clip(state[:n] + v, -1.2, 0.6)
    into_wall = ((x == -1.2) & (v < 0)) | ((x == 0.6) & (v > 0))
    return np.concatenate([x, np.where(into_wall, 0.0, v)])


def possible_states(n_axes):
    positions = st.lists(st.floats(-1.2, 0.6), min_size=n_axes, max_size=n_axes)
    velocities = st.lists(st.floats(-0.07, 0.07), min_size=n_axes, max_size=n_axes)
    return st.builds(lambda x, v: x + v, positions, velocities)


def env_in(env_id, state, **kwargs):
    env = gymnasium.make(env_id, **kwargs)
    env.reset(options={"state": state})
    return env


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
    def test_an_axis_doesnt_feel_the_other(self, state, action):
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
    def test_both_faces_go_through_the_same_bits(self, env_id):
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


class TestEpisodes:
    @pytest.mark.parametrize("env_id", IDS)
    def test_4000_steps_truncate_and_dont_terminate(self, env_id):
        env = gymnasium.make(env_id)
        assert env.spec.max_episode_steps == 4000
        env.reset(seed=0)
        ends = [env.step(0)[2:4] for _ in range(4000)]
        assert ends == [(False, False)] * 3999 + [(False, True)]

    def test_make_can_set_another_limit(self):
        env = gymnasium.make(ID_4D, max_episode_steps=7)
        env.reset(seed=0)
        assert env.spec.max_episode_steps == 7
        assert [env.step(0)[3] for _ in range(7)] == [False] * 6 + [True]

    def test_a_hit_on_the_very_last_step_terminates(self):
        env = gymnasium.make(ID_2D, start="fixed", max_episode_steps=103)
        env.reset()
        assert [env.step(action)[2] for action in actions_of(PLAN_2D, env)][-1]

    @pytest.mark.parametrize("env_id", IDS)
    def test_stepping_before_the_first_reset_is_an_error(self, env_id):
        with pytest.raises(ResetNeeded):
            gymnasium.make(env_id).unwrapped.step(0)

    @pytest.mark.parametrize("action", [-1, 5, 1.0, "East", None, np.array([1])])
    def test_impossible_actions_are_errors(self, action):
        env = gymnasium.make(ID_4D)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action must be an integer from 0 to 4"):
            env.step(action)

    def test_all_kinds_of_integers_are_actions(self):
        for action in (2, np.int64(2), np.array(2), np.uint8(2)):
            env = env_in(ID_4D, [-0.5, -0.5, 0.0, 0.0])
            env.step(action)
            assert env.unwrapped.state[2] > env.unwrapped.state[3]


class TestStarts:
    @pytest.mark.parametrize("env_id", IDS)
    def test_fixed_is_the_bottom(self, env_id):
        env = gymnasium.make(env_id, start="fixed")
        env.reset(seed=3)
        positions, velocities = np.split(env.unwrapped.state, 2)
        assert np.all(positions == BOTTOM) and np.all(velocities == 0)

    @pytest.mark.parametrize("env_id", IDS)
    def test_offset_is_the_default_and_the_same_on_every_axis(self, env_id):
        env = gymnasium.make(env_id)
        env.reset(seed=0)
        offsets = []
        for _ in range(200):
            env.reset()
            positions, velocities = np.split(env.unwrapped.state, 2)
            assert np.all(positions == positions[0]) and np.all(velocities == 0)
            offsets.append(positions[0] - BOTTOM)
        assert -0.005 <= min(offsets) < -0.004 and 0.004 < max(offsets) <= 0.005

    @pytest.mark.parametrize("env_id", IDS)
    def test_random_covers_the_space_but_the_goal(self, env_id):
        env = gymnasium.make(env_id, start="random")
        env.reset(seed=0)
        starts = []
        for _ in range(1500):
            env.reset()
            starts.append(env.unwrapped.state)
        starts = np.array(starts)
        low, high = env.observation_space.low, env.observation_space.high
        assert np.all(starts.min(axis=0) < low + 0.02 * (high - low))
        if env_id == ID_4D:
            assert np.all(starts.max(axis=0) > high - 0.02 * (high - low))
        assert not np.any(np.all(starts[:, : starts.shape[1] // 2] >= 0.5, axis=1))

    @pytest.mark.parametrize("env_id", IDS)
    @pytest.mark.parametrize("start", ["offset", "random"])
    def test_a_seed_decides_the_starts(self, env_id, start):
        env, other = gymnasium.make(env_id, start=start), gymnasium.make(env_id, start=start)
        first = [env.reset(seed=7)[0], env.reset()[0]]
        again = [other.reset(seed=7)[0], other.reset()[0]]
        assert np.array_equal(first, again)
        assert not np.array_equal(first[0], first[1])
        assert not np.array_equal(first[0], env.reset(seed=8)[0])

    def test_reset_options_override_the_start_for_one_episode(self):
        env = gymnasium.make(ID_4D, start="fixed")
        env.reset(seed=0, options={"start": "random"})
        assert env.unwrapped.state[2] != 0
        env.reset()
        assert env.unwrapped.state.tolist() == [BOTTOM, BOTTOM, 0, 0]

    @given(state=possible_states(2))
    def test_any_observation_can_be_given_back_as_a_state(self, state):
        env = gymnasium.make(ID_4D)
        observation, _ = env.reset(options={"state": np.float32(state)})
        np.testing.assert_array_equal(observation, np.float32(state))
        assert np.all(np.abs(env.unwrapped.state) <= [1.2, 1.2, 0.07, 0.07])

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"start": "top"}, "start must be one of 'offset', 'fixed', 'random', got 'top'"),
            ({"state": [0.0, 0.0]}, r"4 entries \(x, y, vx, vy\)"),
            ({"state": [0.0, 0.0, 0.0, 0.1]}, "must lie between"),
            ({"state": [0.0, math.nan, 0.0, 0.0]}, "must lie between"),
            ({"state": "here"}, "must be numbers"),
            ({"begin": "fixed"}, "'start' or 'state'"),
            ({"state": [0.0, 0.0, 0.0, 0.0], "start": "fixed"}, "'start' or 'state'"),
        ],
    )
    def test_wrong_reset_options_are_errors(self, options, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(ID_4D).reset(options=options)

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"start": "top"}, "start must be one of"),
            ({"width": 0}, "width must be"),
            ({"camera": "front"}, "camera must be one of 'perspective', 'top', 'close', got 'front'"),
        ],
    )
    def test_wrong_arguments_are_errors(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(ID_4D, **kwargs)


class TestGymnasiumFace:
    @pytest.mark.parametrize("env_id", IDS)
    def test_gymnasiums_checker_has_nothing_to_say(self, env_id):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_gymnasium_env(gymnasium.make(env_id, render_mode="rgb_array", width=64, height=48).unwrapped)

    @pytest.mark.parametrize("env_id", IDS)
    @pytest.mark.parametrize("start", dynamics.STARTS)
    def test_sb3s_checker_has_nothing_to_say(self, env_id, start):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_sb3_env(gymnasium.make(env_id, start=start))

    def test_the_spaces_have_the_true_bounds(self):
        env = gymnasium.make(ID_4D)
        np.testing.assert_array_equal(env.observation_space.high, np.float32([0.6, 0.6, 0.07, 0.07]))
        np.testing.assert_array_equal(env.observation_space.low, np.float32([-1.2, -1.2, -0.07, -0.07]))
        assert env.action_space == gymnasium.spaces.Discrete(5)
        assert env.observation_space.dtype == np.float32

    @pytest.mark.parametrize("env_id", IDS)
    def test_the_names_fit_the_spaces(self, env_id):
        env = gymnasium.make(env_id).unwrapped
        assert len(env.state_names) == env.observation_space.shape[0]
        assert len(env.action_names) == env.action_space.n

    def test_stepping_without_pictures_imports_neither_mujoco_nor_dm_control(self):
        code = (
            "import sys, gymnasium, combrel_envs; env = gymnasium.make('combrel/MountainCar4D-v0'); env.reset(); env.step(0);"
            "sys.exit(any(name in sys.modules for name in ('mujoco', 'dm_control', 'PIL')))"
        )
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class TestDmControlFace:
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
            (("mountain_car", "climb"), "must be one of 'climb_2d', 'climb_4d', got 'climb'"),
            (("mountain_car", "climb_2d", {"start": "top"}), "start must be one of"),
        ],
    )
    def test_wrong_names_are_errors(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            combrel_envs.load(*arguments)


class TestPictures:
    @pytest.mark.parametrize(("env_id", "camera"), [(ID_2D, None), (ID_2D, "close"), (ID_4D, None), (ID_4D, "top")])
    def test_the_car_moves_in_the_picture(self, env_id, camera):
        env = gymnasium.make(env_id, render_mode="rgb_array", width=160, height=120, camera=camera, start="fixed")
        env.reset()
        before, same = env.render(), env.render()
        for _ in range(30):
            env.step(2)
        after = env.render()
        env.close()
        assert before.shape == (120, 160, 3) and before.dtype == np.uint8
        assert before.std() > 20
        assert np.array_equal(before, same)
        changed = np.mean(np.any(np.abs(before.astype(int) - after) > 30, axis=-1))
        assert 0.001 < changed < (0.6 if camera == "close" else 0.1)

    def test_both_faces_draw_the_same_picture(self):
        env = gymnasium.make(ID_4D, render_mode="rgb_array", width=160, height=120, start="fixed")
        environment = combrel_envs.load("mountain_car", "climb_4d", {"start": "fixed"})
        env.reset()
        environment.reset()
        env.step(2)
        environment.step(2)
        picture = environment.physics.render(height=120, width=160, camera_id="perspective")
        assert np.array_equal(env.render(), picture)
        env.close()

    def test_pictures_can_be_large(self):
        env = gymnasium.make(ID_2D, render_mode="rgb_array", width=2600, height=100)
        env.reset(seed=0)
        assert env.render().shape == (100, 2600, 3)
        env.close()

    def test_drawing_doesnt_change_the_episode(self):
        drawn = gymnasium.make(ID_2D, render_mode="rgb_array", width=64, height=48)
        plain = gymnasium.make(ID_2D)
        drawn.reset(seed=0)
        plain.reset(seed=0)
        for action in (2, 2, 1, 0):
            drawn.render()
            drawn.step(action)
            plain.step(action)
        assert drawn.unwrapped.state.tolist() == plain.unwrapped.state.tolist()
        drawn.close()
        drawn.close()

    def test_record_video_writes_a_film(self, tmp_path):
        env = gymnasium.make(ID_2D, render_mode="rgb_array", width=160, height=128, max_episode_steps=10)
        env = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True)
        env.reset(seed=0)
        for _ in range(10):
            env.step(2)
        env.close()
        films = list(tmp_path.glob("films/*.mp4"))
        assert len(films) == 1 and films[0].stat().st_size > 1000

    def test_rendering_without_a_mode_warns(self):
        env = gymnasium.make(ID_2D).unwrapped
        env.reset(seed=0)
        with pytest.warns(UserWarning, match="render_mode"):
            assert env.render() is None

    def test_without_opengl_all_but_pictures_works_and_the_error_says_what_to_install(self):
        code = """
import combrel_envs, gymnasium
environment = combrel_envs.load("mountain_car", "climb_4d")
environment.reset()
environment.step(2)
env = gymnasium.make("combrel/MountainCar4D-v0", render_mode="rgb_array")
env.reset()
env.step(2)
for draw in (environment.physics.render, env.render, env.render):
    try:
        draw()
    except combrel_envs.RenderingError as error:
        print(error)
"""
        environ = {"MUJOCO_GL": "no-such-backend", "PATH": ""}
        output = subprocess.run([sys.executable, "-c", code], env=environ, check=True, capture_output=True, text=True).stdout
        assert output.count("apt-get install libegl1 libgl1-mesa-dri") == 3
        assert output.count("set MUJOCO_GL=egl") == 3
