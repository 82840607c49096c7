"""The file of a saved model, as Stable-Baselines3 defines it: written completely or not at all, and checked when read."""

from __future__ import annotations

import base64
import io
import json
import pickle
import struct
import warnings
import zipfile
import zlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path

from sb3_combrel.common.files import write_whole
from sb3_combrel.common.serialisation import damage_text

# What a damaged zip file makes Python's zipfile raise.
_DAMAGE = (
    ValueError,
    LookupError,
    EOFError,
    OSError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)

# The digits of real numbers hardly compress: higher levels take longer and gain a hundredth.
COMPRESSION = 1

# Entries of the data by what they must be. Where they are something else Stable-Baselines3 finds out only later, or never.
_NONE = type(None)
_SERIALIZED = ":serialized:"
_GENERATOR_STATES = ("_generator_state", "_chance")
_ENTRIES_OF_TYPES: dict[tuple[type, ...], tuple[str, ...]] = {
    (int,): (
        "n_envs",
        "num_timesteps",
        "_total_timesteps",
        "_num_timesteps_at_start",
        "_episode_num",
        "_n_updates",
        "_stats_window_size",
        "sde_sample_freq",
    ),
    (int, bool): ("verbose",),
    (bool,): ("use_sde", "_warned_of_max_value"),
    (int, float): ("learning_rate", "start_time", "_current_progress_remaining"),
    (int, _NONE): ("seed",),
    (str, _NONE): ("tensorboard_log",),
    (dict,): ("policy_kwargs",),
    (dict, _NONE): _GENERATOR_STATES,
    (_NONE,): ("action_noise",),
    (spaces.Space,): ("observation_space", "action_space"),
    (np.ndarray, _NONE): ("_last_obs", "_last_episode_starts", "_last_original_obs"),
    (deque, _NONE): ("ep_info_buffer", "ep_success_buffer"),
}
_TYPES = {name: types for types, names in _ENTRIES_OF_TYPES.items() for name in names}


class ParametersError(ValueError, RuntimeError):
    """Parameters that do not fit a model; a RuntimeError as well, since that is what PyTorch raises."""


def write_model(path: str | Path | io.BufferedIOBase, archive: io.BytesIO) -> None:
    """
    Write a model's file, compressed.

    :param path: path of the file, to which .zip is added if it has no suffix; or a file that is open for writing
    :param archive: the file as Stable-Baselines3 makes it
    :raises OSError: if the file cannot be written
    """
    content = _compressed(archive)
    if isinstance(path, str | Path):
        target = Path(path)
        write_whole(target if target.suffix else target.with_name(f"{target.name}.zip"), content)
    else:
        open_path(path, "w").write(content)


def _compressed(archive: io.BytesIO) -> bytes:
    with zipfile.ZipFile(archive) as given:
        return _zipped({name: given.read(name) for name in given.namelist()}, zipfile.ZIP_DEFLATED).getvalue()


def _zipped(parts: Mapping[str, bytes], compression: int) -> io.BytesIO:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", compression, compresslevel=COMPRESSION) as written:
        for name, content in parts.items():
            written.writestr(name, content)
    archive.seek(0)
    return archive


def read_model(
    path: str | Path | io.BufferedIOBase, names: Sequence[str], policy: type[BasePolicy], replaced: Iterable[str] = ()
) -> io.BytesIO:
    """
    Read a model's file, after a check that it is one and is not damaged.

    :param path: path of the file, to which .zip is added if there is none of that name; or a file that is open for reading
    :param names: at least one of these is in the data of such a model, and none in that of other algorithms
    :param policy: the class of its policy, or a base class
    :param replaced: entries of the data that are not used, and not checked
    :return: the file as Stable-Baselines3 makes it, not compressed
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or of another kind
    """
    try:
        file = open_path(path, "r", suffix="zip")
    except IsADirectoryError as error:
        raise ValueError(f"{path} is a folder, not the file of a model") from error
    except AssertionError as error:
        raise ValueError(f"path must be a path or a file that is open for reading, got {path!r}") from error
    try:
        with zipfile.ZipFile(file) as archive:
            # Reading compares with the checksums.
            parts = {name: archive.read(name) for name in archive.namelist()}
        if not {"data", "policy.pth"} <= parts.keys():
            raise ValueError("data or policy.pth is missing")
        data = json.loads(parts["data"])
    except (*_DAMAGE, RecursionError) as error:
        raise _damaged(path, error) from error
    finally:
        if isinstance(path, str | Path):
            file.close()
    if not isinstance(data, dict) or not set(names) & data.keys():
        raise ValueError(f"{path} is the file of another algorithm's model, not of FittedRMax")
    try:
        _check_data({name: entry for name, entry in data.items() if name not in set(replaced)}, policy)
        _read_tensors(parts["policy.pth"])
    except ValueError as error:
        raise _damaged(path, error) from error
    return _zipped(parts, zipfile.ZIP_STORED)


