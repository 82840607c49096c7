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
small(transfer=METHODS[sys.argv[1]]()).learn(10**9, callback=CheckpointCallback(40, sys.argv[2], "at"))
"""


def checkpoints(folder):
    return sorted(folder.glob("at_*_steps.zip"), key=lambda path: int(re.findall(r"\d+", path.name)[-1]))


@pytest.mark.integration
@pytest.mark.parametrize("name", ["none", "COMBREL"])
def test_after_kill_9_learning_goes_on_from_the_last_checkpoint(name, tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    learning = subprocess.Popen([sys.executable, "-c", SCRIPT, name, str(tmp_path)], env=environment, stderr=subprocess.PIPE)
    looks = 0
    try:
        deadline = time.monotonic() + 120
        while len(checkpoints(tmp_path)) < 5 and time.monotonic() < deadline and learning.poll() is None:
            for path in checkpoints(tmp_path):
                # At whatever moment one looks, what is there is whole.
                assert zipfile.ZipFile(path).testzip() is None
                looks += 1
    finally:
        learning.send_signal(signal.SIGKILL)
        _, complaints = learning.communicate()
    assert learning.returncode == -signal.SIGKILL, complaints.decode()
    files = checkpoints(tmp_path)
    assert looks > 0 and len(files) >= 5
    for path in files:
        assert FittedRMax.load(path).agent.model.n_instances == int(re.findall(r"\d+", path.name)[-1])
    n = 40 * len(files)
    model = FittedRMax.load(files[-1], env=Walk())
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps == model.agent.model.n_instances == n + 100
    assert (model.policy.transfer is None) == (name == "none")
