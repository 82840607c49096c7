"""What the translator's loops read, and their work space, for compiled code."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.common.compiled import inlined
from sb3_combrel.common.instances import Instances


class SourceArrays(NamedTuple):
    """
    Source instances by action, as the translator reads them (see ``Instances``).

    :param state: float64, shape (n_actions, capacity, n_variables); ``effect``: the same
    :param reward: float64, shape (n_actions, capacity); ``terminated``: bool, same shape
    :param size: int64, shape (n_actions,)
    :param block_low: float64, shape (n_actions, n_variables, n_blocks): boxes around blocks; ``block_high``: the same
    """

    state: np.ndarray
    effect: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    size: np.ndarray
    block_low: np.ndarray
    block_high: np.ndarray

    @classmethod
    def of_instances(cls, instances: Instances) -> SourceArrays:
        """Take what is needed of the instances, without a copy."""
        return cls(*(getattr(instances, name) for name in cls._fields))


class CandidateMappings(NamedTuple):
    """
    What each candidate is, for compiled code.

    :param row: int64, shape (n_candidates,): state mapping, a row of ``variable``; ``action``: same shape, source action
    :param variable: int64, shape (n_state_mappings, n_target_variables): source variable, -1 for none
    :param sign: float64, same shape: -1 where mirrored
    """

    row: np.ndarray
    action: np.ndarray
    variable: np.ndarray
    sign: np.ndarray


class TranslationRules(NamedTuple):
    """
    When and how instances are translated: ``equations.TransferRules``, and two choices.

    :param threshold: weight that own and transferred instances must reach together
    :param breadth: kernel breadth of transferred instances, unit coordinates
    :param min_weight: lighter instances do not count
    :param min_fraction: nearest first, an instance counts while it has this fraction of the weight before it
    :param transfer_terminals: whether an instance that ended a source episode ends the target's
    :param by_relevance: whether instances come in the order of their relevance, not of their distance
    :param times_weight: of their relevance times their weight
    """

    threshold: float
    breadth: float
    min_weight: float
    min_fraction: float
    transfer_terminals: bool
    by_relevance: bool
    times_weight: bool = False


class TranslationScratch(NamedTuple):
    """
    Work space: the instances selected at one state, best first, with room for one more than are ever needed.

    :param number: int64, shape (room, 2): instance and candidate
    :param value: float64, shape (room, 2): what it is ranked by, and its weight
    :param variable: int64, shape (n_variables,): source variables that a candidate compares with
    :param at: float64, same shape: where the state lies along each; ``periodic``: bool, whether it wraps there
    :param gap: float64, shape (n_blocks,): squared distances of the blocks' boxes
    :param full: bool, shape (1,): an instance that was needed did not fit
    :param enters: float64, shape (1,): an instance of no higher rank than this is not needed
    """

    number: np.ndarray
    value: np.ndarray
    variable: np.ndarray
    at: np.ndarray
    periodic: np.ndarray
    gap: np.ndarray
    full: np.ndarray
    enters: np.ndarray

    @classmethod
    def empty(cls, max_instances: int, n_variables: int, n_blocks: int) -> TranslationScratch:
        """Make work space for ``max_instances`` a state."""
        return cls(
            number=np.empty((max_instances + 1, 2), dtype=np.int64),
            value=np.empty((max_instances + 1, 2)),
            variable=np.empty(n_variables, dtype=np.int64),
            at=np.empty(n_variables),
            periodic=np.zeros(n_variables, dtype=np.bool_),
            gap=np.empty(n_blocks),
            full=np.zeros(1, dtype=np.bool_),
            enters=np.zeros(1),
        )


class TranslationArrays(NamedTuple):
    """
    All that the translator's loops read, and their work space.

    :param source: the source instances
    :param mappings: the candidates
    :param rules: when and how instances are translated
    :param relevance: float64, shape (n_candidates, most instances of an action); or (1, 0) if not used
    :param order: int64, shape (n_candidates * most instances of an action,): the same instances, as numbers in the flat array
        of relevances, the most relevant of each candidate first, or of each target action's candidates together; -1 after
        the last. (0,) if not used
    :param scratch: work space
    :param periodic: bool, shape (n_target_variables,): translated instances lie in the target's space, which wraps along these
    """

    source: SourceArrays
    mappings: CandidateMappings
    rules: TranslationRules
    relevance: np.ndarray
    order: np.ndarray
    scratch: TranslationScratch
    periodic: np.ndarray

    def plain(self) -> tuple[Any, ...]:
        """The same as plain tuples (see ``common.compiled``)."""
        structs = tuple(self.source), tuple(self.mappings), tuple(self.rules)
        return *structs, self.relevance, self.order, tuple(self.scratch), self.periodic


@inlined
def as_arrays(plain):
    """:class:`TranslationArrays` from plain tuples."""
    source, mappings, rules = SourceArrays(*plain[0]), CandidateMappings(*plain[1]), TranslationRules(*plain[2])
    return TranslationArrays(source, mappings, rules, plain[3], plain[4], TranslationScratch(*plain[5]), plain[6])
