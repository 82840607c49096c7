"""What must be loaded before OpenGL."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("broken", [False, True])
def test_triton_is_loaded_before_dm_control_loads_mesa(broken, tmp_path):
    """The other way round the process ends with a segmentation fault when PyTorch's wheel for CUDA makes an optimizer."""
    (tmp_path / "triton.py").write_text(
        "import sys\nprint('triton', 'dm_control.mujoco' in sys.modules)\n" + ("raise OSError('no driver')" if broken else "")
    )
    code = "import combrel_envs; combrel_envs.load('icub', 'arm_strike').reset(); print('ready')"
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, check=True, capture_output=True, text=True
    )
    assert done.stdout.split("\n")[:2] == ["triton False", "ready"]


def test_dqn_learns_a_task_that_mujoco_simulates():
    """With PyTorch's wheel for CUDA this is where the process would end."""
    code = (
        "import combrel_envs\n"
        "from stable_baselines3 import DQN\n"
        "DQN('MlpPolicy', 'combrel/ICubArmStrike-v0', buffer_size=100, seed=0).learn(20)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
