"""Learning that is killed goes on from its last checkpoint."""

import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from helpers.walk import Walk

from sb3_combrel import FittedRMax

SCRIPT = """
import sys
from stable_baselines3.common.callbacks import CheckpointCallback
from helpers.walk import METHODS, small
small(transfer=METHODS["COMBREL"]()).learn(10**9, callback=CheckpointCallback(40, sys.argv[1], "at"))
"""


def checkpoints(folder):
    return sorted(folder.glob("at_*_steps.zip"), key=lambda path: int(re.findall(r"\d+", path.name)[-1]))


@pytest.mark.long
def test_after_kill_9_learning_goes_on_from_the_last_checkpoint(tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    learning = subprocess.Popen([sys.executable, "-c", SCRIPT, str(tmp_path)], env=environment, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 120
        while len(checkpoints(tmp_path)) < 5 and time.monotonic() < deadline and learning.poll() is None:
            # At whatever moment one looks, what is there is whole.
            assert all(zipfile.ZipFile(path).testzip() is None for path in checkpoints(tmp_path))
    finally:
        learning.send_signal(signal.SIGKILL)
        _, complaints = learning.communicate()
    assert learning.returncode == -signal.SIGKILL, complaints.decode()
    n = 40 * len(checkpoints(tmp_path))
    assert n >= 200
    model = FittedRMax.load(checkpoints(tmp_path)[-1], env=Walk())
    assert model.agent.model.n_instances == n
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps == model.agent.model.n_instances == n + 100
