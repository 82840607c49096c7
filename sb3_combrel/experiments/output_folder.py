"""A folder for the results of one set of settings: what is in it of others is neither mixed with them nor overwritten."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_combrel.common.files import write_whole

SETTINGS_FILE = "settings.json"


def prepare_folder(output: Path, now: dict[str, Any]) -> None:
    """
    Prepare the folder for results; those of an earlier call with the same settings are kept.

    :param output: the folder
    :param now: what the results of this call depend on, as JSON represents it; settings that only earlier calls had are kept
    :raises ValueError: if it has results of other settings, or files that are not results of this command
    """
    file = output / SETTINGS_FILE
    if output.exists() and not file.exists() and any(output.iterdir()):
        raise ValueError(f"{output} has files that are not results of this command; choose another --output")
    before = _settings_in(file) if file.exists() else {}
    other = [f"{key} was {before[key]!r} and is {now[key]!r}" for key in now if key in before and before[key] != now[key]]
    if other:
        raise ValueError(f"{output} has results of other settings ({'; '.join(other)}); use another --output")
    write_whole(file, (json.dumps({**before, **now}, indent=2) + "\n").encode())


def _settings_in(file: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(file.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{file} is damaged ({error}), so nobody knows of which settings its folder has results; use another --output"
        ) from error
