"""Jobs on a running cluster of Ray or Dask."""

from __future__ import annotations

import contextlib
import logging
import socket
import subprocess
import sys
import uuid
import warnings
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from sb3_combrel import __version__
from sb3_combrel.experiments.engine_jobs import MAX_DEATHS, Job, JobError, perform, stop, unpack

ADDRESS_EXAMPLES = {
    "ray": 'such as "10.0.0.1:6379"',
    "dask": 'such as "tcp://10.0.0.1:8786"',
}
HOW_TO_START = {
    "ray": "Start one with: ray start --head --port=6379, and on each worker node: ray start --address=HEAD:6379; "
    "run this command on one of these nodes",
    "dask": "Start one with: dask scheduler --port 8786, and on each worker node: "
    "dask worker tcp://SCHEDULER:8786 --nworkers -1 --nthreads 1",
}
# Not "ray://": Ray's client server forks while gRPC's threads run, and its first connections often hang (Ray 2.60).
SCHEMES = {"ray": ("",), "dask": ("", "tcp", "tls")}
SECONDS_TO_REACH = 5.0
SECONDS_TO_CONNECT = 15.0

# Where something else listens than a cluster, Ray tries for minutes and then ends its whole process, and Dask waits for ever.
_CONNECT = {
    "ray": "import sys, ray; ray.init(sys.argv[1], log_to_driver=False)",
    "dask": "import sys, distributed; distributed.Client(sys.argv[1]).close()",
}


def on_ray(jobs: Sequence[Job], address: str) -> Generator[tuple[int, Any], None, None]:
    """
    See :func:`~sb3_combrel.experiments.engines.carry_out_on`.

    :param jobs: what to carry out
    :param address: address of the head
    """
    if not jobs:
        return
    import ray

    with _connection_to_ray(address):
        task = ray.remote(perform)
        pending = {
            task.options(num_cpus=1, max_retries=MAX_DEATHS, name=job.name).remote(job.payload, __version__, "ray"): index
            for index, job in enumerate(jobs)
        }
        try:
            while pending:
                [reference, *_], _ = ray.wait(list(pending))
                index = pending.pop(reference)
                try:
                    outcome = ray.get(reference)
                except ray.exceptions.RayError as error:
                    raise _lost_job(jobs[index].name, error) from error
                del reference
                yield index, unpack(jobs[index].name, outcome)
        finally:
            for reference in pending:
                with contextlib.suppress(Exception):
                    ray.cancel(reference, force=True)


def on_dask(jobs: Sequence[Job], address: str) -> Generator[tuple[int, Any], None, None]:
    """
    See :func:`~sb3_combrel.experiments.engines.carry_out_on`.

    :param jobs: what to carry out
    :param address: address of the scheduler
    """
    if not jobs:
        return
    from distributed import CancelledError, as_completed

    with _connection_to_dask(address) as client:
        caller = uuid.uuid4().hex
        pending = {
            client.submit(perform, job.payload, __version__, caller, key=f"{job.name}-{caller}-{index}", pure=False): index
            for index, job in enumerate(jobs)
        }
        try:
            for future in as_completed(list(pending), loop=client.loop):
                index = pending.pop(future)
                try:
                    outcome = future.result()
                except CancelledError as error:
                    raise ConnectionError(f"the connection to the Dask scheduler at {address} was lost") from error
                except Exception as error:
                    raise _lost_job(jobs[index].name, error) from error
                del future
                yield index, unpack(jobs[index].name, outcome)
        finally:
            if pending and client.status == "running":
                client.cancel(list(pending), force=True)
                # Dask cancels what waits, and lets go on what has begun.
                client.run(stop, caller, on_error="ignore")


def _lost_job(name: str, error: Exception) -> JobError:
    """The engine could not carry out a job: its workers died too often, or it could not be begun there."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    reason = f"could not be carried out on the cluster: {type(error).__name__}: {' '.join(lines[:1])}"
    return JobError(name, reason, "\n".join(lines[1:]))


@contextmanager
def _connection_to_ray(address: str) -> Iterator[None]:
    import ray

    if ray.is_initialized():
        raise ValueError("this process is connected to Ray already; call ray.shutdown() before")
    check_cluster("ray", address)
    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        if ray.cluster_resources().get("CPU", 0) < 1:
            raise _no_workers("ray", address)
        yield
    finally:
        ray.shutdown()


@contextmanager
def _connection_to_dask(address: str) -> Iterator[Any]:
    from distributed import Client

    check_cluster("dask", address)
    with _silent("distributed.client"), Client(address, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=SECONDS_TO_REACH)
        except TimeoutError as error:
            raise _no_workers("dask", address) from error
        if any(n_threads > 1 for n_threads in client.nthreads().values()):
            message = "Dask's workers with several threads carry out one job at a time; start them with --nthreads 1"
            warnings.warn(message, stacklevel=2)
        yield client


@contextmanager
def _silent(logger_name: str) -> Iterator[None]:
    """Without this Dask prints tracebacks when the scheduler is lost, beside the exception that the caller gets."""
    logger = logging.getLogger(logger_name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


def check_cluster(engine: str, address: str) -> None:
    """
    Check that a cluster answers.

    :param engine: "ray" or "dask"
    :param address: of the head or the scheduler
    :raises ValueError: if the address cannot be one
    :raises ConnectionError: if nothing answers there, or something else than such a cluster
    """
    _check_reachable(engine, address)
    _check_that_a_cluster_answers(engine, address)


def _check_that_a_cluster_answers(engine: str, address: str) -> None:
    """Connect in a process that can be given up."""
    command = [sys.executable, "-c", _CONNECT[engine], address]
    try:
        probe = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS_TO_CONNECT)
    except subprocess.TimeoutExpired:
        raise _no_cluster(engine, address, f"no answer within {SECONDS_TO_CONNECT:g} seconds") from None
    if probe.returncode:
        raise _no_cluster(engine, address, (probe.stderr.strip().splitlines() or ["no answer"])[-1])


def _check_reachable(engine: str, address: str) -> None:
    """
    :raises ValueError: if the address cannot be one
    :raises ConnectionError: if nothing listens there
    """
    has_scheme = "://" in address
    parts = urlsplit(address if has_scheme else f"//{address}")
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme not in SCHEMES[engine] or not parts.hostname or port is None:
        raise ValueError(f"address of {engine} must be a host and a port, {ADDRESS_EXAMPLES[engine]}, got {address!r}")
    try:
        socket.create_connection((parts.hostname, port), timeout=SECONDS_TO_REACH).close()
    except OSError as error:
        raise _no_cluster(engine, address, str(error)) from error


def _no_cluster(engine: str, address: str, reason: str) -> ConnectionError:
    return ConnectionError(f"no {engine} cluster answers at {address} ({reason}). {HOW_TO_START[engine]}")


def _no_workers(engine: str, address: str) -> ConnectionError:
    return ConnectionError(f"the {engine} cluster at {address} has no workers. {HOW_TO_START[engine]}")
