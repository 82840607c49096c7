"""The report of a transfer of instances: which mappings, how sure, what the target contradicted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from sb3_combrel.transfer.instances.instance_transfer import InstanceTransfer
from sb3_combrel.transfer.report import MappingReport, TransferReport, describe_sources

_COMPLIANCES = ("compliance", "next_best_compliance", "no_change_compliance")


def report_of_instances(method: str, transfer: InstanceTransfer, statistics: Mapping[str, float]) -> TransferReport:
    """
    Report what was transferred as instances.

    :param method: the method with its arguments, as text
    :param transfer: after one step at least
    :param statistics: the method's figures of the log, by name
    """
    outcomes, errors = transfer.check.outcomes, transfer.errors
    totals = errors.of_actions.sum(axis=0)
    return TransferReport(
        method=method,
        use="instances",
        sources=describe_sources(transfer.sources),
        n_steps=transfer.n_observed,
        n_rested=transfer.check.n_compared,
        mappings=_mappings(transfer),
        error=errors.error(),
        n_compared=int(totals[0]),
        n_worse=int(totals[3]),
        contradictions=errors.contradictions(),
        ends=(outcomes.confirmed, outcomes.contradicted),
        rewards=(outcomes.rewards_right, outcomes.rewards_wrong),
        statistics=statistics,
    )


def _mappings(transfer: InstanceTransfer) -> tuple[MappingReport, ...]:
    """Report, for each target action, the mapping whose instances were used most."""
    found = []
    uses = transfer.uses()
    parts_of = {candidate: transfer.candidates.parts(candidate) for candidate in uses}
    compared, error = transfer.errors.of_actions[:, 0], transfer.errors.errors()
    for a, name in enumerate(transfer.task.action_names):
        of_action = Counter({each: uses[each] for each, parts in parts_of.items() if parts.target_action == a})
        figures = dict(error=float(error[a]), n_compared=int(compared[a]))
        sure = transfer.selector.confidence(a)
        if sure is not None:
            figures |= dict(zip(_COMPLIANCES, sure[:3], strict=True))
        if not of_action:
            nothing = "nothing was transferred" if not compared[a] else "many mappings at once"
            found.append(MappingReport(name, nothing, n_mappings=0, **figures))  # type: ignore[arg-type]
            continue
        ((best, n),) = of_action.most_common(1)
        parts = parts_of[best]
        words = f"{parts.source_action} with {parts.state_mapping}"
        share = n / of_action.total()
        found.append(MappingReport(name, words, share=share, n_mappings=len(of_action), **figures))  # type: ignore[arg-type]
    return tuple(found)
