"""Jobs for the tests of the engines; workers import this module by ``PYTHONPATH``."""

import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Job:
    """A job that leaves a file for each time it is begun, with the id of its process."""

    name: str
    folder: Path
    array: Any = None
    dies: int = 0

    def attempts(self):
        """Ids of the processes that have begun it, oldest first."""
        return [int(file.read_text()) for file in sorted(self.folder.glob(f"{self.name}.attempt*.pid"))]

    def begin(self):
        """Leave the file; return how often the job was begun before."""
        before = len(self.attempts())
        unfinished = self.folder / f"{self.name}.unfinished"
        unfinished.write_text(str(os.getpid()))
        unfinished.rename(self.folder / f"{self.name}.attempt{before}.pid")
        return before

    def wait_for_attempt(self, seconds=120):
        """Wait until it has been begun; return the id of its first process."""
        end = time.monotonic() + seconds
        while not self.attempts():
            assert time.monotonic() < end, f"{self.name} was not begun"
            time.sleep(0.05)
        return self.attempts()[0]


def double(job):
    job.begin()
    return 2 * job.array


def wait_for_the_end_first(job):
    """On its first attempts a job with ``dies`` waits until its process is killed."""
    if job.begin() < job.dies:
        sleep(50)
        raise AssertionError("nobody has killed this process")
    return job.name


def kill_itself(job):
    job.begin()
    os.kill(os.getpid(), signal.SIGKILL)
    sleep(20)


def sleep(seconds):
    for _ in range(int(seconds / 0.05)):
        time.sleep(0.05)


def sleep_long(job):
    job.begin()
    sleep(300)


def fail(job):
    job.begin()
    raise FileNotFoundError(2, "No such file", "lost.npz")


def return_a_lock(job):
    return threading.Lock()


def write_into_its_array(job):
    job.array[:] = 1.0
    return job.array


def count_threads(job):
    import torch as th
    from threadpoolctl import threadpool_info

    return os.environ["OMP_NUM_THREADS"], th.get_num_threads(), {library["num_threads"] for library in threadpool_info()}


@dataclass(frozen=True)
class Learning:
    """A short learning run, with COMBREL if there is a source."""

    seed: int
    source: Any = None
    n_steps: int = 300

    @property
    def name(self):
        return f"learning with seed {self.seed}"


def learn(job):
    """What is learned, as arrays and numbers."""
    import gymnasium as gym

    import combrel_envs  # noqa: F401
    from sb3_combrel import COMBREL, FittedRMax

    env = gym.make("combrel/MountainCar2D-v0", max_episode_steps=100)
    transfer = None if job.source is None else COMBREL(job.source)
    model = FittedRMax(env, transfer=transfer, seed=job.seed, resolution=4)
    model.learn(job.n_steps)
    episodes = [(float(episode["r"]), int(episode["l"])) for episode in model.ep_info_buffer]
    states = np.random.default_rng(0).uniform(env.observation_space.low, env.observation_space.high, size=(50, 2))
    actions = [int(model.predict(state.astype(np.float32), deterministic=True)[0]) for state in states]
    parameters = {name: value.numpy() for name, value in model.policy.state_dict().items()}
    env.close()
    return {"episodes": episodes, "actions": actions, "parameters": parameters}
