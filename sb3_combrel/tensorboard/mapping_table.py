"""The mappings used most, as a table for TensorBoard's text tab (Table 2 of the COMBREL paper)."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

from sb3_combrel.transfer.mapping_transfer import VirtualSourceTransfer

ROWS = 9
"""As many as the paper shows; the others are added up."""


def mapping_table(transfer: VirtualSourceTransfer, action_names: Sequence[str]) -> str:
    """
    For each target action the share, in per cent, of its transfers that each way of mapping it made, as Markdown.

    A row is a source action together with the source variables that stand for the target's; the rest of a mapping plays
    no part in the transfers of a target action. What counts is every decision that used transferred instances.

    :param transfer: a bound transfer method
    :param action_names: names of the target's actions
    """
    uses = transfer.uses()
    if not uses:
        return "No decision has used transferred instances so far (or those of many mappings at once)."
    shares: dict[str, Counter[int]] = defaultdict(Counter)
    by_action: Counter[int] = Counter()
    for candidate, n in uses.items():
        way = transfer.way(candidate)
        shares[f"{way.source_action} with {way.state_mapping}"][way.target_action] += n
        by_action[way.target_action] += n
    ranked = sorted(shares.items(), key=lambda item: -item[1].total())
    rest = sum((counts for _, counts in ranked[ROWS:]), Counter())
    rows = [*ranked[:ROWS], *([("Others", rest)] if rest else []), ("Total", by_action)]
    lines = [
        f"{len(shares)} mappings in {by_action.total():,} uses. Each column: per cent of that target action's transfers.\n",
        "| source action and state mapping | " + " | ".join([*action_names, "All"]) + " |",
        "| --- |" + " ---: |" * (len(action_names) + 1),
    ]
    lines += [f"| {name} | {' | '.join(_row(counts, by_action, len(action_names)))} |" for name, counts in rows]
    return "\n".join([*lines, "", _commonest(transfer, uses, action_names)])


def _row(counts: Counter[int], of: Counter[int], n_actions: int) -> list[str]:
    cells = [f"{100 * counts[a] / of[a]:.1f}" if of[a] else "-" for a in range(n_actions)]
    return [*cells, f"{100 * counts.total() / of.total():.1f}"]


def _commonest(transfer: VirtualSourceTransfer, uses: dict[int, int], action_names: Sequence[str]) -> str:
    """The source action that most often stood for each target action."""
    votes: dict[int, Counter[str]] = defaultdict(Counter)
    for candidate, n in uses.items():
        way = transfer.way(candidate)
        votes[way.target_action][way.source_action] += n
    parts = [f"{name}<-{votes[a].most_common(1)[0][0]}" for a, name in enumerate(action_names) if votes[a]]
    return f"Most often: {', '.join(parts)}."
