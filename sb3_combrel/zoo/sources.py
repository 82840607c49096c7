"""Sources in configuration files: a file of instances, or a task that is learnt first, once, and kept."""

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
    The same transfer with its sources at hand.

    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it; in a dict, ``source`` may be what :func:`find_source`
        takes, or a list of such
    :raises ValueError: if a source cannot be had
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
    The same transfer with other arguments.

    :param transfer: as a configuration file gives it
    :param arguments: take the place of those of the same names; None for none
    :raises ValueError: if there are arguments, and no transfer method with a name that they could go to
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
    Source instances, from a file or from a task.

    :param source: source instances; the path of a file of them; the id of an environment, learnt as
        :data:`DEFAULT_RECIPE` says; or a recipe: a dict with ``env``, the id, and arguments of
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
    Instances of a task learnt by Q-learning or Fitted R-Max; the second time they are read from a file.

    Processes that begin at once each learn it; as the seed is theirs too, so is the result, and no file is half written.

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
    Where the instances of a recipe are kept: in the folder that the variable SB3_COMBREL_CACHE names, or ~/.cache/sb3_combrel.

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
