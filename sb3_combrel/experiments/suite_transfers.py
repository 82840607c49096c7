"""The transfer methods of the suite, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sb3_combrel import COMBREL, TIMBREL, SourceInstances
from sb3_combrel.experiments.misleading_sources import MISLEADING
from sb3_combrel.experiments.mountain_car import factored_mapping
from sb3_combrel.experiments.suite_tasks import Task
from sb3_combrel.transfer.base import Transfer


def _misled(change: Callable[[SourceInstances], SourceInstances]) -> Callable[[SourceInstances, str], Transfer]:
    return lambda source, task: COMBREL(change(source))


#: The mapping that a person would choose, by task.
ORACLES = {
    "MountainCar4D": factored_mapping(2),
    "MountainCar4D-60": factored_mapping(2),
    "MountainCar6D": factored_mapping(3),
}

#: From the name on the command line to a function of (source instances, name of the task).
TRANSFERS: dict[str, Callable[[SourceInstances, str], Transfer]] = {
    "COMBREL": lambda source, task: COMBREL(source),
    "COMBREL-instances": lambda source, task: COMBREL(source, "injective", use="instances"),
    "TIMBREL-random": lambda source, task: TIMBREL(source, "random"),
    "random": lambda source, task: TIMBREL(source, "random", mappings="factored", use="prior"),
    "oracle": lambda source, task: TIMBREL(source, ORACLES[task], use="prior"),
    **{f"COMBREL@{name}": _misled(change) for name, change in MISLEADING.items()},
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
    return TRANSFERS[name](SourceInstances.load(source), task.name)


def check_transfer(name: str, task: Task) -> None:
    """
    Check that a task can be learnt with a transfer method.

    :raises ValueError: if the name is unknown, or the task has no source task
    """
    if name not in TRANSFERS:
        raise ValueError(f"transfer must be one of {', '.join(TRANSFERS)}, got {name!r}")
    if task.source is None:
        raise ValueError(f"transfer={name}: the task {task.name} has no source task")
    if name == "oracle" and task.name not in ORACLES:
        raise ValueError(f"transfer=oracle: nobody knows the mapping of {task.name}; known are {', '.join(ORACLES)}")
