"""The file of a saved model, as Stable-Baselines3 defines it: written whole, and looked at before it is trusted."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from stable_baselines3.common.save_util import open_path

from sb3_combrel.common.files import write_whole


def write_model(path: str | Path | io.BufferedIOBase, content: bytes) -> None:
    """
    Write a model's file.

    :param path: path of the file, to which .zip is added if it has no suffix; or a file that is open for writing
    :param content: all of it
    :raises OSError: if the file cannot be written
    """
    if isinstance(path, str | Path):
        target = Path(path)
        write_whole(target if target.suffix else target.with_name(f"{target.name}.zip"), content)
    else:
        open_path(path, "w").write(content)


def check_model(path: str | Path | io.BufferedIOBase, must_have: Sequence[str]) -> None:
    """
    Check that a file is that of a model and is whole. A file that is open is left where it was.

    :param path: path of the file, to which .zip is added if it has no suffix; or a file that is open for reading
    :param must_have: names that the model's data must contain
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or of another kind
    """
    file = open_path(path, "r", suffix="zip")
    start = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"its part {damaged} has changed since it was written")
            if not {"data", "policy.pth"} <= set(archive.namelist()):
                raise ValueError("it holds no data and policy.pth")
            data = json.loads(archive.read("data"))
    except (ValueError, LookupError, EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} is damaged or not the file of a model that was saved by FittedRMax ({error})") from error
    finally:
        if isinstance(path, str | Path):
            file.close()
        else:
            file.seek(start)
    if not isinstance(data, dict) or not set(must_have) <= data.keys():
        raise ValueError(f"{path} is the file of another algorithm's model, not of FittedRMax")
