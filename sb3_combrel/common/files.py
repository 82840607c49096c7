"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_whole(target: Path, content: bytes) -> None:
    """Write a file in one go: who reads it finds the old content or the new, even if the writer is killed meanwhile.

    :param target: its folder is made if need be
    :raises OSError: if the file cannot be written
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, as a file can only be renamed within one file system.
    temporary = target.parent / f"{target.name}.{secrets.token_hex(4)}.part"
    try:
        temporary.write_bytes(content)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_folder(name: str, folder: Path) -> None:
    """Make a folder and see that files can be written to it, before there is anything to lose.

    :param name: of the argument, for the error
    :raises OSError: if not
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".sb3_combrel_probe"
        write_whole(probe, b"")
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise type(error)(
            f"{name} must be in a folder that can be written to, got {folder}: {error.strerror or error}"
        ) from error
