"""Mountain Car: the equations, starts, noise, and its dm_control physics."""

import math
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from helpers.environments import ARM, CAR_2D, CAR_4D, CAR_6D, CARS, EXPECTED, TORSO, observations, plan_of
from helpers.mountain_cars import env_in, expected_step, possible_states
from hypothesis import given, settings
from hypothesis import strategies as st

import combrel_envs
from combrel_envs import icub_tasks

BOTTOM = -math.pi / 6
N_AXES = {CAR_2D: 1, CAR_4D: 2, CAR_6D: 3}


class TestDynamics:
    @pytest.mark.parametrize("env_id", CARS)
    @settings(max_examples=50)
    @given(data=st.data())
    def test_a_step_follows_the_equations(self, env_id, data):
        state = data.draw(possible_states(N_AXES[env_id]))
        action, env = data.draw(st.integers(0, 2 * N_AXES[env_id])), env_in(env_id, state)
        env.step(action)
        np.testing.assert_allclose(env.unwrapped.state, expected_step(state, action), rtol=0, atol=1e-15)

    def test_2d_moves_as_gymnasiums_mountain_car(self):
        reference = gymnasium.make("MountainCar-v0", max_episode_steps=2000).unwrapped
        reference.reset(seed=0)
        env, done = env_in(CAR_2D, list(reference.state)), False
        actions = iter(np.repeat(np.random.default_rng(0).integers(3, size=100), 15).tolist())
        while not done and (action := next(actions, None)) is not None:
            done = reference.step({0: 1, 1: 0, 2: 2}[action])[2]
            assert env.step(action)[2] == done
            np.testing.assert_allclose(env.unwrapped.state, reference.state, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("env_id", [CAR_4D, CAR_6D])
    def test_every_axis_must_be_at_the_goal(self, env_id):
        n_axes = N_AXES[env_id]
        still = [0.0] * n_axes
        for missing in range(n_axes):
            env = env_in(env_id, [0.3 if axis == missing else 0.55 for axis in range(n_axes)] + still)
            assert not env.step(0)[2]
        assert env_in(env_id, [0.55] * n_axes + still).step(0)[2]


class TestStarts:
    @pytest.mark.parametrize("env_id", CARS)
    def test_starts_are_where_the_manual_says(self, env_id):
        def starts(start):
            env = gymnasium.make(env_id, start=start)
            env.reset(seed=0)
            return np.array([(env.reset(), env.unwrapped.state)[1] for _ in range(1000)])

        n, (low, high) = N_AXES[env_id], (EXPECTED[env_id].low, EXPECTED[env_id].high)
        assert np.all(starts("fixed") == [BOTTOM] * n + [0.0] * n)
        offset = starts("offset")
        assert np.all(offset[:, :n] == offset[:, :1]) and np.all(offset[:, n:] == 0)
        lowest, highest = offset[:, 0].min() - BOTTOM, offset[:, 0].max() - BOTTOM
        assert -0.005 <= lowest < -0.004 and 0.004 < highest <= 0.005
        share = (starts("random") - low) / (np.array(high) - low)
        assert np.all(share.min(axis=0) < 0.02) and np.all(share.max(axis=0) > (0.9 if n == 1 else 0.98))
        assert not np.any(np.all(share[:, :n] >= 1.7 / 1.8, axis=1))

    @pytest.mark.parametrize("env_id", CARS)
    @pytest.mark.parametrize("start", ["offset", "random"])
    def test_a_seed_decides_the_starts_of_both_interfaces(self, env_id, start):
        env, other = gymnasium.make(env_id, start=start), gymnasium.make(env_id, start=start)
        first = [env.reset(seed=7)[0], env.reset()[0]]
        assert np.array_equal(first, [other.reset(seed=7)[0], other.reset()[0]])
        assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[0], env.reset(seed=8)[0])

        def starts(seed):
            environment = combrel_envs.load("mountain_car", EXPECTED[env_id].task[1], {"random": seed, "start": start})
            return [environment.reset().observation["position"].tolist() for _ in range(3)]

        assert starts(1) == starts(np.random.RandomState(1)) != starts(2)

    def test_reset_options_override_the_start_for_one_episode(self):
        env = gymnasium.make(CAR_4D, start="fixed")
        env.reset(seed=0, options={"start": "random"})
        assert env.unwrapped.state[2] != 0
        env.reset()
        assert env.unwrapped.state.tolist() == [BOTTOM, BOTTOM, 0, 0]

    @settings(max_examples=50)
    @given(state=possible_states(2))
    def test_any_observation_can_be_given_back_as_a_state(self, state):
        env = gymnasium.make(CAR_4D)
        observation, _ = env.reset(options={"state": np.float32(state)})
        np.testing.assert_array_equal(observation, np.float32(state))
        assert np.all(np.abs(env.unwrapped.state) <= [1.2, 1.2, 0.07, 0.07])

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"start": "top"}, "start must be one of 'offset', 'fixed', 'random', got 'top'"),
            ({"state": [0.0, 0.0]}, r"4 numbers \(x, y, vx, vy\) between"),
            ({"state": [0.0, 0.0, 0.0, 0.1]}, "numbers .* between"),
            ({"state": [0.0, math.nan, 0.0, 0.0]}, "numbers .* between"),
            ({"state": "here"}, "must be numbers"),
            ({"begin": "fixed"}, "'start' or 'state'"),
            ({"state": [0.0, 0.0, 0.0, 0.0], "start": "fixed"}, "'start' or 'state'"),
        ],
    )
    def test_wrong_reset_options_are_errors(self, options, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(CAR_4D).reset(options=options)


class TestActionNoise:
    """In the middle of the slope the velocity after one step tells which action was executed."""

    STEPS = 1000

    def gymnasium_states(self, env_id, action_noise, action, seed):
        env = gymnasium.make(env_id, action_noise=action_noise).unwrapped
        env.reset(seed=seed)
        for _ in range(self.STEPS):
            env.reset(options={"state": [-0.5] * N_AXES[env_id] + [0.0] * N_AXES[env_id]})
            env.step(action)
            yield env.state

    def dm_control_states(self, env_id, action_noise, action, seed):
        task_kwargs = {"action_noise": action_noise, "random": seed}
        environment = combrel_envs.load("mountain_car", EXPECTED[env_id].task[1], task_kwargs, {"flat_observation": True})
        environment.reset()
        for _ in range(self.STEPS):
            environment.physics.set_car([-0.5] * N_AXES[env_id], [0.0] * N_AXES[env_id])
            yield environment.step(action).observation["observations"]

    def executed(self, interface, env_id, *arguments):
        n = N_AXES[env_id]
        outcomes = np.array([expected_step([-0.5] * n + [0.0] * n, action) for action in range(2 * n + 1)])
        states = getattr(self, interface)(env_id, *arguments)
        return np.array([np.abs(state - outcomes).sum(axis=1).argmin() for state in states])

    @pytest.mark.parametrize("env_id", CARS)
    @pytest.mark.parametrize("interface", ["gymnasium_states", "dm_control_states"])
    def test_random_actions_come_with_the_given_probability(self, env_id, interface):
        n_actions = 2 * N_AXES[env_id] + 1
        shares = np.bincount(self.executed(interface, env_id, 0.4, 1, 0), minlength=n_actions) / self.STEPS
        expected = np.full(n_actions, 0.4 / n_actions)
        expected[1] += 0.6
        # Four standard deviations.
        np.testing.assert_array_less(np.abs(shares - expected), 4 * np.sqrt(expected * (1 - expected) / self.STEPS))
        assert set(self.executed(interface, env_id, 0.0, 1, 0).tolist()) == {1}

    def test_a_seed_decides_the_random_actions(self):
        first, same, other = (self.executed("gymnasium_states", CAR_6D, 0.5, 0, seed).tolist() for seed in (1, 1, 2))
        assert first == same != other

    def test_without_noise_no_random_numbers_are_drawn(self):
        env = gymnasium.make(CAR_4D).unwrapped
        env.reset(seed=0)
        before = env.np_random.bit_generator.state
        env.step(2)
        assert env.np_random.bit_generator.state == before

    @pytest.mark.parametrize("action_noise", [-0.1, 1.1, float("nan"), True, "much", None])
    def test_only_probabilities_are_possible(self, action_noise):
        with pytest.raises(ValueError, match=r"action_noise must be a probability, .* got "):
            gymnasium.make(CAR_2D, action_noise=action_noise)


class TestPhysics:
    def test_environment_kwargs_reach_the_environment(self):
        environment = combrel_envs.load(
            "mountain_car", "climb_4d", {"start": "fixed"}, {"flat_observation": True, "n_sub_steps": 2}
        )
        assert environment.reset().observation["observations"].shape == (4,) and environment.control_timestep() == 2
        expected = expected_step(expected_step([BOTTOM, BOTTOM, 0, 0], 2), 2)
        np.testing.assert_allclose(environment.step(2).observation["observations"], expected, rtol=0, atol=1e-15)

    def test_states_can_be_saved_and_restored(self):
        physics = combrel_envs.load("mountain_car", "climb_4d", {"start": "fixed"}).physics
        with physics.reset_context():
            physics.set_car((0.1, -0.2), (0.03, 0.04))
        state = physics.get_state()
        physics.set_control([1.0, 0.0])
        physics.step(10)
        assert physics.control().tolist() == [1.0, 0.0] and physics.time() == 10
        physics.set_state(state)
        assert physics.car_position().tolist() == [0.1, -0.2] and physics.car_velocity().tolist() == [0.03, 0.04]

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


# Pictures of both domains, the robot's meshes, and what happens without OpenGL.
ASSETS = Path(combrel_envs.__file__).parent / "assets"
# Of the robot, what must be seen; of the hand, the geom that strikes.
PARTS = ("head", "chest", "r_forearm", "l_forearm", "r_fingers", "ball", "table_top")
NO_MESHES = pytest.mark.skipif(find_spec("icub_models") is None, reason="needs icub-models")


def changed(before, after):
    """Share of the pixels that differ."""
    return np.mean(np.any(np.abs(before.astype(int) - after) > 30, axis=-1))


class TestMountainCar:
    @pytest.mark.parametrize(("env_id", "camera"), [(CAR_2D, "side"), (CAR_4D, "top"), (CAR_6D, "perspective")])
    def test_every_axis_is_in_the_picture(self, env_id, camera):
        env = gymnasium.make(env_id, render_mode="rgb_array", width=160, height=120, camera=camera)
        n = len(EXPECTED[env_id].low) // 2
        places = [[-0.5] * n, *([0.2 if i == axis else -0.5 for i in range(n)] for axis in range(n))]
        pictures = []
        for place in places:
            env.reset(options={"state": place + [0.0] * n})
            pictures.append(env.render())
        env.close()
        assert pictures[0].shape == (120, 160, 3) and pictures[0].dtype == np.uint8 and pictures[0].std() > 20
        assert all(0.001 < changed(pictures[0], other) < 0.1 for other in pictures[1:])

    def test_both_interfaces_draw_the_same_picture_however_large(self):
        env = gymnasium.make(CAR_2D, render_mode="rgb_array", width=2600, height=100, camera="close", start="fixed")
        environment = combrel_envs.load("mountain_car", "climb_2d", {"start": "fixed"})
        environment.physics.model.vis.global_.offwidth = 2600
        env.reset()
        environment.reset()
        env.step(2)
        environment.step(2)
        assert np.array_equal(env.render(), environment.physics.render(height=100, width=2600, camera_id="close"))
        env.close()

    def test_rendering_without_a_mode_warns(self):
        with pytest.warns(UserWarning, match="render_mode"):
            assert gymnasium.make(CAR_2D).unwrapped.render() is None


def test_a_goal_on_the_last_step_of_the_time_limit_is_an_end():
    def last(limit):
        environment = combrel_envs.load("mountain_car", "climb_2d", {"start": "fixed", "random": 0, "time_limit": limit})
        time_step, n = environment.reset(), 0
        while not time_step.last():
            time_step, n = environment.step(2 if time_step.observation["velocity"][0] > 0.0 else 0), n + 1
        return time_step.discount, n

    discount, n_steps = last(4000)
    assert discount == 0.0 and last(n_steps) == (0.0, n_steps) and last(n_steps - 1) == (1.0, n_steps - 1)


class TestICub:
    @pytest.mark.parametrize(("env_id", "look"), [(TORSO, "primitives"), pytest.param(ARM, "meshes", marks=NO_MESHES)])
    def test_robot_table_ball_and_striking_hand_are_in_the_picture(self, env_id, look):
        environment = combrel_envs.load("icub", EXPECTED[env_id].task[1], {"look": look})
        environment.reset()
        for action in plan_of(env_id)[:-1]:
            environment.step(action)
        physics = environment.physics
        ids = physics.render(height=480, width=640, camera_id="front", segmentation=True)[..., 0]
        border = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
        pixels = {physics.model.id2name(int(each), "geom"): np.count_nonzero(ids == each) for each in np.unique(ids[ids >= 0])}
        of_meshes = {part: f"{part}_mesh_0" for part in PARTS if part not in ("ball", "table_top")}
        of_meshes["r_fingers"] = "r_hand_mesh_0"
        drawn = [of_meshes.get(part, part) if look == "meshes" else part for part in PARTS]
        assert all(pixels.get(name, 0) > 150 for name in drawn), pixels
        # Nothing is cut off but the floor and the table's legs, which have no name.
        assert {physics.model.id2name(int(each), "geom") for each in np.unique(border[border >= 0])} <= {"floor", ""}
        environment.close()
        physics.free()

    @pytest.mark.parametrize("look", ["primitives", pytest.param("meshes", marks=NO_MESHES)])
    def test_the_picture_is_well_lit_and_shows_the_strike_which_it_doesnt_change(self, look):
        env = gymnasium.make(TORSO, render_mode="rgb_array", look=look, width=320, height=240)
        seen, before = [env.reset()[0].tolist()], env.render()
        seen += [env.step(action)[0].tolist() for action in plan_of(TORSO)]
        after = env.render()
        env.close()
        assert before.shape == (240, 320, 3) and before.dtype == np.uint8
        assert 90 < before.mean() < 190 and before.std() > 25
        assert np.mean(before > 250) < 0.05 and np.mean(before < 10) < 0.02 and 0.01 < changed(before, after) < 0.3
        # Neither drawing nor the look changes an episode.
        assert seen == observations(TORSO, plan_of(TORSO))

    def test_meshes_lie_where_the_primitives_are(self):
        pytest.importorskip("icub_models")
        plain, shaped = (combrel_envs.load("icub", "arm_strike", {"look": look}).physics for look in icub_tasks.LOOKS)
        for physics in (plain, shaped):
            with physics.reset_context():
                physics.set_joints((-60, 50, 20, 40))
        for part in ("head", "chest", "r_forearm", "r_upper_arm", "r_elbow_1", "l_forearm"):
            name = {"r_upper_arm": "r_shoulder_3_mesh_1"}.get(part, f"{part}_mesh_0")
            # MuJoCo puts a mesh's frame at its centre, as the primitives fitted to it are.
            distance = np.linalg.norm(plain.named.data.geom_xpos[part] - shaped.named.data.geom_xpos[name])
            assert distance < 0.02, part

    def test_missing_meshes_are_an_error_that_says_what_to_install(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "icub_models", None)
        with pytest.raises(ModuleNotFoundError, match=r"look='meshes' needs icub_models.*'sb3-combrel\[icub\]'"):
            gymnasium.make(TORSO, look="meshes")

    def test_the_hand_is_drawn_where_the_encoders_say(self):
        environment = combrel_envs.load("icub", "arm_strike")
        environment.reset()
        for action in plan_of(ARM)[:10]:
            environment.step(action)
        physics = environment.physics
        physics.render(height=48, width=64)
        drawn = physics.named.data.geom_xpos["r_fingers"].copy()
        physics.forward()
        np.testing.assert_allclose(drawn, physics.named.data.geom_xpos["r_fingers"], atol=1e-9)
        physics.free()

    def test_the_model_names_its_licence_and_authors(self):
        for text in ((ASSETS / "icub_upper.xml").read_text(), (ASSETS / "icub_upper.LICENSE.md").read_text()):
            assert "CC BY-SA 4.0" in text and "https://creativecommons.org/licenses/by-sa/4.0/" in text
            assert "Istituto Italiano di Tecnologia" in text and "icub-models" in text and "3.2.0" in text
            assert "Changes:" in text


def test_record_video_writes_a_film(tmp_path):
    env = gymnasium.make(TORSO, render_mode="rgb_array", width=64, height=48, max_episode_steps=3)
    env = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True)
    assert env.metadata["render_fps"] == 10
    env.reset(seed=0)
    for _ in range(3):
        env.step(2)
    env.close()
    films = list(tmp_path.glob("films/*.mp4"))
    assert len(films) == 1 and films[0].stat().st_size > 500


