"""The report of a transfer of instances: which mappings, how sure, what the target contradicted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sb3_combrel.transfer.instances.instance_transfer import InstanceTransfer
from sb3_combrel.transfer.instances.selectors import Confidence
from sb3_combrel.transfer.report import MappingReport, TransferReport, describe_sources


def report_of_instances(method: str, transfer: InstanceTransfer, statistics: Mapping[str, float]) -> TransferReport:
    """Report what was transferred as instances; ``method``: with its arguments; ``statistics``: its figures of the log."""
    return TransferReport(
        method=method,
        use="instances",
        sources=describe_sources(transfer.sources),
        n_steps=transfer.n_observed,
        n_rested=transfer.check.n_compared,
        mappings=tuple(_mapping(transfer, a) for a in range(transfer.task.n_actions)),
        error=transfer.errors.error(),
        statistics=statistics,
        **transfer.errors.report_fields(transfer.check.evidence),
    )


def _mapping(transfer: InstanceTransfer, action: int) -> MappingReport:
    """Report the mapping of a target action whose instances were used most."""
    parts_of = {each: transfer.candidates.parts(each) for each in transfer.uses()}
    of_action = {each: n for each, n in transfer.uses().items() if parts_of[each].target_action == action}
    compared = int(transfer.errors.of_actions[action, 0])
    words, share = "many mappings at once" if compared else "nothing was transferred", np.nan
    if of_action:
        best = max(of_action, key=lambda each: of_action[each])
        words = f"{parts_of[best].source_action} with {parts_of[best].state_mapping}"
        share = of_action[best] / sum(of_action.values())
    sure = transfer.selector.confidence(action) or Confidence(np.nan, np.nan, np.nan)
    return MappingReport(
        target_action=transfer.task.action_names[action],
        mapping=words,
        share=share,
        n_mappings=len(of_action),
        compliance=sure.chosen,
        next_best_compliance=sure.next_best,
        no_change_compliance=sure.no_change,
        error=float(transfer.errors.errors()[action]),
        n_compared=compared,
    )
