"""The settings of a run as TensorBoard's HPARAMS tab takes them: names with plain values."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.transfer.base import Transfer

Plain = bool | int | float | str

#: What is no setting of the learning, or is shown under another name.
LEFT_OUT = ("self", "policy", "env", "transfer", "stats_window_size", "tensorboard_log", "verbose", "device")
MAX_TEXT_LENGTH = 80

METRICS = ("rollout/ep_rew_mean", "rollout/ep_len_mean", "model/known")
USUALLY_DIFFER = ("algorithm", "model_breadth", "seed", "transfer.breadth", "transfer.use")
"""The tab shows five settings until the user chooses: these."""


def hyperparameters(model: FittedRMax) -> dict[str, Plain]:
    """
    Collect the settings of the algorithm and, as ``transfer.NAME``, of its transfer method, with the defaults in use.

    :param model: the algorithm, set up
    :return: values by name
    """
    transfer = model.agent.transfer
    method = "none" if transfer is None else type(transfer).__name__
    found: dict[str, Plain] = {}
    found["algorithm"] = type(model).__name__ if transfer is None else f"{type(model).__name__} + {method}"
    found.update(_given(model))
    found["model_breadth"] = model.agent.model_settings.model_breadth
    found["resolution"] = _plain(model.agent.grid.resolution)
    found["n_envs"] = model.n_envs
    env_id = _env_id(model)
    if env_id is not None:
        found["env"] = env_id
    found["transfer"] = method
    if transfer is not None:
        found.update({f"transfer.{name}": value for name, value in _given(transfer).items()})
    return found


def all_settings(model: FittedRMax) -> dict[str, Plain | None]:
    """
    Collect the settings of all runs that may stand beside this one: those of every transfer method that is loaded.

    TensorBoard takes its columns from one of the runs, which may be one without transfer.

    :param model: the algorithm, set up
    :return: values by name, of other methods the defaults; None where there is none
    """
    found: dict[str, Plain | None] = {}
    for method in _subclasses(Transfer):
        found.update({f"transfer.{name}": default for name, default in _arguments(method).items()})
    return {**_arguments(type(model)), **found, **hyperparameters(model)}


def _subclasses(kind: type) -> Iterator[type]:
    each: type
    for each in kind.__subclasses__():
        yield each
        yield from _subclasses(each)


def _arguments(kind: type) -> dict[str, Plain | None]:
    """Return the constructor's arguments and their defaults, None for one that has no default."""
    parameters = inspect.signature(kind.__init__).parameters.values()  # type: ignore[misc]
    named = [each for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)]
    return {
        each.name: None if each.default in (each.empty, None) else _plain(each.default)
        for each in named
        if each.name not in LEFT_OUT and each.name[0] != "_"
    }


def _given(thing: object) -> dict[str, Plain]:
    """Return the attributes that have the names of constructor arguments, but for those that are None."""
    return {name: _plain(getattr(thing, name)) for name in _arguments(type(thing)) if getattr(thing, name, None) is not None}


def _plain(value: Any) -> Plain:
    if isinstance(value, bool | int | float | str):
        return value
    text = " ".join(str(value).split())
    return text if len(text) <= MAX_TEXT_LENGTH else text[: MAX_TEXT_LENGTH - 3] + "..."


def _env_id(model: FittedRMax) -> str | None:
    # Environments in other processes are not asked: a specification that cannot be pickled would end the worker.
    envs = getattr(model.env.unwrapped, "envs", None) if model.env is not None else None
    spec = getattr(envs[0], "spec", None) if envs else None
    return None if spec is None else spec.id
