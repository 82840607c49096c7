"""
Many independent jobs, such as learning runs, on one of three engines: local processes, Ray, or Dask.

The workers write nothing. Results come back to the caller, so the machines of a cluster need no file system in common.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Generator, Iterable
from typing import Any

from sb3_combrel.common.checks import check_count
from sb3_combrel.experiments.clusters import ADDRESS_EXAMPLES, HOW_TO_START, check_cluster, on_dask, on_ray
from sb3_combrel.experiments.engine_jobs import JobError, pack
from sb3_combrel.experiments.local_processes import in_local_processes

ENGINES = ("joblib", "ray", "dask")

__all__ = ["ENGINES", "JobError", "carry_out_on", "check_engine"]

# Of each engine: the package it needs, and the extra that brings it.
_NEEDS = {"joblib": ("joblib", "experiments"), "ray": ("ray", "ray"), "dask": ("distributed", "dask")}


def carry_out_on(
    engine: str,
    function: Callable[[Any], Any],
    jobs: Iterable[Any],
    *,
    n_jobs: int | None = None,
    address: str | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """
    Carry out jobs, each in one thread of a process that does nothing else meanwhile.

    Results are the same on all engines, to the byte, if a job's result depends on the job alone. A job whose worker process
    dies is begun again, up to :data:`~sb3_combrel.experiments.engine_jobs.MAX_DEATHS` times; other results are not lost.
    An exception that a job raises ends everything at once and is not tried again. When the generator is closed, or on
    KeyboardInterrupt, unfinished jobs are ended and the connection to the cluster is closed.

    :param engine: "joblib" (processes of this machine), "ray" or "dask" (a running cluster)
    :param function: a function of a module that the workers can import
    :param jobs: its arguments, which must be picklable, as the results must be; an attribute ``name`` is used in messages
    :param n_jobs: for joblib: processes at a time, one a core by default
    :param address: for Ray and Dask: where the cluster answers, such as "10.0.0.1:6379" (Ray; the caller runs on a node of the
        cluster) or "tcp://10.0.0.1:8786" (Dask)
    :return: generator of the index of a job and its result, in the order in which jobs finish; the first ``next`` connects
    :raises ValueError: if an argument is wrong or a job cannot be pickled
    :raises ModuleNotFoundError: if the engine is not installed; names the extra to install
    :raises ConnectionError: while iterating, if no cluster answers at the address, it has no workers, or it is lost
    :raises JobError: while iterating, if a job raised an exception or its workers died too often
    """
    _check_arguments(engine, n_jobs, address)
    packed = [pack(function, job, index) for index, job in enumerate(jobs)]
    if engine == "ray":
        return on_ray(packed, str(address))
    if engine == "dask":
        return on_dask(packed, str(address))
    return in_local_processes(packed, n_jobs)


def check_engine(engine: str, *, n_jobs: int | None = None, address: str | None = None) -> None:
    """
    Check that an engine can be used, before work is prepared for it: its arguments, and that its cluster answers.

    :param engine: as of :func:`carry_out_on`, like the others
    :raises ValueError: if an argument is wrong
    :raises ModuleNotFoundError: if the engine is not installed; names the extra to install
    :raises ConnectionError: if no cluster answers at the address
    """
    _check_arguments(engine, n_jobs, address)
    if engine != "joblib":
        check_cluster(engine, str(address))


def _check_arguments(engine: str, n_jobs: int | None, address: str | None) -> None:
    if engine not in ENGINES:
        raise ValueError(f"backend must be one of {', '.join(ENGINES)}, got {engine!r}")
    check_count("jobs", n_jobs, none_allowed=True)
    if engine == "joblib" and address is not None:
        raise ValueError(f"address is for the backends ray and dask; joblib uses processes of this machine, got {address!r}")
    if engine != "joblib":
        if not address:
            raise ValueError(
                f"backend {engine} needs the address of a running cluster, {ADDRESS_EXAMPLES[engine]}, "
                f"got {address!r}. {HOW_TO_START[engine]}"
            )
        if n_jobs is not None:
            raise ValueError(f"jobs is for the backend joblib; with {engine} the cluster decides, got {n_jobs}")
    package, extra = _NEEDS[engine]
    if importlib.util.find_spec(package) is None:
        raise ModuleNotFoundError(
            f"backend {engine} needs {package}, which is not installed: pip install 'sb3-combrel[{extra}]'", name=package
        )
