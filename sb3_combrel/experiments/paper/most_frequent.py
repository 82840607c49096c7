"""The mapping that COMBREL used most, which TIMBREL is given in Section 5.2."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sb3_combrel import InterTaskMapping


class Use(NamedTuple):
    """A target action, the source action it was mapped to, and the state mapping as text (``target<-source, ...``)."""

    target_action: str
    source_action: str
    state_mapping: str


def most_frequent_mapping(
    uses: Mapping[Use, int],
    source_variables: Sequence[str],
    target_variables: Sequence[str],
    source_actions: Sequence[str],
    target_actions: Sequence[str],
) -> InterTaskMapping:
    """
    Find the state mapping used most, with the source action to which each target action was mapped most often with it.

    :param uses: how often instances of each mapping were used, over all runs
    :param source_variables: names of the source's state variables; the other names likewise
    :raises ValueError: if there are no uses
    """
    if not uses:
        raise ValueError("no mapping has been used, so none is the most frequent: COMBREL must have been run first")
    states: Counter[str] = Counter()
    for use, n in uses.items():
        states[use.state_mapping] += n
    ((variables, _),) = states.most_common(1)
    action = []
    for target in target_actions:
        with_these = Counter({source: uses.get(Use(target, source, variables), 0) for source in source_actions})
        if not with_these.total():
            # Never used with this state mapping: count over all state mappings.
            for use, n in uses.items():
                with_these[use.source_action] += n * (use.target_action == target)
        action.append(source_actions.index(with_these.most_common(1)[0][0]))
    pairs = dict(pair.split("<-", 1) for pair in variables.split(", "))
    state = [source_variables.index(pairs[name].strip("()-")) if name in pairs else None for name in target_variables]
    sign = [-1 if pairs.get(name, "").startswith("(-") else 1 for name in target_variables]
    return InterTaskMapping(state=tuple(state), action=tuple(action), sign=tuple(sign))
