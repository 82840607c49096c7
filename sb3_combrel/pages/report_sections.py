"""Sections of a page that are made of reports: the table of mappings, and contradictions in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from sb3_combrel.pages.page import Cell, PageTable, Section
from sb3_combrel.pages.palette import mapping_colours
from sb3_combrel.transfer.report import NOWHERE, Contradiction, MappingReport, TransferReport

NONE, ANOTHER = "—", "another in each run"
FIGURES = {
    "compliance": "compliance",
    "no change": "no_change_compliance",
    "error": "error",
    "strength": "strength",
    "no source": "no_source",
}
EXPLANATION = (
    'Compliance: how well the mapping predicts the target\'s own transitions, 1 is exact, beside that of "no change". Error: '
    'squared, over that of "no change"; below 1 is better. Strength: as how many of the target\'s own instances the source '
    "counts where it has data. No source: how probable it is that these alone predict better."
)


def mapping_section(reports: Mapping[str, Sequence[TransferReport]], colours: Mapping[str, str]) -> Section:
    """Make the table of what each target action was taken for at the end.

    :param reports: by method, of each of its runs; a method without a name has one run
    :param colours: of mappings, by name
    """
    several = any(len(runs) > 1 for runs in reports.values())
    named = any(reports)
    rows = []
    for method, runs in reports.items():
        by_action: dict[str, list[MappingReport]] = {}
        for report in runs:
            for each in report.mappings:
                by_action.setdefault(each.target_action, []).append(each)
        for action, of_runs in by_action.items():
            rows.append(_row(method if named else None, action, of_runs, len(runs) if several else None, colours))
    if not rows:
        return Section("Mappings", ["The method says nothing of mappings, or none has been found."])
    header = [*(("method",) if named else ()), "target action", "mapped to", *(("runs",) if several else ()), *FIGURES]
    kept = [k for k in range(len(header)) if any(row[k].text != NONE for row in rows)]
    table = PageTable([header[k] for k in kept], [[row[k] for k in kept] for row in rows], n_names=3 if named else 2)
    often = ["Of several runs the mapping that most of them found, and means of these."] if several else []
    return Section("Mappings", [*often, EXPLANATION], table=table)


def _row(
    method: str | None, action: str, of_runs: Sequence[MappingReport], n_runs: int | None, colours: Mapping[str, str]
) -> list[Cell]:
    """Make the row of one target action: the mapping that most runs found, if any two of them found the same."""
    [(mapping, n)] = Counter(each.mapping for each in of_runs).most_common(1)
    found = [each for each in of_runs if each.mapping == mapping]
    if n == 1 < len(of_runs):
        mapping, found = ANOTHER, list(of_runs)
    figures = [_mean([getattr(each, name) for each in found]) for name in FIGURES.values()]
    names = [*((Cell(method),) if method is not None else ()), Cell(action), Cell(mapping, colour_of(mapping, colours))]
    runs = [] if n_runs is None else [Cell(NONE if mapping == ANOTHER else f"{n} of {n_runs}")]
    return [*names, *runs, *map(Cell, figures)]


def colours_of_reports(reports: Sequence[TransferReport]) -> dict[str, str]:
    """Give the mappings of several runs their colours: those that they have in the pictures of the first run.

    With ``use="instances"`` the colour is that of the source action, with ``use="prior"`` that of the mapping.
    """
    of_actions = [name for report in reports for name in report.source_actions]
    # In the order in which they came up.
    of_priors = [name for report in reports for point in report.history for name in point.mappings]
    return {**mapping_colours(of_actions), **mapping_colours(of_priors)}


def colour_of(mapping: str, colours: Mapping[str, str]) -> str:
    """Return the colour of a mapping, or of its source action, where these have the colours."""
    return colours.get(mapping, colours.get(mapping.split(" with ")[0], ""))


def _mean(values: Sequence[float]) -> str:
    finite = [value for value in values if np.isfinite(value)]
    return f"{np.mean(finite):.2f}" if finite else NONE


def contradictions_text(report: TransferReport) -> str:
    """Say how often a source was contradicted."""
    nowhere = bool(report.n_compared) and not report.says_nothing and not report.contradictions
    return report.comparison + (f" {NOWHERE}" if nowhere else "")


def contradictions_table(reports: Mapping[str, TransferReport]) -> PageTable | None:
    """List where sources were contradicted, the worst first; None if nowhere.

    :param reports: by method; a method without a name is not named
    """
    rows = [
        [*((Cell(method),) if method else ()), *map(Cell, _contradiction(each))]
        for method, report in reports.items()
        for each in report.contradictions
    ]
    header = [*(("method",) if any(reports) else ()), "target action", "where", "error", "steps"]
    return PageTable(header, rows, n_names=len(header) - 2) if rows else None


def _contradiction(each: Contradiction) -> tuple[str, str, str, str]:
    error = "nothing moved" if np.isinf(each.error) else f"{each.error:.2f}"
    return each.target_action, each.where, error, f"{each.n_compared:,}"
