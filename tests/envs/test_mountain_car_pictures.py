"""Pictures and films of Mountain Car."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from helpers.mountain_cars import ID_2D, ID_4D, ID_6D

import combrel_envs

pytestmark = pytest.mark.integration


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

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("camera", ["perspective", "top"])
    def test_every_axis_of_6d_is_in_the_picture(self, axis, camera):
        env = gymnasium.make(ID_6D, render_mode="rgb_array", width=160, height=120, camera=camera, start="fixed")
        pictures = []
        for position in (-0.9, 0.2):
            env.reset(options={"state": [position if i == axis else -0.5 for i in range(3)] + [0.0] * 3})
            pictures.append(env.render().astype(int))
        env.close()
        assert np.mean(np.any(np.abs(pictures[0] - pictures[1]) > 30, axis=-1)) > 0.001

    def test_both_interfaces_draw_the_same_picture(self):
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
