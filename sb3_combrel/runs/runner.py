"""Whatever has seeds runs here: jobs that have no result yet are carried out, several at a time, on this machine or a cluster.

The workers write nothing. A result comes back to the caller, which writes it to a file of its own as it arrives, so that the
machines of a cluster need no folder in common, and a call that is stopped is continued by the next.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import signal
import socket
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cloudpickle
import torch as th
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from sb3_combrel.common.checks import check_count
from sb3_combrel.common.files import check_folder, write_whole
from sb3_combrel.common.serialisation import from_plain, to_plain
from sb3_combrel.common.version import __version__
from sb3_combrel.runs.job import Job, Result

BACKENDS = ("loky", "ray", "dask")
FOLDER = "runs"
#: The file that tells our folder of runs from others' of that name, such as TensorBoard's, before there is a result.
MARK = ".sb3_combrel"
# Of a setting that one of two calls has not.
ABSENT = "(not given)"
USE_ANOTHER = "use another folder by --output or output="
#: How often jobs are begun again, without a single result in between, because workers have died.
MAX_BREAKDOWNS = 3
SECONDS_TO_REACH = 5.0

_NEEDS = {"ray": "ray", "dask": "distributed"}
_HOW_TO_START = {
    "ray": "Start one with: ray start --head --port=6379, and on each worker node: ray start --address=HEAD:6379; "
    "run this command on one of these nodes",
    "dask": "Start one with: dask scheduler --port 8786, and on each worker node: "
    "dask worker tcp://SCHEDULER:8786 --nworkers -1 --nthreads 1",
}
# A job's name and the job, pickled; and what comes of it, as :func:`perform` returns it.
_Packed = tuple[str, bytes]
_Outcome = tuple[str, bytes | dict[str, str]]
# A learning run seeds the random numbers of its whole process, so runs in several threads of one would disturb each other.
_one_at_a_time = threading.Lock()


class JobError(RuntimeError):
    """A job has failed: it raised an exception, or the workers that carried it out died too often."""


@dataclass(frozen=True)
class Backend:
    """Where jobs are carried out.

    :param name: "loky" for processes of this machine, "ray" or "dask" for a running cluster
    :param n_jobs: processes of this machine at a time; 1 for this process; None: one a core
    :param address: of the cluster, such as "10.0.0.1:6379" (Ray) or "tcp://10.0.0.1:8786" (Dask)
    """

    name: str = "loky"
    n_jobs: int | None = None
    address: str | None = None

    def check(self) -> None:
        """Check that jobs can be carried out here, before anything is prepared.

        :raises ValueError: if an argument is wrong
        :raises ModuleNotFoundError: if the backend is not installed; names the extra to install
        :raises ConnectionError: if nothing answers at the address
        """
        if self.name not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {self.name!r}")
        check_count("jobs", self.n_jobs, none_allowed=True)
        if self.name == "loky":
            if self.address is not None:
                raise ValueError(f"address is for the backends ray and dask, got {self.address!r}")
            return
        package = _NEEDS[self.name]
        try:
            __import__(package)
        except ModuleNotFoundError as error:
            message = f"backend {self.name} needs {package}, which is not installed: pip install 'sb3-combrel[{self.name}]'"
            raise ModuleNotFoundError(message, name=package) from error
        if self.n_jobs is not None:
            raise ValueError(f"jobs is for the backend loky; with {self.name} the cluster decides, got {self.n_jobs}")
        self._reach()

    def _reach(self) -> None:
        address = self.address or ""
        parts = urlsplit(address if "://" in address else f"//{address}")
        try:
            port = parts.port
        except ValueError:
            port = None
        # Not "ray://": connections of Ray's client server often hang.
        if parts.scheme not in ("", *(("tcp", "tls") if self.name == "dask" else ())) or not parts.hostname or port is None:
            wanted = f"address of {self.name} must be a host and a port of a running cluster"
            raise ValueError(f"{wanted}, got {self.address!r}. {_HOW_TO_START[self.name]}")
        try:
            socket.create_connection((parts.hostname, port), timeout=SECONDS_TO_REACH).close()
        except OSError as error:
            message = f"no {self.name} cluster answers at {self.address} ({error}). {_HOW_TO_START[self.name]}"
            raise ConnectionError(message) from error


LOCAL = Backend()


def run_missing(
    jobs: Sequence[Job],
    output: str | os.PathLike[str] | None = None,
    backend: Backend = LOCAL,
    console: Console | None = None,
    must_keep: bool = True,
) -> list[Result]:
    """
    Carry out the jobs that have no result yet.

    One that fails does not stop the others, and is tried again by the next call, whose settings may be others.

    Results are the same wherever a job is carried out, if they depend on the job alone.

    :param jobs: with different names
    :param output: folder that the results are written to, in :data:`FOLDER`, and found in; None: they are only returned
    :param backend: where jobs are carried out
    :param console: where to show the progress; None: nowhere
    :param must_keep: whether a result that cannot be written is an error; else it is only returned
    :return: the results of all jobs, in their order, those that failed too, see :func:`check_all_succeeded`
    :raises ValueError: if two jobs have one name, a job cannot be pickled, or the folder has results of other settings, or
        files that are not results
    """
    console = console or Console(quiet=True)
    names = Counter(job.name for job in jobs)
    if names.total() > len(names):
        raise ValueError(f"jobs must have different names, got {', '.join(name for name, n in names.items() if n > 1)} twice")
    folder = None if output is None else Path(output)
    # As they are before the first run, which may change what they are made from: a list that a function holds, or a file.
    settings = {} if folder is None else {job.name: _settings(job) for job in jobs}
    found = {} if folder is None else _read_all(jobs, settings, folder)
    missing = [job for job in jobs if job.name not in found]
    if found:
        console.print(f"{len(found)} of {len(jobs)} runs were complete already.")
    with show_progress(jobs, missing, console) as advance:
        for job, result in carry_out(missing, backend):
            found[job.name] = result
            if folder is not None:
                with nullcontext() if must_keep else suppress(TypeError, OSError):
                    _write(job, settings[job.name], result, folder)
            advance(job, result)
    return [found[job.name] for job in jobs]


def check_all_succeeded(results: Sequence[Result]) -> None:
    """:raises JobError: if jobs have failed, with their number, and name, exception and traceback of the first"""
    failed = [result for result in results if result.error]
    if failed:
        first = failed[0]
        others = f" ({len(failed) - 1} other runs failed, too)" if len(failed) > 1 else ""
        title = ", ".join(filter(None, (first.group, first.method, f"seed {first.seed}")))
        raise JobError(f"{title}: {first.error}{others}\n{first.traceback}".rstrip())


def result_file(output: Path, name: str) -> Path:
    """The file of a job's settings and result; without it the job is carried out again."""
    return output / FOLDER / f"{name}.json"


