"""The runner: results by job, in files that a later call finds again; failures, killed workers, interrupts."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.clusters import HOST, dask_cluster, free_port, ray_cluster
from helpers.walk import Walk, walk_source

from sb3_combrel import COMBREL
from sb3_combrel.runs import runner
from sb3_combrel.runs.described import described
from sb3_combrel.runs.job import Job, file_name, make_env

HERE = runner.Backend(n_jobs=1)


@dataclass(frozen=True, kw_only=True)
class Toy(Job):
    """Leaves a file each time that it is begun."""

    env: str = "CartPole-v1"
    does: str = "nothing"
    folder: Path

    def attempts(self):
        return len(list(self.folder.glob(f"{self.name}.*")))

    def settings(self):
        return {"does": self.does}

    def carry_out(self):
        (self.folder / f"{self.name}.{os.getpid()}.{self.attempts()}").touch()
        if self.does == "fail":
            raise FileNotFoundError(2, "No such file", "lost.npz")
        if self.does == "die" or (self.does == "die once" and self.attempts() == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.does == "sleep":
            time.sleep(300)
        return self.result([self.seed, 2], [-1.5, 0.25], [True, False], self.seed + 2, {"threads": threads()}, 0.5)


def threads():
    import torch as th

    return th.get_num_threads()


def toys(folder, n=3, group="toys", method="a", **kwargs):
    return [Toy(group=group, method=method, seed=seed, folder=folder, **kwargs) for seed in range(n)]


def test_results_come_in_the_order_of_the_jobs_and_a_later_call_finds_them(tmp_path):
    jobs = toys(tmp_path)
    found = runner.run_missing(jobs, str(tmp_path / "out"), HERE)
    assert [result.steps for result in found] == [[0, 2], [1, 2], [2, 2]]
    assert runner.run_missing(jobs[::-1], tmp_path / "out", HERE) == found[::-1]
    assert [job.attempts() for job in jobs] == [1, 1, 1]
    more = runner.run_missing(toys(tmp_path, 4), tmp_path / "out", HERE)
    assert more[:3] == found and more[3].seed == 3


def test_what_is_not_whole_is_done_again(tmp_path):
    jobs = toys(tmp_path, 2)
    before = runner.run_missing(jobs, tmp_path / "out", HERE)
    file = tmp_path / "out" / runner.FOLDER / f"{jobs[0].name}.json"
    whole = file.read_bytes()
    for n_bytes in (0, 1, len(whole) // 2, len(whole) - 3):
        file.write_bytes(whole[:n_bytes])
        assert runner.run_missing(jobs, tmp_path / "out", HERE) == before
    assert [job.attempts() for job in jobs] == [5, 1] and file.read_bytes() == whole


def test_results_of_other_settings_and_other_files_are_neither_mixed_nor_overwritten(tmp_path):
    out = tmp_path / "out"
    runner.run_missing(toys(tmp_path), out, HERE)
    with pytest.raises(ValueError, match=r"other settings \(toys, a, seed 0: does was 'nothing' and is 'fail'\); use another"):
        runner.run_missing(toys(tmp_path, does="fail"), out, HERE)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    with pytest.raises(ValueError, match="has files that are not results"):
        runner.run_missing(toys(tmp_path), tmp_path / "mine", HERE)
    assert len(list((out / runner.FOLDER).glob("*.json"))) == 3 and os.listdir(tmp_path / "mine") == ["thesis.txt"]


def test_a_failed_job_is_kept_with_its_error_tried_again_and_does_not_stop_the_others(tmp_path, capsys):
    from rich.console import Console

    jobs = toys(tmp_path, 2, method="bad", does="fail") + toys(tmp_path, 2, method="good")
    console = Console(force_terminal=False, width=200)
    for attempt in (1, 2):
        found = runner.run_missing(jobs, tmp_path / "out", HERE, console)
        assert [bool(result.error) for result in found] == [True, True, False, False]
        assert [job.attempts() for job in jobs] == [attempt, attempt, 1, 1]
    printed = capsys.readouterr().out
    assert "toys, bad, seed 1: failed: FileNotFoundError: [Errno 2] No such file: 'lost.npz'" in printed
    assert "2 of 4 runs were complete already." in printed
    with pytest.raises(
        runner.JobError, match=r"^toys, bad, seed 0: FileNotFoundError.*lost.npz' \(1 other runs failed, too\)\nTrace"
    ):
        runner.check_all_succeeded(found)
    runner.check_all_succeeded(found[2:])
    mended = runner.run_missing(toys(tmp_path, 2, method="bad"), tmp_path / "out", HERE)
    assert [result.error for result in mended] == ["", ""], "settings may differ from those that failed"


def test_jobs_that_cannot_be_told_apart_or_sent_are_refused(tmp_path):
    with pytest.raises(ValueError, match="different names, got toys_a_seed0"):
        runner.run_missing([*toys(tmp_path, 2), *toys(tmp_path, 1)], backend=HERE)
    locked = Toy(group="", method="locked", seed=0, folder=tmp_path, learner={"lock": pytest.importorskip("threading").Lock()})
    with pytest.raises(ValueError, match="locked, seed 0 cannot be sent to a worker, its pickling failed"):
        runner.run_missing([locked], backend=HERE)
    assert runner.run_missing([], backend=HERE) == []
    with pytest.raises(RuntimeError, match="install the same on both"):
        runner.perform("", b"", "0.0", os.getpid())
    name, outcome = runner.perform("lost", b"cgone\nJob\n.", runner.__version__, os.getpid())
    assert name == "lost" and outcome["error"] == "ModuleNotFoundError: No module named 'gone'", "an error of the job, at once"


@pytest.mark.parametrize(
    ("backend", "message"),
    [
        (runner.Backend("slurm"), "backend must be one of loky, ray, dask, got 'slurm'"),
        (runner.Backend(n_jobs=0), "jobs must be"),
        (runner.Backend(address="a:1"), "address is for the backends ray and dask"),
        (runner.Backend("dask", n_jobs=2, address="a:1"), "jobs is for the backend loky"),
        (runner.Backend("dask"), "address of dask must be a host and a port .*got None. Start one with: dask scheduler"),
        (runner.Backend("ray", address="ray://a:1"), "address of ray must be a host and a port"),
        (runner.Backend("dask", address="tcp://a:none"), "got 'tcp://a:none'"),
        (runner.Backend("dask", address=f"tcp://{HOST}:{free_port()}"), "no dask cluster answers at .*Start one with"),
    ],
)
def test_a_backend_that_cannot_be_used_says_why(backend, message):
    with pytest.raises((ValueError, ConnectionError), match=message):
        backend.check()
    runner.LOCAL.check()


def test_a_job_learns_what_its_fields_say():
    job = Job(group="walk", method="COMBREL", seed=3, env=Walk, n_steps=90, learner={"resolution": 3}, transfer=None)
    [result] = runner.run_missing([job], backend=HERE)
    assert result.error == "" and result.n_steps == 90 and sum(result.steps) <= 90
    assert len(result.steps) == len(result.returns) == len(result.terminated) > 1
    assert [replace(each, seconds=0.0) for each in runner.run_missing([job], backend=HERE)] == [replace(result, seconds=0.0)]
    [other] = runner.run_missing([replace(job, n_steps=None, n_episodes=2)], backend=HERE)
    assert (other.steps, other.returns) == (result.steps[:2], result.returns[:2])


def test_settings_describe_transfer_and_arrays_by_what_they_hold():
    job = Job(group="", method="m", seed=0, env=Walk, transfer=COMBREL(walk_source()), learner={"bounds": ([0.0], [1.0])})
    settings = json.loads(json.dumps(job.settings()))
    assert settings == pickle.loads(pickle.dumps(job)).settings()
    assert re.fullmatch(r"helpers\.walk\.Walk [0-9a-f]{8}", settings["env"]) and settings["learner"] == {
        "bounds": [[0.0], [1.0]]
    }
    [(name, arguments)] = settings["transfer"].items()
    assert name.endswith("COMBREL") and "instances" in arguments["source"]
    assert described(np.zeros(3)) != described(np.ones(3)) and described({1: (2, None)}) == {"1": [2, None]}


def test_names_of_files_and_environments():
    assert file_name("iCub", "TIMBREL, best: 3", 7) == "icub_timbrel_best_3_seed7"
    env = make_env("combrel/MountainCar2D-v0", 30)
    assert env.spec.max_episode_steps == 30
    env.close()
    with pytest.raises(ValueError, match="env must make Gymnasium environments, got 3"):
        make_env(lambda: 3)


@pytest.mark.long
@pytest.mark.parametrize("name", runner.BACKENDS)
def test_on_each_backend_dead_workers_cost_only_their_jobs(name, tmp_path):
    cluster = {"ray": ray_cluster, "dask": dask_cluster}.get(name)
    if cluster is None:
        _check_backend(runner.Backend(n_jobs=2), tmp_path)
    else:
        with cluster() as address:
            _check_backend(runner.Backend(name, address=address), tmp_path)


def _check_backend(backend, folder):
    backend.check()
    jobs = toys(folder, 4) + toys(folder, 1, method="b", does="die once") + toys(folder, 1, method="c", does="fail")
    found = runner.run_missing(jobs, folder / "out", backend)
    assert [result.error.partition(":")[0] for result in found] == [""] * 5 + ["FileNotFoundError"]
    assert [result.steps for result in found[:5]] == [[0, 2], [1, 2], [2, 2], [3, 2], [0, 2]]
    assert {result.more["threads"] for result in found[:5]} == {1} and jobs[4].attempts() == 2
    # Those that kill every worker are given up, and the others go on.
    deadly = toys(folder, 1, method="deadly", does="die") + toys(folder, 2, method="d")
    found = runner.run_missing(deadly, None, backend)
    assert "worker died" in found[0].error and [result.error for result in found[1:]] == ["", ""]
    assert deadly[0].attempts() >= runner.MAX_BREAKDOWNS
    learning = [Job(group="walk", method="m", seed=seed, env=Walk, n_steps=60) for seed in range(2)]
    there, here = runner.run_missing(learning, None, backend), runner.run_missing(learning, None, HERE)
    assert [replace(each, seconds=0.0) for each in there] == [replace(each, seconds=0.0) for each in here]


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "killed"])
def test_with_their_caller_workers_end_without_noise_and_the_next_call_goes_on(how, tmp_path):
    code = """
