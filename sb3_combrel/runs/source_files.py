"""Files with source instances, each learned once for an output folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from sb3_combrel.sources.source_instances import SourceInstances

FOLDER = "sources"


def load_or_learn(path: Path, learn: Callable[[int], SourceInstances], seed: int, console: Console) -> SourceInstances:
    """Load instances from a file, or learn them with a seed and write it."""
    if path.exists():
        try:
            return SourceInstances.load(path)
        except ValueError as error:
            console.print(f"{error}: they are learned again.", markup=False, soft_wrap=True)
    with console.status(f"Learning {path.stem} ..."):
        found = learn(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    found.save(path)
    return found
