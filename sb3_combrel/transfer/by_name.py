"""Transfer methods by name, as a YAML file gives them."""

from __future__ import annotations

import copy
import importlib
import warnings
from typing import Any

from sb3_combrel.common.serialisation import KIND, from_plain, to_plain
from sb3_combrel.transfer.base import Transfer

SAVED = "transfer"


def make_transfer(transfer: Transfer | type[Transfer] | dict[str, Any] | str | None) -> Transfer | None:
    """
    Make a transfer object of the algorithm's own from what the user gave.

    :param transfer: None; a transfer object, which is copied; a class or its dotted name; or a dict of one entry, from
        the (dotted) name to the arguments, such as ``{"sb3_combrel.COMBREL": {"source": "source.npz"}}``
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
    return method(**arguments)


def _method(name: str) -> Any:
    module_name, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module_name or "sb3_combrel"), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"transfer names {name!r}, which does not exist; known are {', '.join(_known_names())}") from error


def _known_names() -> list[str]:
    """The names of the package's own transfer methods."""
    package = importlib.import_module("sb3_combrel")
    methods = ((name, getattr(package, name)) for name in package.__all__)
    return [f"{package.__name__}.{name}" for name, each in methods if isinstance(each, type) and issubclass(each, Transfer)]


def describe_transfer(transfer: Transfer | None) -> dict[str, Any] | None:
    """
    Describe a transfer object as plain data, for a file; :func:`restore_transfer` makes it again.

    Of an object that plain data cannot describe only the name is kept, with a warning.

    :param transfer: the object, as it was before it was bound or later
    """
    if transfer is None:
        return None
    name = _name(type(transfer))
    arguments = None
    try:
        arguments = to_plain(transfer.arguments())
    except (AttributeError, TypeError) as error:
        warnings.warn(
            f"{name} is not saved with the model ({error}): give it the method arguments(), or pass it again when the "
            f"model is loaded, load(..., transfer={type(transfer).__name__}(...))",
            stacklevel=3,
        )
    return {KIND: SAVED, "method": name, "arguments": arguments}


def restore_transfer(transfer: Any) -> Any:
    """
    Make the transfer object that :func:`describe_transfer` described; anything else is returned as it is.

    A file may come from anyone: nothing is imported, only classes that are defined already are considered.

    :raises ValueError: if the method is not known or was not saved, or if the description is damaged
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
        given = from_plain(arguments)
        renamed = found[-1].renamed_arguments
        return found[-1](**{renamed.get(argument, argument): value for argument, value in given.items()})
    except TypeError as error:
        raise ValueError(f"what was saved of the transfer method {name} does not fit it ({error})") from error


def _name(method: type) -> str:
    return _public(f"{method.__module__}.{method.__qualname__}")


def _public(name: str) -> str:
    """The public name of a method of this package, which stays when modules move: files have had that of the module."""
    package, _, method = name.rpartition(".")
    return f"sb3_combrel.{method}" if package.startswith("sb3_combrel.transfer.") else name


def _subclasses(method: Any) -> list[type[Transfer]]:
    return [each for child in method.__subclasses__() for each in (child, *_subclasses(child))]