# Of the context that MuJoCo could not make.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_picture_that_is_too_large_says_so_and_smaller_ones_are_drawn_afterwards():
    envs = [gymnasium.make(TORSO, render_mode="rgb_array", width=width, height=48) for width in (200_000, 64)]
    for env in envs:
        env.reset()
    with pytest.raises(combrel_envs.RenderingError, match="width and height must be smaller: 200000 x 960 pixels are too"):
        envs[0].render()
    assert envs[1].render().shape == (48, 64, 3)


@pytest.mark.skipif(sys.platform == "win32", reason="no processes are forked there")
@pytest.mark.parametrize("env_id", [CAR_4D, TORSO])
def test_a_process_that_is_forked_after_drawing_says_so_instead_of_hanging(env_id):
    code = f"""
import os, combrel_envs, gymnasium
envs = [gymnasium.make("{env_id}", render_mode="rgb_array", width=64, height=48) for _ in range(2)]
for env in envs:
    env.reset()
print(envs[0].render().shape, flush=True)
if os.fork() == 0:
    for env in envs:
        try:
            env.render()
        except combrel_envs.RenderingError as error:
            print(error, flush=True)
    os._exit(0)
os.wait()
"""
    assert run(code).count("(48, 64, 3)\nRendering hangs in a process that was forked after") == 1
    assert run(code.replace("print(envs[0].render().shape, flush=True)", "")) == "", "the first to draw is the forked one"


