"""Modules that have moved: their old names keep working for one version, with a DeprecationWarning."""

from __future__ import annotations

import importlib
import sys
import warnings
from types import ModuleType
from typing import Any

MOVED = {
    "transfer.inter_task_mapping": "mappings.inter_task_mapping",
    "transfer.mapping_set": "mappings.mapping_set",
    "transfer.mappings": "mappings",
    "transfer.source": "sources.source_instances",
    "transfer.recording": "sources.source_recorder",
    "transfer.q_learning": "sources.q_learning",
    "transfer.combrel": "transfer.methods.combrel",
    "transfer.timbrel": "transfer.methods.timbrel",
    "fitted_rmax.grid": "planning.grid",
}
"""Old names, and where their content is now; both within this package."""


class _MovedModule(ModuleType):
    """Represents a module that has moved, which is imported when something of it is asked for."""

    def __init__(self, old: str, new: str):
        super().__init__(old)
        self._new = new

    def __getattr__(self, name: str) -> Any:
        # The import system asks for attributes of its own.
        if name.startswith("__"):
            raise AttributeError(name)
        warnings.warn(f"{self.__name__} has moved to {self._new}", DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(self._new), name)


def keep_old_names() -> None:
    """Make the old names importable."""
    for old, new in MOVED.items():
        name = f"sb3_combrel.{old}"
        moved = sys.modules.setdefault(name, _MovedModule(name, f"sb3_combrel.{new}"))
        package, _, module = name.rpartition(".")
        # The import system does this for modules that it loads: `import sb3_combrel.transfer.source` needs it.
        if package in sys.modules:
            setattr(sys.modules[package], module, moved)
