"""Load a task in the style of dm_control's suite."""

import importlib
from typing import TYPE_CHECKING, Any

from combrel_envs.checks import check_choice

if TYPE_CHECKING:
    from dm_control.rl import control


def load(
    domain: str,
    task: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
) -> "control.Environment":
    """Make a dm_control environment.

    :param domain: ``"mountain_car"`` or ``"icub"``
    :param task: name of one of its tasks, for instance ``"climb_4d"``
    :param task_kwargs: arguments of the task, for instance ``random`` (a seed), ``time_limit``, ``start``
    :param environment_kwargs: arguments of ``dm_control.rl.control.Environment``, for instance ``flat_observation``
    :raises ValueError: when there is no such domain or task
    """
    # Imported, and dm_control with it, when a task of the domain is asked for.
    tasks = importlib.import_module(f"combrel_envs.{check_choice('domain', domain, ('mountain_car', 'icub'))}").SUITE
    kwargs = dict(task_kwargs or {})
    if environment_kwargs is not None:
        kwargs["environment_kwargs"] = environment_kwargs
    return tasks[check_choice(f"task of {domain!r}", task, tasks)](**kwargs)
