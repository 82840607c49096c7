"""The file of a saved model, as Stable-Baselines3 defines it: written whole, and looked at before it is trusted."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.save_util import open_path

from sb3_combrel.common.files import write_whole

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


def read_model(path: str | Path | io.BufferedIOBase, names: Sequence[str]) -> io.BytesIO:
    """
    Read a model's file, after a look at whether it is one and is whole.

    :param path: path of the file, to which .zip is added if there is none of that name; or a file that is open for reading
    :param names: one of these at least is in the data of such a model, and of no other algorithm's
    :return: the file as Stable-Baselines3 makes it, not compressed
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or of another kind
    """
    try:
        file = open_path(path, "r", suffix="zip")
    except IsADirectoryError as error:
        raise ValueError(f"{path} is a folder, not the file of a model") from error
    try:
        with zipfile.ZipFile(file) as archive:
            # Reading compares with the checksums.
            parts = {name: archive.read(name) for name in archive.namelist()}
        if not {"data", "policy.pth"} <= parts.keys():
            raise ValueError("it holds no data and policy.pth")
        data = json.loads(parts["data"])
    except _DAMAGE as error:
        raise ValueError(f"{path} is damaged or not the file of a model that was saved by FittedRMax ({error})") from error
    finally:
        if isinstance(path, str | Path):
            file.close()
    if not isinstance(data, dict) or not set(names) & data.keys():
        raise ValueError(f"{path} is the file of another algorithm's model, not of FittedRMax")
    return _zipped(parts, zipfile.ZIP_STORED)


def misfit(saved: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int | None, ...]]) -> str:
    """
    What is wrong with saved arrays; empty if nothing.

    :param saved: arrays by name
    :param shapes: the shape of each, None for a size that may be any
    """
    for name, shape in shapes.items():
        got = saved[name].shape
        if len(got) != len(shape) or any(want not in (None, n) for n, want in zip(got, shape, strict=True)):
            wanted = ", ".join("any" if want is None else str(want) for want in shape)
            return f"{name} must have shape ({wanted}), got {got}"
        if not np.isfinite(saved[name]).all():
            return f"{name} must hold finite numbers only"
    return ""
