"""The settings of a run as TensorBoard's HPARAMS tab takes them: names with plain values."""

from __future__ import annotations

import inspect
from typing import Any

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax

Plain = bool | int | float | str

#: What is no setting of the learning, or is shown under another name.
LEFT_OUT = ("self", "policy", "env", "transfer", "stats_window_size", "tensorboard_log", "verbose", "device")
MAX_TEXT_LENGTH = 80

METRICS = ("rollout/ep_rew_mean", "rollout/ep_len_mean", "model/known")


def hyperparameters(model: FittedRMax) -> dict[str, Plain]:
    """
    Collect the settings of the algorithm and, as ``transfer.NAME``, of its transfer method, with the defaults in use.

    :param model: the algorithm, set up
    :return: values by name
    """
    transfer = model.agent.transfer
    method = "none" if transfer is None else type(transfer).__name__
    found: dict[str, Plain] = {}
    # The tab shows the first few in the order of the alphabet until the user chooses: this one must be among them.
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


def _given(thing: object) -> dict[str, Plain]:
    """Return the attributes that have the names of constructor arguments, but for those that are None."""
    names = [name for name in inspect.signature(type(thing).__init__).parameters if name not in LEFT_OUT and name[0] != "_"]
    return {name: _plain(getattr(thing, name)) for name in names if getattr(thing, name, None) is not None}


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
