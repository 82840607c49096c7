"""Pictures of both domains, the robot's meshes, and what happens without OpenGL."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from helpers.environments import ARM, CAR_2D, CAR_4D, CAR_6D, EXPECTED, TORSO, observations, plan_of

import combrel_envs
from combrel_envs import icub_tasks

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
        seen = [env.reset()[0].tolist()]
        before = env.render()
        seen += [env.step(action)[0].tolist() for action in plan_of(TORSO)]
        after = env.render()
        env.close()
        assert before.shape == (240, 320, 3) and before.dtype == np.uint8
        assert 90 < before.mean() < 190 and before.std() > 25
        assert np.mean(before > 250) < 0.05 and np.mean(before < 10) < 0.02
        assert 0.01 < changed(before, after) < 0.3
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


def run(code, **variables):
    """What a Python process prints."""
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True)
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
