"""The transfer methods of the suite, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from sb3_combrel import COMBREL, TIMBREL
from sb3_combrel.experiments.suite_tasks import Task
from sb3_combrel.transfer.base import Transfer

#: From the name on the command line to a function of (file with source instances).
TRANSFERS: dict[str, Callable[[Path], Transfer]] = {
    "COMBREL": COMBREL,
    "TIMBREL-random": partial(TIMBREL, mapping="random"),
}


def make_transfer(name: str, task: Task, source: Path) -> Transfer:
    """
    Make the transfer method of a name, for a task.

    :param name: one of :data:`TRANSFERS`
    :param task: the target task
    :param source: file with the instances of its source task
    :raises ValueError: if the name is unknown, or the task has no source task
    """
    check_transfer(name, task)
    return TRANSFERS[name](source)


def check_transfer(name: str, task: Task) -> None:
    """
    Check that a task can be learnt with a transfer method.

    :raises ValueError: if the name is unknown, or the task has no source task
    """
    if name not in TRANSFERS:
        raise ValueError(f"transfer must be one of {', '.join(TRANSFERS)}, got {name!r}")
    if task.source is None:
        raise ValueError(f"transfer={name}: the task {task.name} has no source task")
