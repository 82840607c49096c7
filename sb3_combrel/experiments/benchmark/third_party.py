"""Methods and pairs that others define, in modules or files of theirs."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle


def load_attribute(argument: str, text: str) -> tuple[Any, str]:
    """Return what "module:Name" or "file.py:Name" defines, and the file's digest; ValueError if that fails."""
    place, _, name = text.rpartition(":")
    module, digest = _load(argument, place)
    if not hasattr(module, name):
        raise ValueError(f"{argument}: {place} defines no {name}, got {text!r}")
    return getattr(module, name), digest


def _load(argument: str, place: str) -> tuple[ModuleType, str]:
    is_file = place.endswith(".py")
    if is_file and not Path(place).is_file():
        raise ValueError(f"{argument}: there is no file {place}")
    try:
        module = _of_file(Path(place)) if is_file else importlib.import_module(place)
    except Exception as error:  # whatever the module raises
        raise ValueError(f"{argument}: {place} cannot be imported: {type(error).__name__}: {error}") from error
    if module.__name__.partition(".")[0] != "sb3_combrel":
        # Workers need not have it: what it defines goes to them with the job.
        cloudpickle.register_pickle_by_value(module)
    return module, _digest(Path(module.__file__)) if module.__file__ else ""


def _of_file(path: Path) -> ModuleType:
    name = f"combrel_benchmark_{path.stem}_{_digest(path)}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Data classes look their module up while it is being executed.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
