"""RL-Zoo's commands for the Hugging Face hub, mended for the versions that it installs, and with cards of these algorithms."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from sb3_combrel.zoo.algorithm import ZooFittedRMax
from sb3_combrel.zoo.registration import ALGORITHMS

COMMANDS = ("push_to_hub", "load_from_hub")
#: Words of RL-Zoo's model card, and what they are for this package's algorithms.
_REWORDED = {
    "python -m rl_zoo3.": "python -m sb3_combrel.zoo ",
    "pip install rl_zoo3": 'pip install "sb3-combrel[zoo]"',
    "Install the RL Zoo (with SB3 and SB3-Contrib)": "Install sb3_combrel (with the RL Zoo)",
    "If you installed the RL Zoo3 via pip": "If you installed it via pip",
    ZooFittedRMax.__name__: "FittedRMax",
}
TAG = "sb3_combrel"


@contextmanager
def mended() -> Iterator[None]:
    """Let RL-Zoo's ``push_to_hub`` and ``load_from_hub`` work while it lasts; a ConnectionError if the hub cannot be reached.

    RL-Zoo 2.9 takes a function from huggingface_sb3 that version 3 has under another name, and expects exceptions of
    ``requests``, which huggingface_hub no longer uses. Its commands are scripts, which import both by name when they run.
    """
    import huggingface_sb3
    from huggingface_hub import errors, repocard

    # The package has a function of the same name, which hides the module from ``import ... as``.
    upload = importlib.import_module("huggingface_sb3.push_to_hub")
    with (
        mock.patch.object(upload, "generate_metadata", lambda *args: upload._generate_metadata(*args).to_dict(), create=True),
        mock.patch.object(repocard, "metadata_save", _with_this_package(repocard.metadata_save)),
        mock.patch.object(huggingface_sb3, "load_from_hub", _as_expected(huggingface_sb3.load_from_hub)),
    ):
        try:
            yield
        except errors.HTTPError as error:
            if isinstance(error, OSError):  # the hub's own answer, in a sentence
                raise
            raise ConnectionError(f"the Hugging Face hub cannot be reached ({error})") from error


def _with_this_package(metadata_save: Callable[..., None]) -> Callable[..., None]:
    """Return a function that also puts this package's tag and commands into the card of one of its algorithms."""

    def save(local_path: str | Path, data: dict[str, Any]) -> None:
        card = Path(local_path)
        if not any(f"--algo {name} " in card.read_text(encoding="utf-8") for name in ALGORITHMS):
            metadata_save(card, data)
            return
        metadata_save(card, {**data, "tags": [*data["tags"], TAG]})
        text = card.read_text(encoding="utf-8")
        for theirs, ours in _REWORDED.items():
            text = text.replace(theirs, ours)
        card.write_text(text, encoding="utf-8")

    return save


def _as_expected(load_from_hub: Callable[..., str]) -> Callable[..., str]:
    """Return a function that reports a missing file by the exception that RL-Zoo expects."""
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
    from requests.exceptions import HTTPError

    def load(repo_id: str, filename: str) -> str:
        try:
            return load_from_hub(repo_id, filename)
        except LocalEntryNotFoundError:  # the hub could not be asked
            raise
        except EntryNotFoundError as error:
            raise HTTPError(f"{repo_id} on the Hugging Face hub has no file {filename}") from error

    return load