import signal, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_runner import toys
from sb3_combrel.runs.runner import Backend, run_missing
signal.signal(signal.SIGINT, signal.default_int_handler)
folder = Path(sys.argv[1])
jobs = toys(folder, 1) + toys(folder, 2, method="long", does="sleep")
try:
    run_missing(jobs, folder / "out", Backend(n_jobs=2))
except KeyboardInterrupt:
    print("interrupted")
"""
    paths = [str(Path(__file__).parent), *sys.path]
    program = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path), *paths], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120
    while len(list(tmp_path.glob("toys_long*"))) < 2 and time.monotonic() < end:
        time.sleep(0.1)
    program.send_signal(how)
    printed, noise = program.communicate(timeout=60)
    assert printed == ("interrupted\n" if how == signal.SIGINT else "") and "Traceback" not in noise
    alive = began = [Path("/proc", file.name.split(".")[1], "cmdline") for file in tmp_path.glob("toys_long*")]
    while alive and time.monotonic() < end + 60:
        alive = [file for file in alive if file.exists() and file.read_bytes()]
        time.sleep(0.1)
    assert len(began) == 2 and not alive
    assert [job.attempts() for job in toys(tmp_path, 1)] == [1]
    runner.run_missing(toys(tmp_path, 2), tmp_path / "out", HERE)
    assert [job.attempts() for job in toys(tmp_path, 2)] == [1, 1]
