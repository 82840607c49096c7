"""Sources by name: what holds experience, or a task that is learnt once and kept in a file."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import os
import re
import reprlib
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import pandas as pd
from gymnasium.envs.registration import EnvSpec, load_env_creator
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_combrel.common.scaling import has_bounds
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.sources.experience import KINDS, find_file, read_experience, read_file, read_named
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.sources.transitions import LEARNERS, full_id, make_env

#: What a source may be given as, see :func:`find_source`; a Minari dataset as well.
OneSource: TypeAlias = (
    SourceInstances | str | os.PathLike[str] | Mapping[str, Any] | ReplayBuffer | BaseAlgorithm | pd.DataFrame
)

CACHE_VARIABLE = "SB3_COMBREL_CACHE"
RENEW_VARIABLE = "SB3_COMBREL_RENEW"
DEFAULT_RECIPE: Mapping[str, Any] = {"n_instances": 1000, "total_timesteps": 30_000, "seed": 0}
# Files that this process has learned or named: a study of a hundred trials says so once, and learns once.
_SEEN: set[Path] = set()


def checked_source(source: Any) -> Any:
    """A source, or several, with what objects hold as instances; files are not read yet, and no task is learned.

    :raises FileNotFoundError: as :func:`find_source`, ValueError as well
    """
    if isinstance(source, Sequence) and not isinstance(source, str) and len(source) > 0:
        return [checked_source(each) for each in source]
    if isinstance(source, str | os.PathLike):
        if find_file(Path(source)) is not None or task_spec(str(source)) is not None:
            return source
        remedy = "; write one with SourceInstances.record(...).save(path), or with the command sb3-combrel record"
        remedy += did_you_mean(source, gym.registry)
        return read_named("source", source, remedy=remedy)
    if (found := read_experience(source)) is not None:
        return found
    _complete(source)
    return source


def find_source(source: Any) -> SourceInstances:
    """Read source instances, or learn a task for them.

    What a recipe has made is kept in a file (see :func:`cache_file`) and read the next time; what is used, and from when, is
    printed. It is learned again if the environment's class or arguments have changed, and, once in a process, with
    ``renew: true`` in the recipe, or SB3_COMBREL_RENEW=1 among the environment variables.

    :param source: what holds experience (see :func:`~sb3_combrel.sources.experience.read_experience`): source instances, a
        file of them, a CSV file or a pandas DataFrame (:meth:`~sb3_combrel.SourceInstances.from_table`), a Minari dataset or
        its id, a replay buffer, a model that has its experience, or the file of a saved one of this package; the id of an
        environment, learnt with :data:`DEFAULT_RECIPE`, or, if variables have no bounds, by Fitted R-Max; or a recipe: a dict
        with ``env``, the id, and arguments of :meth:`~sb3_combrel.SourceInstances.from_q_learning`, or, with
        ``learner: fitted_rmax``, of :meth:`~sb3_combrel.SourceInstances.from_fitted_rmax`
    :raises FileNotFoundError: if there is neither a file nor a task of that name
    :raises ValueError: if it is none of these, or if the task cannot be learnt so
    """
    source = checked_source(source)
    if isinstance(source, SourceInstances):
        return source
    if isinstance(source, str | os.PathLike):
        file = find_file(Path(source))
        return _learn_or_read({**DEFAULT_RECIPE, "env": str(source)}) if file is None else read_file(file)
    return _learn_or_read(_complete(source))


def _complete(recipe: Any) -> dict[str, Any]:
    """A recipe with what it leaves out."""
    if not isinstance(recipe, Mapping) or not recipe:
        act = hasattr(recipe, "predict") or callable(recipe)
        raise ValueError(
            f"source must be {KINDS}, or a list of these; or a task to learn it from, the id of an environment or a recipe "
            f"such as {{'env': 'MountainCar-v0'}}, got {reprlib.repr(recipe)}"
            f"{': pass what it does, SourceInstances.record(model, env)' if act else ''}"
        )
    if not isinstance(recipe.get("env"), str):
        raise ValueError(f"the recipe of a source needs 'env', the id of its task, got {dict(recipe)!r}")
    learner = recipe.get("learner", "q_learning")
    if learner not in LEARNERS:
        raise ValueError(f"the recipe's learner must be {' or '.join(LEARNERS)}, got {learner!r}")
    default = DEFAULT_RECIPE if learner == "q_learning" else {**DEFAULT_RECIPE, "total_timesteps": None}
    return {name: value for name, value in {**default, **recipe}.items() if value is not None}


def _learn_or_read(recipe: Mapping[str, Any]) -> SourceInstances:
    """Instances of a recipe, from its file if it exists; processes that start together learn it each, with one result."""
    arguments = dict(recipe)
    renew = arguments.pop("renew", False)
    if not isinstance(renew, bool):
        raise ValueError(f"renew must be true or false, got {renew!r}")
    file = cache_file(recipe)
    wanted_anew = (renew or os.environ.get(RENEW_VARIABLE, "0") not in ("", "0")) and file not in _SEEN
    env_id = arguments["env"]
    if file.is_file() and not wanted_anew:
        source = SourceInstances.load(file)
        if file not in _SEEN:
            _SEEN.add(file)
            by = "fitted_rmax" if source.origin.get("recorder") == "FittedRMax" else "q_learning"
            print(
                f"Source task {env_id}: {len(source):,} instances learned by {by} on {_time_of(file)}, from {file} "
                f"(renew: true in the recipe, or {RENEW_VARIABLE}=1, learns them again)"
            )
        return source
    arguments = _with_learner(arguments)
    learner = arguments.pop("learner")
    print(f"Learning the source task {env_id} by {learner}{_reason(file)}; kept in {file}")
    try:
        source = getattr(SourceInstances, f"from_{learner}")(**arguments)
    except (TypeError, gym.error.Error) as error:
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        known = (*inspect.signature(getattr(SourceInstances, f"from_{learner}")).parameters, "learner", "renew")
        close = did_you_mean(unknown[1], known) if unknown else ""
        raise ValueError(f"the source task cannot be learnt by the recipe {dict(recipe)}: {error}{close}") from error
    source.save(file)
    _SEEN.add(file)
    return source


def _with_learner(recipe: dict[str, Any]) -> dict[str, Any]:
    """The recipe with its learner: Q-learning, or Fitted R-Max where variables have no bounds and nothing is asked for.

    :raises ValueError: if variables have no bounds, and Q-learning is asked for, or anything of it
    """
    if recipe.get("learner", "q_learning") != "q_learning" or "bounds" in recipe or _has_bounds(recipe["env"]):
        return {"learner": "q_learning", **recipe}
    others = dict(recipe)
    if others.get("total_timesteps") == DEFAULT_RECIPE["total_timesteps"]:
        del others["total_timesteps"]
    if others.keys() <= {"env", "method", "n_instances", "seed"}:
        return {"learner": "fitted_rmax", **others}
    given = f"'env': {recipe['env']!r}"
    raise ValueError(
        f"{recipe['env']} has state variables without bounds, which Q-learning needs: give lowest and highest values in the "
        f"recipe, {{{given}, 'bounds': [[...], [...]]}}, or have it learned by {{{given}, 'learner': 'fitted_rmax'}}"
    )


def _has_bounds(env_id: str) -> bool:
    """Whether all state variables of a task have bounds; True if that is not known."""
    try:
        env = make_env(env_id)
    except (gym.error.Error, ImportError):
        return True
    with closing(env), suppress(ValueError):
        return has_bounds(env.observation_space)
    return True


def _time_of(file: Path) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(file.stat().st_mtime))


def _reason(file: Path) -> str:
    """Say why a task is learned although it was learned before; "" if it was not."""
    if file.is_file():
        return f" again, in place of what was learned on {_time_of(file)}"
    before = sorted(file.parent.glob(f"{file.stem.rpartition('-')[0]}-*.npz"), key=lambda each: each.stat().st_mtime)
    return f" again: its class or its arguments have changed since {_time_of(before[-1])}" if before else ""


def cache_file(recipe: Mapping[str, Any]) -> Path:
    """Return the file of a recipe's instances (:func:`find_source`), in $SB3_COMBREL_CACHE or ~/.cache/sb3_combrel."""
    folder = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "sb3_combrel")
    text = json.dumps({key: value for key, value in recipe.items() if key != "renew"}, sort_keys=True, default=str)
    name = re.sub(r"\W+", "-", str(recipe["env"]))
    return folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}-{fingerprint(str(recipe['env']))}.npz"


