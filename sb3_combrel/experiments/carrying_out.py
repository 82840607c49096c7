"""Runs are carried out where they are missing, on an engine, with a display of the progress."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.engines import JobError, carry_out_on, check_engine
from sb3_combrel.experiments.result_files import AnyJob, R, RunFiles

#: Where a run's exception is kept with its traceback: on the worker it is lost.
TRACEBACK_FILE = "error.txt"


@dataclass(frozen=True)
class Engine:
    """
    Where runs are carried out.

    :param name: "joblib" for local processes, "ray" or "dask" for a running cluster
    :param n_jobs: local processes at a time; None: one a core
    :param address: of the cluster
    """

    name: str = "joblib"
    n_jobs: int | None = None
    address: str | None = None

    def check(self) -> None:
        """
        Check that runs can be carried out here, before anything is learned or written.

        :raises ValueError: if an argument is wrong
        :raises ModuleNotFoundError: if the engine is not installed
        :raises ConnectionError: if no cluster answers at the address
        """
        check_engine(self.name, n_jobs=self.n_jobs, address=self.address)

    def carry_out(self, function: Callable[[Any], R], jobs: Sequence[Any]) -> Generator[tuple[int, R], None, None]:
        """Carry out jobs by a function of one; yield the place of each and its result as it is done."""
        return carry_out_on(self.name, function, jobs, n_jobs=self.n_jobs, address=self.address)


LOCAL = Engine()


def carry_out_missing(
    jobs: Sequence[AnyJob[R]],
    files: RunFiles[R],
    engine: Engine,
    console: Console,
    function: Callable[[Any], R],
    bar_of: Callable[[Any], str] = lambda job: job.method,
) -> None:
    """
    Carry out the jobs that have no result yet, and write each result as it arrives.

    :param jobs: the jobs
    :param files: where results are
    :param engine: where to carry them out
    :param console: where to show the progress
    :param function: carries out one job
    :param bar_of: names the bar of the display that a job belongs to; by default its ``method``
    :raises JobError: if a job raises an exception or its workers died too often; ends all others
    """
    missing = [job for job in jobs if not files.is_complete(job)]
    if len(missing) < len(jobs):
        console.print(f"{len(jobs) - len(missing)} of {len(jobs)} runs were complete already.")
    if not missing:
        return
    try:
        with progress_of(jobs, missing, console, bar_of) as advance, closing(engine.carry_out(function, missing)) as results:
            for place, result in results:
                files.write(result)
                advance(missing[place], result)
    except JobError as error:
        path = files.folder / TRACEBACK_FILE
        write_whole(path, f"{error}\n".encode())
        raise JobError(error.name, f"{' '.join(error.reason.split())} (traceback: {path})") from error


@contextmanager
def progress_of(
    jobs: Sequence[AnyJob[R]],
    missing: Sequence[AnyJob[R]],
    console: Console,
    bar_of: Callable[[Any], str],
    describe: Callable[[R], str] = lambda result: "",
) -> Iterator[Callable[[AnyJob[R], R], None]]:
    """
    Show bars of progress; where no bars can be drawn, as in a log file, a line for each run.

    :param jobs: all jobs
    :param missing: those that have no result yet
    :param console: where to show it
    :param bar_of: names the bar that a job belongs to
    :param describe: says of a result what its line has in place of steps and seconds; "" for these
    :return: a function of a job and its result, to be called when that has arrived
    """
    columns = (
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        n_runs, n_missing = Counter(map(bar_of, jobs)), Counter(map(bar_of, missing))
        bars = {name: progress.add_task(name, total=n, completed=n - n_missing[name]) for name, n in n_runs.items()}

        def advance(job: AnyJob[R], result: R) -> None:
            progress.advance(bars[bar_of(job)])
            if not console.is_terminal:
                said = describe(result) or f"{sum(result.steps):,} steps, {result.seconds[0]:.0f} s"
                console.print(f"  {job.title}: {said}", markup=False, soft_wrap=True)

        yield advance
