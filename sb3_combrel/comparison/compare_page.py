"""The page of a comparison: sentences, curves, measures, mappings, evidence over time, values, and contradictions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from sb3_combrel.comparison.result import CompareResult
from sb3_combrel.pages.page import Cell, Page, PageTable, Section, picture
from sb3_combrel.pages.palette import method_colours
from sb3_combrel.pages.plane import VariablePair, planes_of
from sb3_combrel.pages.report_sections import colours_of_reports, contradictions_table, contradictions_text, mapping_section

NO_HISTORY = 'No method keeps a history of its evidence: those with use="prior" do.'


def compare_page(result: CompareResult, variables: Sequence[VariablePair] | None = None) -> Page:
    """Make the page of a comparison.

    :param variables: pairs of state variables over which values are drawn, see :meth:`CompareResult.save`
    :raises ValueError: if they do not fit the task
    """
    n_runs = len(next(iter(result.curves.values())).returns)
    role = "compared with" if result.baseline in result.reports else "without"
    facts = [
        f"{n_runs} runs of each method, {result.n_steps:,} environment steps that all of them have; {role}: {result.baseline}"
    ]
    sections = [_curves(result), _measures(result)]
    if result.reports:
        reports = [report for runs in result.reports.values() for report in runs]
        sections += [mapping_section(result.reports, colours_of_reports(reports)), _evidence(result)]
    sections += _values(result, variables)
    if result.reports:
        sections.append(_contradictions(result))
    return Page(f"Does transfer help? {result.task}", list(result.sentences.values()), facts, sections, result.warnings)


def _curves(result: CompareResult) -> Section:
    text = "Return of the episode under way, mean of the runs with 95% bootstrap bands."
    return Section("Learning curves", [text], [picture(result.figure, "Return over environment steps, by method")])


def _measures(result: CompareResult) -> Section:
    header, rows = result.rows
    colours = method_colours(result.curves, result.baseline)
    cells = [[Cell(name), Cell(method, colours[method]), *map(Cell, others)] for name, method, *others in rows]
    text = (
        "The measures of Taylor and Stone, with transfer minus without. p: of each comparison by itself; p (Holm): corrected "
        "for the number of methods, as in the sentence above. —: there is no such number."
    )
    return Section("Measures", [text], table=PageTable(header, cells, n_names=2))


def _evidence(result: CompareResult) -> Section:
    title = "Evidence over time"
    histories = {method: [run.history for run in runs if run.history] for method, runs in result.reports.items()}
    histories = {method: runs for method, runs in histories.items() if runs}
    if not histories:
        return Section(title, [NO_HISTORY])
    from sb3_combrel.pages.evidence_drawings import mean_evidence_figure

    draw = partial(mean_evidence_figure, histories, method_colours(result.curves, result.baseline))
    text = "Averaged over target actions; thin lines are runs. A source that is borne out counts for more."
    return Section(title, [text], [picture(draw, "Strength and prediction error over environment steps, by method")])


def _values(result: CompareResult, variables: Sequence[VariablePair] | None) -> list[Section]:
    from sb3_combrel.pages.drawings import value_figure

    sections = []
    for method, shown in result.snapshots.items():
        planes = planes_of(shown.grid, shown.scaling, shown.state_names, variables)
        words = f"Value function and greedy action of {method}"
        pictures = [picture(partial(value_figure, shown, plane), words) for plane in planes]
        sections.append(Section(f"Values after the first run: {method}", pictures=pictures))
    return sections


def _contradictions(result: CompareResult) -> Section:
    first = {method: runs[0] for method, runs in result.reports.items()}
    text = [f"{method}, first run: {contradictions_text(report)}" for method, report in first.items()]
    return Section("Where the source was contradicted", text, table=contradictions_table(first))