def run(code, **variables):
    """What a Python process prints."""
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_opengl_all_but_pictures_works_and_the_error_says_what_to_install():
    code = """
import sys, combrel_envs, gymnasium
drawn = []
for env_id in ("combrel/MountainCar4D-v0", "combrel/ICubTorsoStrike-v0"):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    env.reset()
    env.step(2)
    # Stepping Mountain Car needs none of these.
    print("imported" if "Car" in env_id and {"mujoco", "dm_control", "PIL"} & set(sys.modules) else "ready")
    drawn += [env.render, env.render]
for task in (("mountain_car", "climb_4d"), ("icub", "arm_strike")):
    environment = combrel_envs.load(*task)
    environment.reset()
    environment.step(2)
    drawn.append(environment.physics.render)
for draw in drawn:
    try:
        draw()
    except combrel_envs.RenderingError as error:
        print(error)
"""
    printed = run(code, MUJOCO_GL="no-such-backend", PATH="")
    assert printed.count("ready\n") == 2 and "imported" not in printed
    assert printed.count("apt-get install libegl1 libgl1-mesa-dri") == printed.count("set MUJOCO_GL=egl") == 6


def test_triton_is_loaded_before_dm_control_loads_mesa(tmp_path):
    """The other way round the process ends with a segmentation fault when PyTorch's wheel for CUDA makes an optimizer."""
    (tmp_path / "triton.py").write_text(
        "import sys\nprint('triton', 'dm_control.mujoco' in sys.modules)\nraise OSError('no driver')\n"
    )
    code = "import combrel_envs; combrel_envs.load('icub', 'arm_strike').reset(); print('ready')"
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    assert run(code, PYTHONPATH=path).split("\n")[:2] == ["triton False", "ready"]


@pytest.mark.long
def test_dqn_learns_a_task_that_mujoco_simulates():
    """With PyTorch's wheel for CUDA this is where the process would end."""
    code = "import combrel_envs\nfrom stable_baselines3 import DQN\n"
    run(code + "DQN('MlpPolicy', 'combrel/ICubArmStrike-v0', buffer_size=100, seed=0).learn(20)\n")
