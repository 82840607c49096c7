"""Transfer methods in configuration files: their sources, and arguments that replace others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sb3_combrel.sources.recipes import find_source
from sb3_combrel.transfer.base import Transfer


def with_sources(transfer: Transfer | type[Transfer] | dict[str, Any] | str | None) -> Any:
    """
    Replace sources in a description of a transfer method by source instances.

    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it; in a dict, ``source`` may be what :func:`find_source`
        takes, or a list of such
    :return: the description with source instances; anything that is not a dict unchanged
    :raises FileNotFoundError: if there is neither a file nor a task of a source's name
    :raises ValueError: if a source can neither be read nor learnt
    """
    if not isinstance(transfer, dict) or len(transfer) != 1:
        return transfer
    ((method, arguments),) = transfer.items()
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"transfer: {method}: needs arguments, such as 'source: file.npz', got {arguments!r}")
    if not arguments or "source" not in arguments:
        raise ValueError(f"transfer: {method}: has no 'source'; give a file of source instances or the id of a source task")
    source = arguments["source"]
    found = [find_source(each) for each in source] if isinstance(source, list | tuple) else find_source(source)
    return {method: {**arguments, "source": found}}


def with_arguments(transfer: Any, arguments: Mapping[str, Any] | None) -> Any:
    """
    Replace arguments in a description of a transfer method.

    :param transfer: as a configuration file gives it
    :param arguments: new values by name; None for none
    :raises ValueError: if there are arguments but no transfer method given by name
    """
    if not arguments:
        return transfer
    if not isinstance(transfer, dict) or len(transfer) != 1:
        raise ValueError(
            f"transfer_kwargs={dict(arguments)!r} needs a transfer method in the configuration file, such as "
            f"'transfer: {{sb3_combrel.COMBREL: {{source: file.npz}}}}'; transfer is {transfer!r}"
        )
    ((method, given),) = transfer.items()
    return {method: {**(given or {}), **arguments}}
