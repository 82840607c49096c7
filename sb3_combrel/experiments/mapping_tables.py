"""The mappings that COMBREL used, from the files of its runs: Table 4 of the paper, and the most frequent mapping."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.report import Table
from sb3_combrel.experiments.runs import Run

STATE_MAPPINGS_SHOWN = 10


class Use(NamedTuple):
    """A target action, the source action it was mapped to, and the state mapping as text (``target<-source, ...``)."""

    target_action: str
    source_action: str
    state_mapping: str


def uses_of(runs: Iterable[Run], method: str) -> Counter[Use]:
    """
    Count how often each mapping's instances were used in a step, over all runs of a method.

    :param runs: the experiment's runs
    :param method: name of the method
    """
    uses: Counter[Use] = Counter()
    for run in runs:
        if run.method == method:
            for name, count in run.mapping_counts().items():
                actions, state_mapping = name.split(" with ")
                target, source = actions.split("<-", 1)
                uses[Use(target, source, state_mapping)] += count
    return uses


def action_table(uses: Mapping[Use, int], method: str, source_actions: Sequence[str], target_actions: Sequence[str]) -> Table:
    """
    Make a table of each source action's share in the transfers of each target action (the paper's Table 4, by action).

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
    return Table(f"Source action to which each target action was mapped, {method}", ("source action", *target_actions), rows)


def state_table(uses: Mapping[Use, int], method: str) -> Table:
    """
    Make a table of the state mappings used most.

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
    Find the state mapping used most, with the source action to which each target action was mapped most often with it.

    :param uses: see :func:`uses_of`
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
