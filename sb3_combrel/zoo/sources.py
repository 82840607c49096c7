"""Sources in configuration files: a file of instances, or a task that is learnt once, before the target task."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import Transfer

CACHE_VARIABLE = "SB3_COMBREL_CACHE"
FITTED_RMAX = "fitted_rmax"
DEFAULT_RECIPE: Mapping[str, Any] = {"n_instances": 1000, "total_timesteps": 30_000, "seed": 0}


def with_sources(transfer: Transfer | type[Transfer] | dict[str, Any] | str | None) -> Any:
    """
    Replace sources in a description of a transfer method by source instances.

    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it; in a dict, ``source`` may be what :func:`find_source`
        takes, or a list of such
    :return: the description with source instances; anything that is not a dict unchanged
    :raises ValueError: if a source can neither be read nor learnt
    """
    if not isinstance(transfer, dict) or len(transfer) != 1:
        return transfer
    ((method, arguments),) = transfer.items()
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"transfer: {method}: needs arguments, such as 'source: file.npz', got {arguments!r}")
    if not arguments or "source" not in arguments:
        raise ValueError(f"transfer: {method}: has no 'source'; give a file of source instances or the id of a source task")
    source = arguments["source"]
    found = [find_source(each) for each in source] if isinstance(source, list | tuple) else find_source(source)
    return {method: {**arguments, "source": found}}


def with_arguments(transfer: Any, arguments: Mapping[str, Any] | None) -> Any:
    """
    Replace arguments in a description of a transfer method.

    :param transfer: as a configuration file gives it
    :param arguments: new values by name; None for none
    :raises ValueError: if there are arguments but no transfer method given by name
    """
    if not arguments:
        return transfer
    if not isinstance(transfer, dict) or len(transfer) != 1:
        raise ValueError(
            f"transfer_kwargs={dict(arguments)!r} needs a transfer method in the configuration file, such as "
            f"'transfer: {{sb3_combrel.COMBREL: {{source: file.npz}}}}'; transfer is {transfer!r}"
        )
    ((method, given),) = transfer.items()
    return {method: {**(given or {}), **arguments}}


def find_source(source: Any) -> SourceInstances:
    """
    Read source instances from a file, or learn a task for them.

    :param source: source instances; the path of a file of them; the id of an environment, learnt with
        :data:`DEFAULT_RECIPE`; or a recipe: a dict with ``env``, the id, and arguments of
        :meth:`~sb3_combrel.SourceInstances.from_q_learning`, or, with ``learner: fitted_rmax``, of
        :meth:`~sb3_combrel.SourceInstances.from_fitted_rmax`
    :raises ValueError: if it is none of these
    """
    if isinstance(source, SourceInstances):
        return source
    if isinstance(source, Mapping):
        if not isinstance(source.get("env"), str):
            raise ValueError(f"the recipe of a source needs 'env', the id of its task, got {dict(source)!r}")
        default = {**DEFAULT_RECIPE, "total_timesteps": None} if source.get("learner") == FITTED_RMAX else DEFAULT_RECIPE
        return learn_or_read({name: value for name, value in {**default, **source}.items() if value is not None})
    if not isinstance(source, str | os.PathLike):
        raise ValueError(f"source must be a file, the id of an environment or a recipe, got {source!r}")
    path = Path(source)
    if path.is_file() or path.with_name(path.name + ".npz").is_file():
        return SourceInstances.load(path)
    if _is_task(str(source)):
        return learn_or_read({**DEFAULT_RECIPE, "env": str(source)})
    raise ValueError(
        f"there is no source file {source}, looked for in {Path.cwd()}, and no environment of that name; "
        f"write one with: sb3-combrel record combrel/MountainCar2D-v0 --output {path.with_suffix('.npz')}"
    )


def learn_or_read(recipe: Mapping[str, Any]) -> SourceInstances:
    """
    Learn a task by Q-learning or Fitted R-Max and return instances of it; read them from a file if that was done before.

    Processes that start at the same time each learn the task, with the same seed and so with the same result; files are
    written completely or not at all.

    :param recipe: see :func:`find_source`
    :raises ValueError: if the task cannot be learnt so
    """
    file = cache_file(recipe)
    if file.is_file():
        return SourceInstances.load(file)
    arguments = dict(recipe)
    env_id = arguments.pop("env")
    learner = arguments.pop("learner", "q_learning")
    if learner not in ("q_learning", FITTED_RMAX):
        raise ValueError(f"the recipe's learner must be q_learning or {FITTED_RMAX}, got {learner!r}")
    print(f"Learning the source task {env_id} by {learner}; kept in {file}")
    try:
        by_model = learner == FITTED_RMAX
        source = (SourceInstances.from_fitted_rmax if by_model else SourceInstances.from_q_learning)(env_id, **arguments)
    except (TypeError, gym.error.Error) as error:
        raise ValueError(f"the source task cannot be learnt by the recipe {dict(recipe)}: {error}") from error
    source.save(file)
    return source


def cache_file(recipe: Mapping[str, Any]) -> Path:
    """
    Return the file for the instances of a recipe, in the folder SB3_COMBREL_CACHE (a variable), or ~/.cache/sb3_combrel.

    :param recipe: see :func:`learn_or_read`
    """
    folder = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "sb3_combrel")
    text = json.dumps(dict(recipe), sort_keys=True, default=str)
    name = re.sub(r"\W+", "-", str(recipe["env"]))
    return folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"


def _is_task(name: str) -> bool:
    if name.startswith("combrel/"):
        import combrel_envs  # noqa: F401 - registers them
    try:
        gym.spec(name)
    except (gym.error.Error, ImportError, ValueError):
        return False
    return True
