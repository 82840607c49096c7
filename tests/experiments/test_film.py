"""Pictures and films of the iCub's tasks."""

import gymnasium
import numpy as np
import pytest
from PIL import Image

from sb3_combrel.experiments.film import TASK_IDS, film_strike, learn


@pytest.mark.long
def test_the_torso_is_learnt_and_filmed(tmp_path):
    model = learn("torso", n_episodes=20)
    env = gymnasium.make(TASK_IDS["torso"], render_mode="rgb_array", width=160, height=128)
    n_commands = film_strike(model, env, tmp_path / "strike.mp4", tmp_path / "strike.png")
    env.close()
    # The shortest plan known has 26.
    assert 25 <= n_commands <= 40 and np.asarray(Image.open(tmp_path / "strike.png")).shape == (128, 160, 3)
    assert (tmp_path / "strike.mp4").stat().st_size > 1000
