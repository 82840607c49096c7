"""The npz file of source instances: written whole or not at all, read without pickle."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.files import write_whole
from sb3_combrel.common.serialisation import damage_text

FORMAT = "sb3_combrel.SourceInstances"
FORMAT_VERSION = 1
ARRAY_NAMES = ("states", "actions", "rewards", "next_states", "terminated", "low", "high")

Read = TypeVar("Read")


def write_source(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> Path:
    """
    Write arrays and a header to a compressed npz file.

    :param path: path of the file; the suffix .npz is added if it has another or none
    :param arrays: the arrays named in ``ARRAY_NAMES``
    :param header: everything else, of types that JSON can hold
    :return: the path written to
    :raises OSError: if the file cannot be written
    """
    target = _with_suffix(path)
    write_whole(target, source_to_bytes(arrays, header))
    return target


def source_to_bytes(arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> bytes:
    """The content of such a file."""
    text = json.dumps({"format": FORMAT, "version": FORMAT_VERSION, **header})
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, header=np.array(text), **arrays)
    return content.getvalue()


def read_source(path: str | os.PathLike[str], build: Callable[[dict[str, NDArray[Any]], dict[str, Any]], Read]) -> Read:
    """
    Read a file written by :func:`write_source`.

    :param path: path of the file; the suffix .npz may be left out
    :param build: makes the result of the arrays and the header; what it raises is reported as damage of the file
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is damaged, of another kind or of another version of the format
    """
    file = Path(path) if Path(path).is_file() else _with_suffix(path)
    if not file.is_file():
        raise FileNotFoundError(f"there is no source file {file}; write one with SourceInstances.record(...).save(path)")
    try:
        return source_from_bytes(file.read_bytes(), build)
    except Exception as error:
        # Each layer (zip, decompression, npy, JSON, our own checks) has errors of its own kinds for damaged content.
        raise ValueError(
            f"{file} is damaged or not a file of source instances ({damage_text(error)}); "
            "write it again with SourceInstances.record(...).save(path)"
        ) from error


def source_from_bytes(content: bytes, build: Callable[[dict[str, NDArray[Any]], dict[str, Any]], Read]) -> Read:
    """
    What :func:`source_to_bytes` wrote.

    :param build: makes the result of the arrays and the header
    :raises Exception: of many kinds, if the bytes are damaged, of another kind or of another version of the format
    """
    # No pickle: a source file may come from anyone.
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        header = json.loads(str(archive["header"]))
        if header["format"] != FORMAT:
            raise ValueError(f"its format is {header['format']!r}, not {FORMAT!r}")
        if header["version"] != FORMAT_VERSION:
            raise ValueError(f"its format version is {header['version']!r}, this package reads {FORMAT_VERSION}")
        arrays = {name: archive[name] for name in ARRAY_NAMES}
    return build(arrays, header)


def _with_suffix(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    return target if target.suffix == ".npz" else target.with_name(target.name + ".npz")
