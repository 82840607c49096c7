"""Transfer methods by name, as a YAML file gives them."""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Iterable
from typing import Any

from sb3_combrel.common.serialisation import KIND, from_plain, to_plain
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.transfer.base import Transfer

SAVED = "transfer"
PACKAGE = __name__.partition(".")[0]
METHODS = f"{PACKAGE}.transfer.methods."
# Of files that are sources.
SUFFIXES = (".npz", ".csv", ".zip")


def make_transfer(transfer: Transfer | type[Transfer] | dict[str, Any] | str | None) -> Transfer | None:
    """Make a transfer object of the algorithm's own from what the user gave.

    :param transfer: None; a transfer object, which is copied; a class or its name ("package.module.Class"; of this package its
        class alone will do); or a dict of one entry, such as ``{"sb3_combrel.COMBREL": {"source": "source.npz"}}``
    :raises ValueError: if it is none of these, or the name is not that of a transfer method
    """
    if transfer is None:
        return None
    if isinstance(transfer, Transfer):
        return copy.deepcopy(transfer)
    arguments: dict[str, Any] = {}
    if isinstance(transfer, dict):
        if len(transfer) != 1:
            raise ValueError(f"transfer must have one entry, the method's name and its arguments, got {list(transfer)}")
        ((transfer, given),) = transfer.items()
        arguments = dict(given or {})
    method = _method(transfer) if isinstance(transfer, str) else transfer
    if not (isinstance(method, type) and issubclass(method, Transfer)):
        raise ValueError(f"transfer must be a transfer method such as COMBREL(source), or a dict, got {transfer!r}")
    check_argument_names(method, arguments)
    try:
        return method(**arguments)
    except TypeError as error:
        # Of a class, or of a dict.
        example = f"{method.__name__}(source)"
        raise ValueError(f"transfer must have all its arguments, such as {example}, got {transfer!r}: {error}") from error


def check_argument_names(method: type, arguments: Iterable[str]) -> None:
    """:raises ValueError: if a method, or an algorithm, has no argument of such a name"""
    parameters = inspect.signature(method).parameters
    if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
        return
    for name in arguments:
        if name not in parameters:
            known = ", ".join(parameters)
            raise ValueError(f"{method.__name__} has the arguments {known}, got {name!r}{did_you_mean(name, parameters)}")


def _method(name: str) -> Any:
    module_name, _, attribute = _public(name.replace(":", ".")).rpartition(".")
    try:
        return getattr(importlib.import_module(module_name or PACKAGE), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        own = [each for each in _subclasses(Transfer) if each.__module__.startswith(METHODS) and not inspect.isabstract(each)]
        close = did_you_mean(attribute, [each.__name__ for each in own])
        known = ", ".join(sorted(map(_name, own)))
        hint = f"; a file is the source of a method, transfer=COMBREL({name!r})" if name.endswith(SUFFIXES) else close
        raise ValueError(f"transfer names {name!r}, which is no transfer method; known are {known}{hint}") from error


def describe_transfer(transfer: Transfer | None) -> dict[str, Any] | None:
    """Describe a transfer object as plain data for a file; with a warning, of one that cannot be described only the name."""
    if transfer is None:
        return None
    name = _name(type(transfer))
    try:
        arguments = to_plain(transfer.arguments())
    except (AttributeError, TypeError) as error:
        arguments = None
        warn_user(
            f"{name} is not saved with the model ({error}): give it the method arguments(), or pass it again when the "
            f"model is loaded, load(..., transfer={type(transfer).__name__}(...))"
        )
    return {KIND: SAVED, "method": name, "arguments": arguments}


def restore_transfer(transfer: Any) -> Any:
    """Make the transfer object that :func:`describe_transfer` described; anything else is returned as it is.

    A file may come from anyone: nothing is imported, only classes that are defined already are considered.
    """
    if not isinstance(transfer, dict) or transfer.get(KIND) != SAVED:
        return transfer
    name, arguments = _public(str(transfer.get("method"))), transfer.get("arguments")
    found = [method for method in _subclasses(Transfer) if _name(method) == name]
    if not found or arguments is None:
        missing = "is not defined here: import it first, or" if not found else "could not be saved with it:"
        raise ValueError(
            f"the model was saved with the transfer method {name}, which {missing} pass it again, load(..., transfer=...)"
        )
    try:
        return found[-1](**from_plain(arguments))
    except TypeError as error:
        raise ValueError(f"what was saved of the transfer method {name} does not fit it ({error})") from error


def _name(method: type) -> str:
    return _public(f"{method.__module__}.{method.__qualname__}")


def _public(name: str) -> str:
    """The public name of a method of this package, which stays when modules move."""
    return f"{PACKAGE}.{name.rpartition('.')[2]}" if name.startswith(METHODS) else name


def _subclasses(method: Any) -> list[type[Transfer]]:
    return [each for child in method.__subclasses__() for each in (child, *_subclasses(child))]
