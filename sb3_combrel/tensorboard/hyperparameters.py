"""The settings of a run as TensorBoard's HPARAMS tab takes them: names with plain values."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax

Plain = bool | int | float | str

#: What is no setting of the learning, or is told otherwise.
LEFT_OUT = ("self", "policy", "env", "transfer", "stats_window_size", "tensorboard_log", "verbose", "device")
LONGEST_TEXT = 80

METRICS = ("rollout/ep_rew_mean", "rollout/ep_len_mean", "model/known")


def hyperparameters(model: FittedRMax) -> dict[str, Plain]:
    """
    Settings of the algorithm and, as ``transfer.NAME``, of its transfer method; what was left to a default is filled in.

    :param model: the algorithm, set up
    """
    transfer = model.policy.transfer
    method = "none" if transfer is None else type(transfer).__name__
    found: dict[str, Plain] = {}
    # The tab shows the first few in the order of the alphabet until the user chooses: this one must be among them.
    found["algorithm"] = type(model).__name__ if transfer is None else f"{type(model).__name__} + {method}"
    found.update(_given(model))
    found["model_breadth"] = model.policy.kernel[0]
    found["resolution"] = _plain(model.policy.model.grid.resolution)
    found["n_envs"] = model.n_envs
    env_id = _env_id(model)
    if env_id is not None:
        found["env"] = env_id
    found["transfer"] = method
    if transfer is not None:
        found.update({f"transfer.{name}": value for name, value in _given(transfer).items()})
    return found


def _given(thing: object) -> dict[str, Plain]:
    """The attributes that bear the names of constructor arguments; None says nothing, and is left out."""
    names = [name for name in inspect.signature(type(thing).__init__).parameters if name not in LEFT_OUT and name[0] != "_"]
    return {name: _plain(getattr(thing, name)) for name in names if getattr(thing, name, None) is not None}


def _plain(value: Any) -> Plain:
    if isinstance(value, bool | int | float | str):
        return value
    text = " ".join(str(value).split())
    return text if len(text) <= LONGEST_TEXT else text[: LONGEST_TEXT - 3] + "..."


def _env_id(model: FittedRMax) -> str | None:
    # Environments in other processes are not asked: a specification that cannot be pickled would end the worker.
    envs = getattr(model.env.unwrapped, "envs", None) if model.env is not None else None
    spec = getattr(envs[0], "spec", None) if envs else None
    return None if spec is None else spec.id