def _damaged(path: object, error: Exception) -> ValueError:
    return ValueError(f"{path} is damaged or not the file of a model that was saved by FittedRMax ({damage_text(error)})")


def _check_data(data: Mapping[str, Any], policy: type[BasePolicy]) -> None:
    """
    Check the entries of the data that Stable-Baselines3 would use without a check.

    :raises ValueError: if one cannot be read or has another type than it must have
    """
    values: dict[str, Any] = {}
    for name, entry in data.items():
        value = _deserialized(name, entry)
        if name == "policy_class" and not (isinstance(value, type) and issubclass(value, policy)):
            raise ValueError(f"policy_class must be {policy.__name__} or a subclass, got {value!r}")
        types = _TYPES.get(name)
        if types is not None and not (type(value) in types or (type(value) is not bool and isinstance(value, types))):
            wanted = " or ".join("None" if each is _NONE else each.__name__ for each in types)
            raise ValueError(f"{name} must be {wanted}, got {type(value).__name__}")
        values[name] = value
        if name == "ep_info_buffer" and value is not None and not all(map(_is_episode, value)):
            raise ValueError("ep_info_buffer has entries that are not the results of episodes")
        if name in _GENERATOR_STATES and value is not None:
            check_generator_state(value)
    if (values.get("ep_info_buffer") is None) != (values.get("ep_success_buffer") is None):
        raise ValueError("one of ep_info_buffer and ep_success_buffer is missing")


def _deserialized(name: str, entry: Any) -> Any:
    if not (isinstance(entry, dict) and _SERIALIZED in entry):
        return entry
    try:
        with warnings.catch_warnings():
            # If there is something to warn of, Stable-Baselines3 reads it once more and warns.
            warnings.simplefilter("ignore")
            return pickle.loads(base64.b64decode(entry[_SERIALIZED].encode()))
    except Exception as error:
        # A damaged pickle can raise anything.
        raise ValueError(f"{name} cannot be read: {damage_text(error)}") from error


def _is_episode(entry: Any) -> bool:
    return isinstance(entry, dict) and all(isinstance(entry.get(key), int | float | np.number) for key in ("r", "l"))


def check_generator_state(state: dict[str, Any]) -> None:
    """
    :raises ValueError: unless ``state`` is that of a random number generator as ``numpy.random.default_rng`` makes them
    """
    try:
        np.random.default_rng(0).bit_generator.state = state
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise ValueError(f"the state of the random number generator is damaged: {damage_text(error)}") from error


def _read_tensors(content: bytes) -> dict[str, th.Tensor]:
    """
    Read tensors by name.

    :raises ValueError: if there is something else in the file, or it is damaged
    """
    try:
        tensors = th.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:
        # PyTorch raises RuntimeError, EOFError, UnpicklingError, and what reading of damaged pickles leads to.
        raise ValueError(f"policy.pth cannot be read: {damage_text(error)}") from error
    check_tensors(tensors)
    return tensors


def check_tensors(tensors: Any) -> None:
    """
    :raises ValueError: unless ``tensors`` is a dict of tensors by name
    """
    if not isinstance(tensors, Mapping):
        raise ValueError(f"parameters of the policy must be a dict of tensors, got {type(tensors).__name__}")
    for name, tensor in tensors.items():
        if not isinstance(name, str) or not isinstance(tensor, th.Tensor):
            raise ValueError(f"the parameter {name!r} of the policy must be a tensor, got {type(tensor).__name__}")


def misfit(saved: Mapping[str, Any], expected: Mapping[str, np.ndarray]) -> str:
    """
    Compare what was saved of an agent with what a new one would save.

    :param saved: tensors by name
    :param expected: arrays by name; shapes must agree, but for the number of rows of arrays with several axes
    :return: what is wrong; empty if nothing
    """
    for name, array in expected.items():
        tensor = saved[name]
        if not isinstance(tensor, th.Tensor) or tensor.dtype not in (th.float64, th.float32):
            return f"{name} must be a tensor of floating-point numbers, got {type(tensor).__name__}"
        shape = (None, *array.shape[1:]) if array.ndim > 1 else array.shape
        got = tuple(tensor.shape)
        if len(got) != len(shape) or any(want not in (None, n) for n, want in zip(got, shape, strict=True)):
            wanted = ", ".join("any" if want is None else str(want) for want in shape)
            return f"{name} must have shape ({wanted}), got {got}"
        if not th.isfinite(tensor).all():
            return f"{name} must have finite numbers only"
    return ""
