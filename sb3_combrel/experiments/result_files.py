"""The results of many runs in a folder, one file a run, written as they arrive and found again by a later call."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from sb3_combrel.common.files import write_whole

RESULTS, TIMES = "runs", "times"


def run_name(domain: str, method: str, seed: int) -> str:
    """Return the name of a run in files."""
    return f"{domain}_{method.lower().replace(',', '').replace(' ', '_')}_seed{seed}"


class AnyResult(Protocol):
    """What is asked of a result: a dataclass of what JSON can hold."""

    @property
    def name(self) -> str:
        """Name of the run in files."""

    @property
    def steps(self) -> list[int]:
        """Environment steps of each episode."""

    @property
    def seconds(self) -> tuple[float, float]:
        """Processor time: of learning, and a part of it that the kind of result names."""

    def text(self) -> str:
        """Return all but the times as JSON."""


R = TypeVar("R", bound=AnyResult)
R_of_job = TypeVar("R_of_job", bound=AnyResult, contravariant=True)


class AnyJob(Protocol[R_of_job]):
    """What is asked of a job besides being carried out."""

    @property
    def name(self) -> str:
        """Name of the run in files."""

    @property
    def title(self) -> str:
        """What the run is called in messages."""

    def answered_by(self, result: R_of_job) -> bool:
        """Whether a result is that of this job."""


class RunFiles(Generic[R]):
    """
    The results in a folder, one file a run, each written at once.

    :param folder: the folder
    :param kind: makes a result of its fields
    """

    def __init__(self, folder: Path, kind: Callable[..., R]):
        self.folder = folder
        self.kind = kind

    def write(self, result: R) -> None:
        """Write a result, and its times apart: they differ from call to call."""
        write_whole(self.folder / TIMES / f"{result.name}.json", (json.dumps(result.seconds) + "\n").encode())
        write_whole(self.folder / RESULTS / f"{result.name}.json", result.text().encode())

    def read(self, name: str) -> R | None:
        """Read a result; None if there is none, or a file that is not whole, as after a power failure."""
        try:
            content = json.loads((self.folder / RESULTS / f"{name}.json").read_text())
            whole, part = map(float, json.loads((self.folder / TIMES / f"{name}.json").read_text()))
            return self.kind(**content, seconds=(whole, part))
        except (FileNotFoundError, ValueError, TypeError):
            return None

    def read_all(self, jobs: Iterable[AnyJob[R]]) -> list[R]:
        """Read the results of all jobs that have one."""
        found = (self.read(job.name) for job in jobs)
        return [result for result in found if result is not None]

    def is_complete(self, job: AnyJob[R]) -> bool:
        """Whether a job's result is there."""
        result = self.read(job.name)
        return result is not None and job.answered_by(result)
