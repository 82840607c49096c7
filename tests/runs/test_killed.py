"""Processes that are killed at any moment: what was finished is kept, and the same command goes on from there."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sb3_combrel import FittedRMax
from sb3_combrel.runs.runner import FOLDER

pytestmark = pytest.mark.long

N_KILLS = 50
LEARN = """
import sys
from stable_baselines3.common.callbacks import CheckpointCallback
from sb3_combrel import FittedRMax
path, folder = sys.argv[1:]
model = FittedRMax("MountainCar-v0", seed=0, resolution=4)
keeps = CheckpointCallback(20, folder, "car")
print("begun", flush=True)
while True:
    model.learn(200, callback=keeps, reset_num_timesteps=False)
    model.save(path)
"""
COMPARE = """
import sys, warnings
from pathlib import Path
from sb3_combrel import COMBREL, SourceInstances, compare
if __name__ == "__main__":
    warnings.simplefilter("ignore")
    car, output = "MountainCar-v0", Path(sys.argv[1])
    methods = {"none": None, "COMBREL": COMBREL(SourceInstances.record(None, car, n_instances=300, seed=0))}
    compare(car, methods, seeds=2, steps=1_000, n_jobs=2, output=output, resolution=5).save(output / "report.html")
"""
CLI = ("-m", "sb3_combrel.cli")
DEMO = (*CLI, "demo", "--seeds", "3", "--episodes", "1", "--max-episode-steps", "60", "--workers", "2", "--output")
PAIR = ("--pairs", "mirrored-car", "--methods", "none", "COMBREL", "--seeds", "2")
BENCHMARK = (*CLI, "benchmark", *PAIR, "--jobs", "2", "--output")


def start(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        **options,
    )


def kill(process):
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def test_a_checkpoint_or_a_saved_model_is_whole_whenever_learning_is_killed(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "car.zip"
    loaded = 0
    for _ in range(N_KILLS):
        process = start("-c", LEARN, path, tmp_path)
        assert process.stdout.readline() == b"begun\n"
        time.sleep(rng.uniform(0.0, 1.5))
        kill(process)
        for file in sorted(tmp_path.glob("*.zip")):
            model = FittedRMax.load(file, env="MountainCar-v0")
            assert model.agent.model.n_instances == model.num_timesteps > 0
            loaded += 1
            file.unlink()
    assert loaded >= N_KILLS, "hardly anything was ever saved: this test would find nothing"


def finished_runs(output, found):
    """The results of runs so far, none of which may have changed."""
    for file in (output / FOLDER).glob("*.json"):
        content = json.loads(file.read_text())
        assert found.setdefault(file.name, content) == content, "a finished run was carried out again"
    return found


@pytest.mark.parametrize("command", [DEMO, ("-c", COMPARE), BENCHMARK], ids=["demo", "compare", "benchmark"])
def test_the_same_command_goes_on_however_often_it_is_killed(command, tmp_path):
    began = time.monotonic()
    assert start(*command, tmp_path / "in one go").wait() == 0
    # At any moment of it, whatever the machine: in the first seconds there is nothing to lose.
    seconds = time.monotonic() - began
    rng, output, found = np.random.default_rng(1), tmp_path / "output", {}
    for _ in range(N_KILLS):
        process = start(*command, output)
        try:
            process.wait(timeout=rng.uniform(0.0, seconds))
        except subprocess.TimeoutExpired:
            kill(process)
        finished_runs(output, found)
        if process.returncode == 0:
            break
    assert start(*command, output).wait() == 0
    assert finished_runs(output, found)
    before = {file: file.read_bytes() for file in [*output.rglob("*.csv"), *output.glob("*.html")]}
    assert before and start(*command, output).wait() == 0
    assert {file: file.read_bytes() for file in before} == before
    for page in output.glob("*.html"):  # of a comparison: its page does not tell that it was killed
        assert (tmp_path / "in one go" / page.name).read_bytes() == page.read_bytes()
