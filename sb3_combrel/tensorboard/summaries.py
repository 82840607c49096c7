"""What goes into TensorBoard's event files: scalars, the page of custom scalars, settings. This imports TensorBoard."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.summary import hparams

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax

Plain = bool | int | float | str

#: What is no setting of the learning, or is shown under another name.
LEFT_OUT = ("policy", "env", "transfer", "stats_window_size", "tensorboard_log", "verbose", "device")
MAX_TEXT_LENGTH = 80


def _chart(tag: str) -> list[object]:
    return ["Multiline", [f"^{tag}$"]]


#: The Custom Scalars tab. A chart has one curve for each run, so that runs of different methods can be compared.
LAYOUT: dict[str, dict[str, list[object]]] = {
    "Learning": {
        "return of an episode": _chart("rollout/ep_rew_mean"),
        "steps of an episode": _chart("rollout/ep_len_mean"),
        "pairs known from own data (share)": _chart("model/known"),
        "pairs modelled by transfer (share)": _chart("model/transferred"),
        "pairs still optimistic (share)": _chart("model/optimistic"),
        "steps per second": _chart("time/fps"),
    },
    "Evidence": {
        "as how many own instances the source counts": _chart("transfer/prior_strength"),
        "the same by target action": _chart("evidence/.*"),
        "prediction error (no change: 1)": _chart("transfer/prediction_error"),
        "whether the source bounds values": _chart("transfer/values_bounded"),
        "mean of that bound": _chart("transfer/value_bound"),
        "by how much returns exceeded it": _chart("transfer/bound_exceeded"),
    },
    "Transfer": {
        "mean compliance of the chosen mappings": _chart("transfer/compliance"),
        "entropy of the choice (nats)": _chart("transfer/choice_entropy"),
        "mappings in use": _chart("transfer/distinct_mappings"),
        "switches of the choice": _chart("transfer/switches"),
        "transferred instances used": _chart("transfer/instances_used"),
    },
    "Planner": {
        "Bellman residual": _chart("planner/residual"),
        "sweeps": _chart("planner/sweeps"),
        "share of the time": _chart("planner/time_share"),
    },
}


def scalars_summary(scalars: Mapping[str, float]) -> Summary:
    """Make one record of several scalars, given by tag."""
    return Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()])


def settings_summaries(settings: Mapping[str, Any]) -> list[Summary]:
    """Make the HPARAMS tab's records of this run; without that of the columns TensorBoard finds these in all runs."""
    _, *start_and_end = hparams(dict(settings), metric_dict={})
    return start_and_end


def hyperparameters(model: FittedRMax) -> dict[str, Plain]:
    """Collect the settings of the algorithm and, as ``transfer.NAME``, of its transfer method, with the defaults in use."""
    transfer = model.agent.transfer
    of_transfer = {} if transfer is None else _given(transfer, type(transfer))
    method = "none" if transfer is None else type(transfer).__name__
    algorithm = type(model).__name__ if transfer is None else f"{type(model).__name__} + {method}"
    env_id = _env_id(model)
    return {
        "algorithm": algorithm,
        **_given(model, FittedRMax),
        "model_breadth": model.agent.model_settings.model_breadth,
        "resolution": _plain(model.agent.grid.resolution),
        "n_envs": model.n_envs,
        **({} if env_id is None else {"env": env_id}),
        "transfer": method,
        **{f"transfer.{name}": value for name, value in of_transfer.items()},
    }


def _given(thing: object, made_by: type) -> dict[str, Plain]:
    """Return the attributes that have the names of a class's constructor arguments, but for those that are None."""
    names = [name for name in inspect.signature(made_by).parameters if name not in LEFT_OUT and name[0] != "_"]
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
