"""Taylor & Stone's measures of transfer for every method of a domain, against no transfer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_combrel.comparison.curves import LearningCurves, curves_of
from sb3_combrel.comparison.measures import Comparison, compare_learning, counts_within
from sb3_combrel.comparison.statistics import holm
from sb3_combrel.comparison.tables import Table, p_text, without_minus_zero
from sb3_combrel.experiments.paper.domains import Domain
from sb3_combrel.experiments.paper.methods import METHODS, NO_TRANSFER
from sb3_combrel.experiments.paper.runs import Result

#: Columns of the table, and the fields of :class:`~sb3_combrel.comparison.measures.TransferMeasures`.
_COLUMNS = {
    "jumpstart": "jumpstart",
    "asymptotic performance": "asymptotic_performance",
    "total reward": "total_reward",
    "transfer ratio": "transfer_ratio",
    "time to threshold": "time_to_threshold",
}


def measures_table(domain: Domain, results: Sequence[Result]) -> Table:
    """
    Make a table of jumpstart, asymptotic performance, total reward, transfer ratio and time to threshold of each method.

    Each cell has the effect against no transfer and, in brackets, its p-value by Holm's method over the column.

    :param domain: the domain
    :param results: of its runs, with no transfer among them
    """
    have = {result.method for result in results}
    curves = {method: _curves(results, method) for method in METHODS if method in have}
    without = curves.pop(NO_TRANSFER)
    # The ratio depends on it: the lowest return of any run, the same for all rows.
    floor = float(min(result_curves.returns.min() for result_curves in (without, *curves.values())))
    threshold = -float(domain.thresholds[-1]) if domain.name != "icub" else 100.0 - domain.thresholds[-1]
    # In a short trial all episodes are the first, and the last.
    counts = counts_within(without.returns.shape[1])
    found = {
        method: compare_learning(its_own, without, threshold=threshold, floor=floor, **counts)
        for method, its_own in curves.items()
    }
    columns = []
    for field in _COLUMNS.values():
        comparisons: list[Comparison] = [getattr(measures, field) for measures in found.values()]
        p_values = holm(np.array([comparison.p_value for comparison in comparisons]))
        percent = field == "transfer_ratio"
        columns.append([_cell(each, p, percent) for each, p in zip(comparisons, p_values.tolist(), strict=True)])
    rows = [(method, *cells) for method, cells in zip(found, zip(*columns, strict=True), strict=True)]
    title = (
        f"{domain.title}: measures of transfer against no transfer; p by Holm's method (threshold: a return of {threshold:g})"
    )
    return Table(title, ("method", *_COLUMNS), rows)


def _curves(results: Sequence[Result], method: str) -> LearningCurves:
    runs = sorted((result for result in results if result.method == method), key=lambda result: result.seed)
    return curves_of(runs)


def _cell(comparison: Comparison, p_value: float, percent: bool) -> str:
    if not np.isfinite(comparison.effect):
        return "-"
    effect = without_minus_zero(comparison.effect, 2 if percent else 0)
    text = f"{effect:+.0%}" if percent else f"{effect:+,.0f}"
    return f"{text} ({p_text(p_value)})"