def fingerprint(env_id: str) -> str:
    """A text that changes with an environment: its specification, and the source of its class, bases and what they use."""
    spec = task_spec(env_id)
    if spec is None:
        return ""
    kwargs = repr(sorted(spec.kwargs.items(), key=str))
    parts = [f"{spec.entry_point}", kwargs, f"{spec.max_episode_steps}", repr(spec.additional_wrappers)]
    try:
        made = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    except (ImportError, AttributeError):
        made = None
    modules: set[str] = set()
    package = str(getattr(made, "__module__", "")).partition(".")[0]
    for each in inspect.getmro(made) if inspect.isclass(made) else [made]:
        _add_modules(getattr(each, "__module__", ""), package, modules)
    # What comes from a zip file or the standard input has the name of a file that is none.
    files = (Path(getattr(sys.modules[name], "__file__", None) or "") for name in sorted(modules))
    parts += [file.read_text(errors="replace") for file in files if file.is_file()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _add_modules(name: str, package: str, modules: set[str]) -> None:
    """Add a module; if it is of the environment's package, not Gymnasium, also those of this that it uses, directly or not."""
    root = name.partition(".")[0]
    if name in modules or name not in sys.modules or root in sys.stdlib_module_names or name == "gymnasium.core":
        return
    modules.add(name)
    for value in list(vars(sys.modules[name]).values()) if root == package != "gymnasium" else []:
        used = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None)
        if isinstance(used, str) and used.partition(".")[0] == package:
            _add_modules(used, package, modules)


def task_spec(name: str) -> EnvSpec | None:
    """The environment of an id, or None; a module before a colon is imported first, as by ``gymnasium.make``."""
    module, _, env_id = full_id(name).rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        return gym.spec(env_id)
    except (gym.error.Error, ImportError, ValueError):
        return None