def read_result(output: Path, name: str) -> tuple[dict[str, Any], Result] | None:
    """Read the settings and the result of a job from a folder; None if it has none or a file that is not whole."""
    try:
        content = json.loads(result_file(output, name).read_text())
        return dict(content["settings"]), Result(**from_plain(content["result"]))
    except (FileNotFoundError, ValueError, TypeError, KeyError):
        return None


def read_results(output: Path, begins: str = "") -> list[tuple[dict[str, Any], Result]]:
    """Read settings and results of all complete jobs in a folder whose names begin so, by name."""
    found = (read_result(output, path.stem) for path in sorted((output / FOLDER).glob(f"{begins}*.json")))
    return [each for each in found if each is not None and not each[1].error]


def prepare_folder(output: Path) -> None:
    """Prepare a folder for results; those that are there are kept.

    :raises ValueError: if it has other files only
    :raises OSError: if nothing can be written to it
    """
    # What must not be read, or is no folder, is named by what follows.
    with suppress(PermissionError, NotADirectoryError):
        runs = output / FOLDER
        is_ours = (runs / MARK).exists() or any(read_result(output, file.stem) for file in runs.glob("*.json"))
        if output.exists() and any(output.iterdir()) and not is_ours:
            raise ValueError(f"{output} has files that are not results of such runs; {USE_ANOTHER}")
    check_folder("output", output / FOLDER)
    if not (output / FOLDER / MARK).exists():
        (output / FOLDER / MARK).touch()


