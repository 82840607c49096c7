"""Objects as plain data that JSON can hold, and back: what a saved model keeps of transfer methods. Nothing is pickled.

Classes register here how they are written and read, in the modules in which they are defined.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

KIND = "~kind"
"""The key that distinguishes an object written as a dict from a dict of the user's."""

Content = dict[str, Any]
T = TypeVar("T")

_WRITERS: dict[type, Callable[[Any], tuple[str, Content]]] = {}
_READERS: dict[str, Callable[..., Any]] = {}


def register_writer(written: type[T], write: Callable[[T], tuple[str, Content]]) -> None:
    """Make objects of a class, but not of its subclasses, writable.

    :param write: gives an object's kind, and its content, anything that :func:`to_plain` takes: arguments of the kind's reader
    """
    _WRITERS[written] = write


def register_reader(kind: str, read: Callable[..., Any]) -> None:
    """Make objects of a kind readable.

    :param kind: name of the kind in files; a name is never given to another format
    :param read: makes the object of its content, keyword arguments; it may raise any exception if the content is damaged
    """
    _READERS[kind] = read


def to_plain(value: Any) -> Any:
    """A value as numbers, text, lists and dicts.

    :param value: None, a number, text, a path, an array, an object of a registered class; or sequences and dicts of these
    :raises TypeError: if it is, or contains, something else
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    # Of exactly these types: a subclass may contain more than would be written.
    if type(value) in _WRITERS:
        kind, content = _WRITERS[type(value)](value)
        return {KIND: kind, **{name: to_plain(each) for name, each in content.items()}}
    if isinstance(value, Mapping) and KIND not in value and all(isinstance(key, str) for key in value):
        return {key: to_plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(each) for each in value]
    raise TypeError(f"cannot write {value!r} as plain data")


def from_plain(value: Any) -> Any:
    """What :func:`to_plain` wrote; tuples and arrays come back as lists, paths as text.

    :raises ValueError: if it was not written by :func:`to_plain` or is damaged
    """
    if isinstance(value, Mapping):
        content = {key: from_plain(each) for key, each in value.items() if key != KIND}
        return _read_object(value[KIND], content) if KIND in value else content
    return [from_plain(each) for each in value] if isinstance(value, list) else value


def _read_object(kind: Any, content: Content) -> Any:
    read = _READERS.get(kind) if isinstance(kind, str) else None
    if read is None:
        raise ValueError(f"an object of the kind {kind!r} is not known; known are {', '.join(sorted(_READERS))}")
    try:
        return read(**content)
    except Exception as error:
        # Damaged content makes readers, and the libraries below them, raise errors of any kind.
        raise ValueError(f"what was written of {kind} is damaged ({damage_text(error)})") from error


def damage_text(error: BaseException) -> str:
    """What was wrong with damaged content, given what reading it raised, in one line of at most 300 characters."""
    # A sentence is of something else than a dict, an archive for example.
    if isinstance(error, KeyError) and error.args and " " not in str(error.args[0]):
        return f"{error.args[0]!r} is missing"
    return " ".join(str(error).split())[:300] or type(error).__name__
