"""What tells a job from another: its settings as JSON, the same in every process; of functions and data what they hold."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator

from sb3_combrel.sources.experience import find_file, read_experience
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import Transfer

# What is in these changes with their versions.
OURS = ("sb3_combrel", "combrel_envs", "gymnasium", "stable_baselines3")
# Global data of these kinds count as part of the functions that name them.
_PLAIN = (type(None), bool, int, float, complex, str, bytes, list, tuple, dict, set, frozenset, np.ndarray, np.generic)


def described(value: Any, _within: tuple[Any, ...] = ()) -> Any:
    """Return as JSON: functions by name and what they hold, transfers by arguments, data by digest, others by repr.

    Functions and classes that are not this package's have a digest of their source behind their name, or of their code where
    there is no source, as in a notebook, or, of a lambda, no name that tells it from others. What a function holds are values
    of enclosing functions, those that arguments have by default, plain global ones, and the object that a method is bound to.
    Objects without a repr of their own, and dataclasses, are described by their attributes.

    :param _within: what this is part of, which is not described once more
    :raises ValueError: if a transfer method does not say what its arguments are
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if any(value is each for each in _within):
        return "(as above)"
    part = functools.partial(described, _within=(*_within, value))
    if isinstance(value, functools.partial):
        keywords = {name: part(each) for name, each in value.keywords.items()}
        return {"function": part(value.func), "arguments": [part(each) for each in value.args], **keywords}
    if isinstance(value, Mapping):
        return {str(name): part(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [part(each) for each in value]
    if isinstance(value, Transfer):
        return _described_transfer(value, part)
    if isinstance(value, SourceInstances | np.ndarray) or _is_table(value):
        return _described_data(value, part)
    if isinstance(value, EnvSpec):
        return {**part(vars(value)), "entry_point": part(_creator(value))}
    if callable(value) and hasattr(value, "__qualname__"):
        return _with(_name_of(value), part(_held_by(value)))
    if _is_told_by_attributes(value):
        return _with(_name_of(type(value)), part(getattr(value, "__dict__", {})))
    return _name_of(type(value)) if type(value).__repr__ is object.__repr__ else _plain_repr(value)


def _with(name: str, held: dict[str, Any]) -> Any:
    return {name: held} if held else name


def _described_transfer(transfer: Transfer, part: Callable[[Any], Any]) -> dict[str, Any]:
    try:
        return {_name_of(type(transfer)): part(transfer.arguments())}
    except AttributeError as error:
        name = type(transfer).__name__
        told = f"runs of {name} with other arguments cannot be told apart ({error})"
        raise ValueError(f"{told}: give it the method arguments(), or attributes of these names") from error


def _is_table(value: Any) -> bool:
    """Whether something is a DataFrame of pandas, whose repr leaves rows out."""
    return hasattr(value, "columns") and hasattr(value, "iloc") and not isinstance(value, type)


def _described_data(value: Any, part: Callable[[Any], Any]) -> Any:
    """The digest of an array or table, or of instances: all that is learnt from, so not where they come from."""
    if isinstance(value, SourceInstances):
        content = [getattr(value, each.name) for each in fields(value) if each.name != "origin"]
        arrays = (each if isinstance(each, np.ndarray) else np.array(json.dumps(each)) for each in content)
        return f"{len(value)} instances {_digest(*arrays)}"
    if isinstance(value, np.ndarray):
        # The bytes of objects are their addresses.
        return part(value.tolist()) if value.dtype.hasobject else _digest(value)
    from pandas.util import hash_pandas_object

    return f"{len(value)} rows of {', '.join(map(str, value.columns))} {_digest(hash_pandas_object(value).to_numpy())}"


def data_of(instances: Any) -> Any:
    """What past data hold, wherever they are kept: a file may have another content by the next call."""
    if isinstance(instances, str | os.PathLike):
        file = find_file(Path(instances))
        return instances if file is None else np.frombuffer(file.read_bytes(), np.uint8)
    found = None if _is_table(instances) else read_experience(instances)
    return instances if found is None else found


def _held_by(function: Any) -> dict[str, Any]:
    """The values that a function has from where it was made, by their names; those that change with a version are left out."""
    held = {"self": function.__self__} if inspect.ismethod(function) else {}
    function = getattr(function, "__func__", function)
    if not isinstance(function, FunctionType):
        return {}
    if not _has_version(function):
        names = {name: function.__globals__.get(name, ...) for name in _names_in(function.__code__) if name[:2] != "__"}
        held |= {name: value for name, value in names.items() if isinstance(value, _PLAIN)}
        arguments = inspect.signature(function, follow_wrapped=False).parameters.values()
        held |= {each.name: each.default for each in arguments if each.default is not each.empty}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # it has no value yet
            held[name] = cell.cell_contents
    return held


def _names_in(code: CodeType) -> list[str]:
    """Global names, and those of attributes, in a function and those within it."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return [*code.co_names, *(name for each in inner for name in _names_in(each))]


def _is_told_by_attributes(value: Any) -> bool:
    """Whether an object has no other words for what it is; not so environments, whose attributes change as runs go on."""
    if _has_version(type(value)) or isinstance(value, gym.Env):
        return False
    return type(value).__repr__ is object.__repr__ or is_dataclass(value)


def _plain_repr(value: Any) -> str:
    """The repr of an object, with all of the arrays in it, and the same in another process.

    That has objects at other addresses, and sets in another order.
    """
    if isinstance(value, set | frozenset):
        return str(sorted(map(_plain_repr, value)))
    with np.printoptions(threshold=sys.maxsize, precision=17):
        return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _creator(spec: EnvSpec) -> Any:
    """The class or function of an environment, or its name where it cannot be imported."""
    try:
        return load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    except (ImportError, AttributeError, ValueError):
        return spec.entry_point


def _name_of(defined: Any) -> str:
    """Module and name; and a digest of the source, or of a lambda the code, where this package's version says nothing of it.

    Of a class those that it inherits from count as well, but for the standard library's.
    """
    name = f"{defined.__module__}.{defined.__qualname__}"
    if getattr(defined, "__name__", "") == "<lambda>":
        # Its source is the line that it stands in, which may have others.
        return f"{name} {hashlib.sha256(json.dumps(_code_of(defined.__code__)).encode()).hexdigest()[:8]}"
    if name.partition(".")[0] in OURS:
        return name
    parts = [each for each in getattr(defined, "__mro__", (defined,)) if not _has_version(each)]
    sources = [source for each in parts if (source := _source_of(each))]
    return f"{name} {hashlib.sha256(''.join(sources).encode()).hexdigest()[:8]}" if sources else name


def _has_version(defined: Any) -> bool:
    """Whether something changes only with a version of this package, of those that it rests on, or of Python."""
    return str(defined.__module__).partition(".")[0] in (*OURS, *sys.stdlib_module_names)


def _source_of(defined: Any) -> str:
    """The source of a function or class; or else its code, as of what is typed in; or "" for compiled ones."""
    try:
        return inspect.getsource(defined)
    except (OSError, TypeError):
        code = _code_of(defined)
        return json.dumps(code) if isinstance(code, dict | list) else ""


def _code_of(value: Any) -> Any:
    """What a function or class is made of, as JSON: instructions, names and constants; of a class its functions and values."""
    value = getattr(value, "__func__", value)
    if isinstance(value, type):
        own = {name: each for name, each in vars(value).items() if isinstance(each, FunctionType) or name[:2] != "__"}
        return {name: _code_of(each) for name, each in own.items()}
    if isinstance(value, property):
        return [_code_of(each) for each in (value.fget, value.fset, value.fdel)]
    if isinstance(value, FunctionType):
        return [_code_of(each) for each in (value.__code__, value.__defaults__, value.__kwdefaults__)]
    if isinstance(value, CodeType):
        return [value.co_code.hex(), value.co_names, [_code_of(each) for each in value.co_consts]]
    return _digest(value) if isinstance(value, np.ndarray) else _plain_repr(value)


def _digest(*arrays: np.ndarray) -> str:
    parts = (f"{each.dtype.str} {each.shape}".encode() + np.ascontiguousarray(each).tobytes() for each in arrays)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]
