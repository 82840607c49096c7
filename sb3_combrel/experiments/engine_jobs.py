"""
What goes to a worker of an engine and comes back from it: bytes, the same on all engines.

The engines have picklers of their own, and some hand out arrays that cannot be written to, or keep large ones in files. With
bytes a job and its result go through one and the same pickler once, wherever the job is carried out.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cloudpickle

from sb3_combrel import __version__

MAX_DEATHS = 3
"""How often a job is begun again because the worker that carried it out has died."""

THREAD_VARIABLES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
)
"""Environment variables that limit the threads of numerical libraries."""

# A learning run seeds the random numbers of its whole process, so runs in several threads of one would disturb each other.
_one_at_a_time = threading.Lock()
_running: set[tuple[str, int]] = set()
_running_lock = threading.Lock()
_stopped: set[str] = set()


class JobError(RuntimeError):
    """
    A job raised an exception, or the workers that carried it out died too often.

    :param name: name of the job
    :param reason: what happened, in one line
    :param worker_traceback: traceback on the worker, or ""
    """

    def __init__(self, name: str, reason: str, worker_traceback: str = ""):
        super().__init__(f"{name}: {reason}" + (f"\n\nOn the worker:\n{worker_traceback}" if worker_traceback else ""))
        self.name = name
        self.reason = reason
        self.worker_traceback = worker_traceback

    def __reduce__(self) -> tuple[Any, ...]:
        return JobError, (self.name, self.reason, self.worker_traceback)


class Stopped(BaseException):
    """Raised in a job whose caller does not want its result any more."""


@dataclass(frozen=True)
class Job:
    """
    A job as it is sent.

    :param name: what it is called in messages
    :param payload: the function and its argument, pickled
    """

    name: str
    payload: bytes


@dataclass(frozen=True)
class _Failure:
    """An exception as text, since not every exception can be pickled."""

    reason: str
    worker_traceback: str


def pack(function: Callable[[Any], Any], job: Any, index: int) -> Job:
    """
    :param function: what to carry out
    :param job: its argument; its attribute ``name``, if it has one, is what messages call it
    :param index: number of the job, for the name of one without
    :return: both as bytes
    :raises ValueError: if they cannot be pickled
    """
    name = str(getattr(job, "name", f"job {index}"))
    try:
        return Job(name, cloudpickle.dumps((function, job)))
    except Exception as error:  # picklers raise what they like
        raise ValueError(f"{name} cannot be sent to a worker, its pickling failed: {error}") from error


def perform(payload: bytes, version: str, caller: str) -> bytes:
    """
    Carry out a job, in one thread; this is what runs on the worker. An exception of the job is returned, not raised.

    :param payload: function and argument, pickled
    :param version: version of this package where the job comes from
    :param caller: what :func:`stop` is given to end the job
    :return: the result or a description of the exception, pickled
    """
    with _one_at_a_time:
        if caller in _stopped:
            raise Stopped
        me = (caller, threading.get_ident())
        _running.add(me)
        try:
            return _result_or_failure(payload, version)
        finally:
            # Under the lock, so that nothing is raised in this thread once it does something else.
            with _running_lock:
                _running.discard(me)


def unpack(name: str, outcome: bytes) -> Any:
    """
    :param name: name of the job
    :param outcome: what :func:`perform` returned
    :return: the job's result
    :raises JobError: if the job raised an exception
    """
    result = pickle.loads(outcome)
    if isinstance(result, _Failure):
        raise JobError(name, result.reason, result.worker_traceback)
    return result


def stop(caller: str) -> None:
    """
    End the jobs of a caller in this process, those that wait and those that run.

    :param caller: whose jobs
    """
    _stopped.add(caller)
    with _running_lock:
        for _, thread in [job for job in _running if job[0] == caller]:
            # A thread cannot be ended from outside; this raises the exception in it, at its next line of Python.
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(Stopped))


def _result_or_failure(payload: bytes, version: str) -> bytes:
    try:
        if version != __version__:
            raise RuntimeError(f"the worker has sb3-combrel {__version__}, the caller {version}; install the same on both")
        _use_one_thread()
        from threadpoolctl import threadpool_limits

        function, job = cloudpickle.loads(payload)
        with threadpool_limits(1):
            return cloudpickle.dumps(function(job))
    except Exception as error:
        reason = " ".join(traceback.format_exception_only(error)).strip()
        return pickle.dumps(_Failure(reason, traceback.format_exc()))


def _use_one_thread() -> None:
    import torch as th

    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    th.set_num_threads(1)
