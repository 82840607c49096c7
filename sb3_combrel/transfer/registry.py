"""Transfer methods by name, as a YAML file gives them."""

from __future__ import annotations

import copy
import importlib
from typing import Any

from sb3_combrel.transfer.base import Transfer


def make_transfer(transfer: Transfer | type[Transfer] | dict[str, Any] | str | None) -> Transfer | None:
    """
    A transfer object of the algorithm's own, from whatever the user gave.

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
        raise ValueError(
            f"transfer names {name!r}, which does not exist; known are sb3_combrel.COMBREL and sb3_combrel.TIMBREL"
        ) from error
