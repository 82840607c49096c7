"""The control that a comparison adds by itself: a mapping drawn at random from the set that its first method chooses from."""

from __future__ import annotations

from collections.abc import Mapping

from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.methods.timbrel import TIMBREL
from sb3_combrel.transfer.prior.prior_sets import PRACTICAL_SETS

#: Its name among the methods.
CONTROL = "random mapping"
# What the control has in common with the method that it controls for.
_SAME = ("use", "source_breadth", "transfer_terminals", "breadth", "breadth_decay")


def name_of_control(in_use: Mapping[str, Transfer | None]) -> str:
    """Return the name of the method that is a mapping drawn at random, whoever has added it; or :data:`CONTROL`."""
    return next((name for name, each in in_use.items() if is_control(each)), CONTROL)


def is_control(method: Transfer | None) -> bool:
    """Whether a method is a mapping drawn at random."""
    return isinstance(method, TIMBREL) and method.mapping == "random"


def random_control(in_use: Mapping[str, Transfer | None]) -> TIMBREL | None:
    """Make the control of the first method that chooses among mappings, or of the first to which one is given.

    :param in_use: the methods by name, each bound to the task
    :return: None if no method transfers through mappings, or one of them is such a control
    """
    if name_of_control(in_use) in in_use:
        return None
    with_mappings = [each for each in in_use.values() if isinstance(each, MappingTransfer)]
    if not with_mappings:
        return None
    choosing = [each for each in with_mappings if not _is_given(each)]
    method = (choosing or with_mappings)[0]
    # Where the mapping is given there is no set to draw from but the default one.
    default = PRACTICAL_SETS[0] if method.use == "prior" else "injective"
    same = {name: getattr(method, name) for name in _SAME}
    return TIMBREL(method.source, "random", mappings=method.mappings if choosing else default, **same)


def _is_given(method: MappingTransfer) -> bool:
    return isinstance(method, TIMBREL) or isinstance(method.mappings, FactoredMapping)
