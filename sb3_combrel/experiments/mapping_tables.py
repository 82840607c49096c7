"""What mappings COMBREL has used, from the files that runs leave: Table 4 of the paper, and its most frequent mapping."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.report import Table
from sb3_combrel.experiments.runs import Run

STATE_MAPPINGS_SHOWN = 10


class Use(NamedTuple):
    """What stood for a target action: a source action, seen through a state mapping in words (``target<-source, ...``)."""

    target_action: str
    source_action: str
    state_mapping: str


def uses_of(runs: Iterable[Run], method: str) -> Counter[Use]:
    """
    How often each mapping supplied instances to a decision, over all runs of a method.

    :param runs: the experiment's runs
    :param method: name of the method
    """
    uses: Counter[Use] = Counter()
    for run in runs:
        if run.method == method:
            for words, count in run.mapping_counts().items():
                actions, state_mapping = words.split(" with ")
                target, source = actions.split("<-", 1)
                uses[Use(target, source, state_mapping)] += count
    return uses


def action_table(uses: Mapping[Use, int], method: str, source_actions: Sequence[str], target_actions: Sequence[str]) -> Table:
    """
    The share that each source action has in the transfers of each target action (the paper's Table 4, action by action).

    :param uses: see :func:`uses_of`
    """
    total = Counter(dict.fromkeys(target_actions, 0))
    count: Counter[tuple[str, str]] = Counter()
    for use, n in uses.items():
        total[use.target_action] += n
        count[use.source_action, use.target_action] += n
    rows = []
    for source in source_actions:
        shares = [f"{count[source, target] / total[target]:.1%}" if total[target] else "-" for target in target_actions]
        rows.append((source, *shares))
    rows.append(("transfers", *(f"{total[target]:,}" for target in target_actions)))
    return Table(f"Source action that stood for each target action, {method}", ("source action", *target_actions), rows)


def state_table(uses: Mapping[Use, int], method: str) -> Table:
    """
    The state mappings used most.

    :param uses: see :func:`uses_of`
    """
    count: Counter[str] = Counter()
    for use, n in uses.items():
        count[use.state_mapping] += n
    total = max(count.total(), 1)
    rows = [(name, f"{n / total:.1%}") for name, n in count.most_common(STATE_MAPPINGS_SHOWN)]
    return Table(f"State mappings that {method} used most ({len(count)} in all)", ("joints", "share of transfers"), rows)


def most_frequent_mapping(
    uses: Mapping[Use, int],
    source_variables: Sequence[str],
    target_variables: Sequence[str],
    source_actions: Sequence[str],
    target_actions: Sequence[str],
) -> InterTaskMapping:
    """
    The state mapping used most, with the source action that most often stood for each target action under it.

    :param uses: see :func:`uses_of`
    :raises ValueError: if there are no uses
    """
    if not uses:
        raise ValueError("no mapping has been used, so none is the most frequent: COMBREL must have been run first")
    states: Counter[str] = Counter()
    for use, n in uses.items():
        states[use.state_mapping] += n
    ((words, _),) = states.most_common(1)
    action = []
    for target in target_actions:
        with_these = Counter({source: uses.get(Use(target, source, words), 0) for source in source_actions})
        if not with_these.total():
            # Never seen so; what stood for it under any state mapping is the next best.
            with_these.update({u.source_action: n for u, n in uses.items() if u.target_action == target})
        action.append(source_actions.index(with_these.most_common(1)[0][0]))
    pairs = dict(pair.split("<-", 1) for pair in words.split(", "))
    state = [source_variables.index(pairs[name].strip("()-")) if name in pairs else None for name in target_variables]
    sign = [-1 if pairs.get(name, "").startswith("(-") else 1 for name in target_variables]
    return InterTaskMapping(state=tuple(state), action=tuple(action), sign=tuple(sign))
