"""Pictures of the ball-striking tasks, the meshes, and the model's licence."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from helpers.icub_plans import ARM, IDS, TASKS, TORSO, observations, plan_of

import combrel_envs
from combrel_envs import icub_tasks

pytestmark = pytest.mark.integration

ASSETS = Path(combrel_envs.__file__).parent / "assets"
# Of the robot, what must be seen; of the hand, the geom that strikes.
PARTS = ("head", "chest", "r_forearm", "l_forearm", "r_fingers", "ball", "table_top")


def needs_meshes(look):
    if look == "meshes":
        pytest.importorskip("icub_models")
    return look


def geoms_in_picture(physics):
    """Numbers of pixels of the geoms in the picture, by name, and the names of those at its border."""
    ids = physics.render(height=480, width=640, camera_id="front", segmentation=True)[..., 0]
    border = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
    numbers, counts = np.unique(ids[ids >= 0], return_counts=True)

    def name(number):
        return physics.model.id2name(int(number), "geom")

    pixels = {name(number): int(count) for number, count in zip(numbers, counts, strict=True)}
    return pixels, {name(number) for number in np.unique(border[border >= 0])}


def drawn_name(part, look):
    """Name of the geom that shows a part of the robot."""
    if look == "primitives" or part in ("ball", "table_top"):
        return part
    return {"r_fingers": "r_hand_mesh_0"}.get(part, f"{part}_mesh_0")


@pytest.mark.parametrize("look", icub_tasks.LOOKS)
@pytest.mark.parametrize("env_id", IDS)
class TestPictures:
    def test_robot_table_ball_and_striking_hand_are_in_the_picture(self, env_id, look):
        environment = combrel_envs.load("icub", TASKS[env_id], {"look": needs_meshes(look)})
        for actions in ([], plan_of(env_id)[:-1]):
            environment.reset()
            for action in actions:
                environment.step(action)
            pixels, at_border = geoms_in_picture(environment.physics)
            assert all(pixels.get(drawn_name(part, look), 0) > 150 for part in PARTS), pixels
            # Nothing is cut off but the floor and the table's legs, which have no name.
            assert at_border <= {"floor", ""}
        environment.close()
        environment.physics.free()

    def test_the_picture_is_well_lit_and_shows_the_strike(self, env_id, look):
        env = gymnasium.make(env_id, render_mode="rgb_array", look=needs_meshes(look))
        env.reset()
        before, same = env.render(), env.render()
        for action in plan_of(env_id):
            env.step(action)
        after = env.render()
        env.close()
        assert before.shape == (480, 640, 3) and before.dtype == np.uint8
        assert np.array_equal(before, same)
        assert 90 < before.mean() < 190 and before.std() > 25
        assert np.mean(before > 250) < 0.05 and np.mean(before < 10) < 0.02
        changed = np.mean(np.any(np.abs(before.astype(int) - after) > 30, axis=-1))
        assert 0.01 < changed < 0.3


class TestMeshes:
    @pytest.mark.parametrize("env_id", IDS)
    def test_meshes_change_nothing_but_the_look(self, env_id):
        needs_meshes("meshes")
        rng = np.random.default_rng(0)
        actions = rng.integers(gymnasium.make(env_id).action_space.n, size=200).tolist()
        for sequence in (plan_of(env_id), actions):
            assert observations(env_id, sequence, look="meshes") == observations(env_id, sequence)

    def test_meshes_lie_where_the_primitives_are(self):
        needs_meshes("meshes")
        plain, shaped = (combrel_envs.load("icub", "arm_strike", {"look": look}).physics for look in icub_tasks.LOOKS)
        for physics in (plain, shaped):
            with physics.reset_context():
                physics.set_joints((-60, 50, 20, 40))
        for part in ("head", "chest", "r_forearm", "r_upper_arm", "r_elbow_1", "l_forearm"):
            name = {"r_upper_arm": "r_shoulder_3_mesh_1"}.get(part, f"{part}_mesh_0")
            # MuJoCo puts a mesh's frame at its centre, as the primitives fitted to it are.
            distance = np.linalg.norm(plain.named.data.geom_xpos[part] - shaped.named.data.geom_xpos[name])
            assert distance < 0.02, part


class TestDrawing:
    def test_drawing_doesnt_change_the_episode(self):
        actions = plan_of(TORSO)
        env = gymnasium.make(TORSO, render_mode="rgb_array", width=64, height=48)
        drawn = [env.reset()[0].tolist()]
        for action in actions:
            env.render()
            drawn.append(env.step(action)[0].tolist())
        env.close()
        env.close()
        assert drawn == observations(TORSO, actions)

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

    def test_record_video_writes_a_film(self, tmp_path):
        env = gymnasium.make(TORSO, render_mode="rgb_array", width=160, height=128, max_episode_steps=5, camera="top")
        env = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True)
        assert env.metadata["render_fps"] == 10
        env.reset(seed=0)
        for _ in range(5):
            env.step(2)
        env.close()
        films = list(tmp_path.glob("films/*.mp4"))
        assert len(films) == 1 and films[0].stat().st_size > 1000


def test_the_model_names_its_licence_and_authors():
    for text in ((ASSETS / "icub_upper.xml").read_text(), (ASSETS / "icub_upper.LICENSE.md").read_text()):
        assert "CC BY-SA 4.0" in text and "https://creativecommons.org/licenses/by-sa/4.0/" in text
        assert "Istituto Italiano di Tecnologia" in text and "icub-models" in text and "3.2.0" in text
        assert "Changes:" in text