def _read_all(jobs: Sequence[Job], settings: dict[str, dict[str, Any]], output: Path) -> dict[str, Result]:
    """Results by name, without those that failed; ValueError if one is of other settings."""
    prepare_folder(output)
    found = {}
    for job in jobs:
        read = read_result(output, job.name)
        # A run that failed is carried out again, with whatever settings: to mend these may be why the call is repeated.
        if read is None or read[1].error:
            continue
        now = settings[job.name]
        other = "; ".join(text for key in now for text in _differences(key, read[0].get(key), now[key]))
        if other:
            raise ValueError(f"{output} has results of other settings ({job.title}: {other}); {USE_ANOTHER}")
        found[job.name] = read[1]
    return found


def _differences(name: str, before: Any, now: Any) -> list[str]:
    """What differs in a setting, each part of it by its own name."""
    if isinstance(before, dict) and isinstance(now, dict) and before.keys() & now.keys():
        pairs = ((f"{name}.{key}", before.get(key, ABSENT), now.get(key, ABSENT)) for key in before | now)
        return [text for pair in pairs for text in _differences(*pair)]
    return [] if before == now else [f"{name} was {before!r} and is {now!r}"]


def _settings(job: Job) -> dict[str, Any]:
    return dict(json.loads(json.dumps({"version": __version__, **job.settings()})))


def _write(job: Job, settings: dict[str, Any], result: Result, output: Path) -> None:
    try:
        content = {"settings": settings, "result": to_plain(vars(result))}
        write_whole(result_file(output, job.name), (json.dumps(content) + "\n").encode())
    except TypeError as error:
        raise TypeError(f"{job.title}: {error}, which a result in a folder has to be") from error
    except OSError as error:
        wrong = f"output must be a folder that can be written to, got {output}: {error.strerror or error} ({job.title})"
        raise type(error)(f"{wrong}; runs that were finished are kept there, and the same call goes on from them") from error


def carry_out(jobs: Sequence[Job], backend: Backend) -> Iterator[tuple[Job, Result]]:
    """Jobs and their results, as they finish. What died with its worker is begun again."""
    # As bytes a job goes through one and the same pickler once, whatever the backend makes of it.
    packed = {job.name: (job, _pack(job)) for job in jobs}
    if not packed:
        return
    breakdowns = 0
    with _dask(backend) if backend.name == "dask" else _joblib(backend) as parallel:
        while packed:
            alone = breakdowns >= MAX_BREAKDOWNS
            batch = list(packed)[:1] if alone else list(packed)
            try:
                for name, outcome in parallel([(name, packed[name][1]) for name in batch]):
                    job, _ = packed.pop(name)
                    yield job, _unpack(job, outcome)
                    # Alone until the one that kills its worker is found.
                    breakdowns = MAX_BREAKDOWNS if alone and breakdowns == MAX_BREAKDOWNS else 0
            except Exception as error:  # of a worker that died, as the backend calls it; exceptions of jobs are results
                breakdowns += 1
                if alone:
                    job, _ = packed.pop(batch[0])
                    yield job, job.result(error=f"its worker died or failed: {_in_one_line(error)}")


def _pack(job: Job) -> bytes:
    try:
        return cloudpickle.dumps(job)
    except Exception as error:  # picklers raise what they like
        raise ValueError(f"{job.title} cannot be sent to a worker, its pickling failed: {error}") from error


def _unpack(job: Job, outcome: bytes | dict[str, str]) -> Result:
    try:
        return job.result(**outcome) if isinstance(outcome, dict) else pickle.loads(outcome)
    except Exception as error:  # as above
        return job.result(error=f"its result cannot be read: {_in_one_line(error)}")


def perform(name: str, packed: bytes, version: str, caller: int) -> _Outcome:
    """Carry out a pickled job in one thread: what runs on the worker.

    :return: its name; and its result, pickled, or error and traceback if an exception was raised, be it by loading the job
    """
    if version != __version__:
        raise RuntimeError(f"the worker has sb3-combrel {__version__}, the caller {version}; install the same on both")
    if os.getpid() != caller and threading.current_thread() is threading.main_thread():
        # Ctrl-C reaches the workers as well; the caller ends them.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _end_with(caller)
    with _one_at_a_time, _one_thread():
        try:
            return name, cloudpickle.dumps(pickle.loads(packed).carry_out())
        except Exception as error:  # whatever a third party's code raises
            return name, {"error": _in_one_line(error), "traceback": traceback.format_exc()}


