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
