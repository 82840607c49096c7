"""Files with source instances, each learned once for an output folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from sb3_combrel.runs.job import Job, Result, Task
from sb3_combrel.runs.runner import Backend, carry_out, check_all_succeeded, show_progress
from sb3_combrel.sources.source_instances import SourceInstances

FOLDER = "sources"


@dataclass(frozen=True, kw_only=True)
class SourceJob(Job):
    """Source instances that are learned with a seed.

    :param path: their file
    :param learn: makes them from the seed
    """

    path: Path
    learn: Callable[[int], SourceInstances]
    method: str = "source"
    env: Task = ""  # what learns knows its own

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.stem

    def carry_out(self) -> Result:
        """Learn them."""
        start = time.process_time()
        found = self.learn(self.seed)
        return self.result([len(found)], more={"instances": found}, seconds=time.process_time() - start)


def load_or_learn(jobs: Sequence[SourceJob], backend: Backend, console: Console) -> list[SourceInstances]:
    """Load instances from files, or learn them and write these.

    :raises JobError: if some could not be learned
    """
    results = try_sources(jobs, backend, console)
    check_all_succeeded(results)
    return [result.more["instances"] for result in results]


def try_sources(jobs: Sequence[SourceJob], backend: Backend, console: Console) -> list[Result]:
    """Do the same, but return errors of those that could not be learned; the others are in ``more["instances"]``."""
    wanted = {job.name: job for job in jobs}
    found = {name: result for name, job in wanted.items() if (result := _read(job, console)) is not None}
    missing = [job for name, job in wanted.items() if name not in found]
    with show_progress(missing, missing, console) as advance:
        for job, result in carry_out(missing, backend):
            if not result.error:
                path = wanted[job.name].path
                path.parent.mkdir(parents=True, exist_ok=True)
                result.more["instances"].save(path)
            found[job.name] = result
            advance(job, result)
    return [found[job.name] for job in jobs]


def _read(job: SourceJob, console: Console) -> Result | None:
    """Read a file; None if there is none, or it is not whole."""
    if not job.path.exists():
        return None
    try:
        return job.result(more={"instances": SourceInstances.load(job.path)})
    except ValueError as error:
        console.print(f"{error}: they are learned again.", markup=False, soft_wrap=True)
        return None
