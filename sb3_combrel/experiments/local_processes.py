"""Jobs in processes of this machine, by joblib's loky."""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from sb3_combrel import __version__
from sb3_combrel.experiments.engine_jobs import MAX_DEATHS, THREAD_VARIABLES, Job, JobError, perform, unpack

if TYPE_CHECKING:
    from joblib.externals.loky import Future, ProcessPoolExecutor

CALLER = "local"


def in_local_processes(jobs: Sequence[Job], n_jobs: int | None) -> Generator[tuple[int, Any], None, None]:
    """
    See :func:`~sb3_combrel.experiments.engines.carry_out_on`.

    :param jobs: what to carry out
    :param n_jobs: processes at a time, one a core if None
    """
    from joblib import cpu_count

    processes = _Processes(min(n_jobs or cpu_count(), len(jobs)))
    waiting = deque(range(len(jobs)))
    deaths: Counter[int] = Counter()
    try:
        while waiting or processes.running:
            _begin(jobs, waiting, processes)
            finished, died = processes.wait()
            for index in died:
                deaths[index] += 1
                if deaths[index] > MAX_DEATHS:
                    raise JobError(jobs[index].name, f"the process that carried it out died {deaths[index]} times")
                waiting.appendleft(index)
            # Before results are handed out: the caller may take its time over them.
            _begin(jobs, waiting, processes)
            for index, outcome in finished:
                yield index, unpack(jobs[index].name, outcome)
    finally:
        processes.kill()


def _begin(jobs: Sequence[Job], waiting: deque[int], processes: _Processes) -> None:
    while waiting and processes.has_idle():
        index = waiting.popleft()
        processes.submit(index, jobs[index].payload)


class _Processes:
    """
    Worker processes, each in a pool of its own: when a process dies, loky gives up its pool with all that runs there.

    :param n_processes: how many
    """

    def __init__(self, n_processes: int):
        self.running: dict[Future, tuple[int, ProcessPoolExecutor]] = {}
        self._n_processes = n_processes
        self._idle: list[ProcessPoolExecutor] = []

    def has_idle(self) -> bool:
        """Whether another job can be begun."""
        return len(self.running) < self._n_processes

    def submit(self, index: int, payload: bytes) -> None:
        """Begin a job."""
        from joblib.externals.loky.process_executor import BrokenProcessPool

        with _interrupts_later():
            pool = self._idle.pop() if self._idle else _new_pool()
            try:
                future = pool.submit(perform, payload, __version__, CALLER)
            except BrokenProcessPool:
                # The process died while it was idle.
                pool.shutdown(kill_workers=True)
                self.submit(index, payload)
                return
            self.running[future] = (index, pool)
            # When a pool is ended before its thread has passed the job on, that thread raises KeyError.
            while not (future.running() or future.done()):
                time.sleep(0.001)

    def wait(self) -> tuple[list[tuple[int, bytes]], list[int]]:
        """
        Wait until a job is over.

        :return: indices and outcomes of those that finished, and indices of those whose process died
        """
        from joblib.externals.loky import FIRST_COMPLETED, wait
        from joblib.externals.loky.process_executor import BrokenProcessPool

        finished, died = [], []
        done, _ = wait(self.running, return_when=FIRST_COMPLETED)
        for future in done:
            index, pool = self.running.pop(future)
            try:
                finished.append((index, future.result()))
                self._idle.append(pool)
            except BrokenProcessPool:
                died.append(index)
                pool.shutdown(kill_workers=True)
        return finished, died

    def kill(self) -> None:
        """End all processes, whatever they do."""
        for pool in [*self._idle, *(pool for _, pool in self.running.values())]:
            pool.shutdown(kill_workers=True)


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Ctrl-C has its effect when this is over."""
    before = signal.getsignal(signal.SIGINT)
    if before is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    interrupted = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted.is_set():
        signal.raise_signal(signal.SIGINT)


def _new_pool() -> ProcessPoolExecutor:
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(1, initializer=_ignore_interrupts, env=dict.fromkeys(THREAD_VARIABLES, "1"))


def _ignore_interrupts() -> None:
    """Ctrl-C reaches the workers as well; the caller ends them, without a traceback of each."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
