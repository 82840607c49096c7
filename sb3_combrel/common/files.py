"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def write_whole(target: Path, content: bytes) -> None:
    """Write a file in one go: who reads it finds the old content or the new, even if the writer is killed meanwhile.

    :param target: its folder is made if need be
    :raises OSError: if the file cannot be written
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, as a file can only be renamed within one file system.
    temporary = tempfile.NamedTemporaryFile(prefix=target.name, suffix=".part", dir=target.parent, delete=False)
    try:
        with temporary as file:
            file.write(content)
        # Temporary files are private; give this one the rights of any new file.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary.name, 0o666 & ~umask)
        os.replace(temporary.name, target)
    except BaseException:
        Path(temporary.name).unlink(missing_ok=True)
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
