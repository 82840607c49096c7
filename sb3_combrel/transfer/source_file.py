"""The npz file of source instances: written whole or not at all, read without pickle."""

from __future__ import annotations

import io
import json
import os
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FORMAT = "sb3_combrel.SourceInstances"
FORMAT_VERSION = 1
ARRAY_NAMES = ("states", "actions", "rewards", "next_states", "terminated", "low", "high")

# What the zip, npy, JSON and instance layers raise for bytes that are not what they expect.
_DAMAGE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)

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
    text = json.dumps({"format": FORMAT, "version": FORMAT_VERSION, **header})
    target.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, as a file can only be renamed within one file system.
    temporary = tempfile.NamedTemporaryFile(prefix=target.name, suffix=".part", dir=target.parent, delete=False)
    try:
        with temporary as file:
            np.savez_compressed(file, allow_pickle=False, header=np.array(text), **arrays)
        # Temporary files are private; give this one the rights of any new file.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary.name, 0o666 & ~umask)
        os.replace(temporary.name, target)
    except BaseException:
        Path(temporary.name).unlink(missing_ok=True)
        raise
    return target


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
    content = io.BytesIO(file.read_bytes())
    try:
        # No pickle: a source file may come from anyone.
        with np.load(content, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            if header["format"] != FORMAT:
                raise ValueError(f"its format is {header['format']!r}, not {FORMAT!r}")
            if header["version"] != FORMAT_VERSION:
                raise ValueError(f"its format version is {header['version']!r}, this package reads {FORMAT_VERSION}")
            arrays = {name: archive[name] for name in ARRAY_NAMES}
        return build(arrays, header)
    except _DAMAGE as error:
        raise ValueError(
            f"{file} is damaged or not a file of source instances ({error}); "
            "write it again with SourceInstances.record(...).save(path)"
        ) from error


def _with_suffix(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    return target if target.suffix == ".npz" else target.with_name(target.name + ".npz")
