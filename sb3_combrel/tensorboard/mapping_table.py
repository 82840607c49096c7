"""The mappings used most, as a table for TensorBoard's text tab (Table 2 of the COMBREL paper)."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

ROWS = 9
"""As many as in the paper; the others are summed."""


def mapping_table(transfer: MappingTransfer, action_names: Sequence[str]) -> str:
    """
    Make a Markdown table of each mapping's share, in per cent, in the transfers of each target action; or say there were none.

    A row is a source action with pairs of variables. Every step of the agent's that used transferred instances counts.
    """
    uses = transfer.uses()
    if not uses:
        return "No step has used transferred instances so far (or only those of many mappings at once)."
    shares: dict[str, Counter[int]] = defaultdict(Counter)
    by_action: Counter[int] = Counter()
    for candidate, n in uses.items():
        parts = transfer.candidate(candidate)
        shares[f"{parts.source_action} with {parts.state_mapping}"][parts.target_action] += n
        by_action[parts.target_action] += n
    ranked = sorted(shares.items(), key=lambda item: -item[1].total())
    rest = sum((counts for _, counts in ranked[ROWS:]), Counter())
    rows = [*ranked[:ROWS], *([("Others", rest)] if rest else []), ("Total", by_action)]
    lines = [
        f"{len(shares)} mappings in {by_action.total():,} uses. Each column: per cent of that target action's transfers.\n",
        "| source action and state mapping | " + " | ".join(map(escaped, [*action_names, "All"])) + " |",
        "| --- |" + " ---: |" * (len(action_names) + 1),
    ]
    lines += [f"| {escaped(name)} | {' | '.join(_row(counts, by_action, len(action_names)))} |" for name, counts in rows]
    return "\n".join([*lines, "", _commonest(transfer, uses, action_names)])


def escaped(name: str) -> str:
    """A name as a cell of a Markdown table."""
    return name.replace("|", "\\|")


def _row(counts: Counter[int], of: Counter[int], n_actions: int) -> list[str]:
    cells = [f"{100 * counts[a] / of[a]:.1f}" if of[a] else "-" for a in range(n_actions)]
    return [*cells, f"{100 * counts.total() / of.total():.1f}"]


def _commonest(transfer: MappingTransfer, uses: dict[int, int], action_names: Sequence[str]) -> str:
    """Return the source action to which each target action was mapped most often, as a sentence."""
    counts: dict[int, Counter[str]] = defaultdict(Counter)
    for candidate, n in uses.items():
        parts = transfer.candidate(candidate)
        counts[parts.target_action][parts.source_action] += n
    pairs = [f"{name}<-{counts[a].most_common(1)[0][0]}" for a, name in enumerate(action_names) if counts[a]]
    return f"Most often: {', '.join(pairs)}."