@cache
def _end_with(caller: int) -> None:
    """End this worker when its caller has gone, on the same machine: one that was killed can't, and a job may take hours."""

    def wait() -> None:
        while os.getppid() == caller:
            time.sleep(1.0)
        os._exit(1)

    if os.getppid() == caller:
        threading.Thread(target=wait, daemon=True).start()


def _in_one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@contextmanager
def _one_thread() -> Iterator[None]:
    """More threads would fight with those of other runs for the cores."""
    n_threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        th.set_num_threads(n_threads)


@contextmanager
def _joblib(backend: Backend) -> Iterator[Callable[[list[_Packed]], Iterator[_Outcome]]]:
    """Make a function that performs packed jobs on the backend and yields what comes of them as they finish."""
    from joblib import Parallel, delayed, parallel_config

    n_jobs, options, how = backend.n_jobs or -1, {}, {"return_as": "generator_unordered", "batch_size": 1}
    with ExitStack() as stack:
        if backend.name == "ray":
            import ray
            from ray.util.joblib import register_ray

            ray.init(backend.address, log_to_driver=False, logging_level=logging.ERROR)
            stack.callback(ray.shutdown)
            register_ray()
            # Its backend hands results out when all are there.
            n_jobs, how["return_as"] = int(ray.cluster_resources().get("CPU", 0)), "list"
            if n_jobs < 1:
                raise ConnectionError(f"the ray cluster at {backend.address} has no workers. {_HOW_TO_START['ray']}")
        else:
            options = {"inner_max_num_threads": 1}
        stack.enter_context(parallel_config(backend=backend.name, n_jobs=n_jobs, **options))

        def parallel(packed: list[_Packed]) -> Iterator[_Outcome]:
            size = n_jobs if how["return_as"] == "list" else len(packed)
            for start in range(0, len(packed), size):
                calls = (delayed(perform)(*each, __version__, os.getpid()) for each in packed[start : start + size])
                yield from Parallel(**how)(calls)

        yield parallel


@contextmanager
def _dask(backend: Backend) -> Iterator[Callable[[list[_Packed]], Iterator[_Outcome]]]:
    """Do the same by Dask's own client: joblib's backend for Dask waits for ever for a job whose worker has died."""
    from distributed import Client, as_completed

    with Client(backend.address, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=SECONDS_TO_REACH)
        except TimeoutError as error:
            raise ConnectionError(f"the dask cluster at {backend.address} has no workers. {_HOW_TO_START['dask']}") from error

        def parallel(packed: list[_Packed]) -> Iterator[_Outcome]:
            calls = [client.submit(perform, *each, __version__, os.getpid(), pure=False) for each in packed]
            errors = []
            for call in as_completed(calls, loop=client.loop):
                if call.status == "error":
                    errors.append(call.exception())
                else:
                    yield call.result()
            if errors:
                raise errors[0]

        yield parallel


@contextmanager
def show_progress(jobs: Sequence[Job], missing: Sequence[Job], console: Console) -> Iterator[Callable[[Job, Result], None]]:
    """Bars of progress, one a method or, of several groups, one a group; in a log file a line for each run."""
    columns = (
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    groups = {job.group for job in jobs}

    def bar_of(job: Job) -> str:
        return job.group if len(groups) > 1 else job.method

    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        n_runs, n_missing = Counter(map(bar_of, jobs)), Counter(map(bar_of, missing))
        bars = {name: progress.add_task(name, total=n, completed=n - n_missing[name]) for name, n in n_runs.items()}

        def advance(job: Job, result: Result) -> None:
            progress.advance(bars[bar_of(job)])
            if result.error or not console.is_terminal:
                said = f"failed: {result.error}" if result.error else f"{sum(result.steps):,} steps, {result.seconds:.0f} s"
                console.print(f"  {job.title}: {said}", markup=False, soft_wrap=True)

        yield advance
