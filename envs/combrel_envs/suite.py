"""Load a task in the style of dm_control's suite."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dm_control.rl import control

#: Module of each domain; it is imported, and dm_control with it, when a task of the domain is asked for.
_DOMAINS = {
    "mountain_car": "combrel_envs.mountain_car",
    "icub": "combrel_envs.icub",
}


def load(
    domain: str,
    task: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
) -> "control.Environment":
    """
    Make a dm_control environment.

    :param domain: name of a domain, for instance ``"mountain_car"``
    :param task: name of one of its tasks, for instance ``"climb_4d"``
    :param task_kwargs: arguments of the task, for instance ``random`` (a seed), ``time_limit``, ``start``
    :param environment_kwargs: arguments of ``dm_control.rl.control.Environment``, for instance ``flat_observation``
    :return: the environment
    :raises ValueError: when there is no such domain or task
    """
    if domain not in _DOMAINS:
        raise ValueError(f"domain must be one of {', '.join(map(repr, _DOMAINS))}, got {domain!r}")
    tasks = importlib.import_module(_DOMAINS[domain]).SUITE
    if task not in tasks:
        raise ValueError(f"task of {domain!r} must be one of {', '.join(map(repr, tasks))}, got {task!r}")
    kwargs = dict(task_kwargs or {})
    if environment_kwargs is not None:
        kwargs["environment_kwargs"] = environment_kwargs
    return tasks[task](**kwargs)
