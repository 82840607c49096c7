"""Experience, whatever has kept it, as source instances: files, tables, datasets, replay buffers and models."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer

from sb3_combrel.sources.replay_buffers import read_buffer
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.sources.transitions import describe_origin, task_names

KINDS = (
    "SourceInstances, a file (.npz, .csv or a saved model's .zip), a pandas DataFrame, a Minari dataset or its id, a replay "
    "buffer, or a model that has its experience"
)
# What pandas reads, besides CSV files.
TABLES_OF_PANDAS = (".parquet", ".pq", ".feather", ".json", ".jsonl", ".tsv", ".xlsx", ".xls", ".h5", ".hdf5")
NO_NAMES: Mapping[str, Any] = MappingProxyType({})
#: By name of the algorithm, what reads the experience from the file of a saved model; the package of it, above this, adds it.
READERS: dict[str, Callable[[Path], SourceInstances]] = {}


def read_experience(given: Any, names: Mapping[str, Any] = NO_NAMES) -> SourceInstances | None:
    """The instances that an object holds; None if it holds none.

    :param names: ``state_names`` and ``action_names`` of the task, for a table without names of its own
    :raises ValueError: if they are damaged, or cannot be told apart
    """
    if isinstance(given, SourceInstances):
        return given
    if isinstance(given, type):
        return None
    if hasattr(given, "columns") and hasattr(given, "iloc"):
        return SourceInstances.from_table(given, **names)
    if hasattr(given, "iterate_episodes"):
        return SourceInstances.from_minari(given)
    if isinstance(given, ReplayBuffer):
        return SourceInstances.from_replay_buffer(given)
    if hasattr(given, "source_instances"):
        found: SourceInstances = given.source_instances()
        return found
    buffer, env = getattr(given, "replay_buffer", None), getattr(given, "env", None)
    if not isinstance(buffer, ReplayBuffer) or buffer.size() == 0:
        return None
    if env is None:
        return SourceInstances.from_replay_buffer(buffer)
    origin = describe_origin(env, type(given).__name__, getattr(given, "seed", None))
    return SourceInstances(*read_buffer(buffer, None, task_names(env), origin))


def find_file(path: Path) -> Path | None:
    """The file of that name, to which a suffix may be added; None if there is none.

    :raises ValueError: if it is one that is not read
    """
    names = (path, *(path.with_name(path.name + suffix) for suffix in (".npz", ".zip", ".pkl") if path.name))
    file = next((each for each in names if each.is_file()), None)
    suffix = "" if file is None else file.suffix.lower()
    if suffix in (".pkl", ".pickle"):
        raise ValueError(
            f"{file} is a pickle, which may run any program when it is read: if you trust it, read it with "
            "stable_baselines3.common.save_util.load_from_pkl, or pandas.read_pickle, and pass what it holds"
        )
    if suffix in TABLES_OF_PANDAS:
        raise ValueError(f"{file} must be one of {KINDS}; read it with pandas, and pass the DataFrame")
    return file


def read_file(file: Path, names: Mapping[str, Any] = NO_NAMES) -> SourceInstances:
    """The instances of a file that :func:`find_file` has found; ``names``: see :func:`read_experience`."""
    if file.name.lower().endswith((".csv", ".txt", ".csv.gz", ".csv.zip")):
        return SourceInstances.from_table(file, **names)
    return READERS["fitted_rmax"](file) if _is_saved_model(file) else SourceInstances.load(file)


def _is_saved_model(file: Path) -> bool:
    """Whether a file is that of a saved model, whatever its name ends in."""
    if not zipfile.is_zipfile(file):
        return file.suffix.lower() == ".zip"
    with zipfile.ZipFile(file) as archive:
        return "data" in archive.namelist()


def read_named(
    argument: str, name: str | os.PathLike[str], names: Mapping[str, Any] = NO_NAMES, remedy: str = ""
) -> SourceInstances:
    """The instances of a file, or of a local Minari dataset of that id.

    :param argument: name of the argument, for errors; ``remedy``: where the id of an environment would do too, what would help
    :raises FileNotFoundError: if there is neither
    """
    path, task = Path(name), "environment or " if remedy else ""
    if (file := find_file(path)) is not None:
        return read_file(file, names)
    if str(name) and path.is_dir():
        raise ValueError(f"{argument} must be a file, got the folder {name}")
    try:
        return SourceInstances.from_minari(str(name))
    except (FileNotFoundError, ImportError) as error:
        raise FileNotFoundError(
            f"there is no file {name}, looked for in {Path.cwd()}, and no {task}Minari dataset of that name is "
            f"here ({error}){remedy}"
        ) from error
