"""The files that ``sb3-combrel benchmark`` makes of the results: a table and a picture a pair, an overview, and the page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from sb3_combrel.common.files import write_whole
from sb3_combrel.comparison.measures import Comparison
from sb3_combrel.comparison.statistics import ALPHA, Estimate, fewest_runs, smallest_p_value
from sb3_combrel.comparison.tables import Table, p_text, without_minus_zero, write_csv, write_tables
from sb3_combrel.experiments.benchmark.figures import draw_pair
from sb3_combrel.experiments.benchmark.methods import Method
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.scores import (
    FEWEST_RUNS,
    MEASURES,
    Cell,
    MethodScores,
    cells_of,
    compare,
    mean_ranks,
    measure_name,
    n_compared,
    performance_of,
    ranks,
    steps_of_all,
)
from sb3_combrel.runs.job import Result

OVERVIEW, PAGE, RUNS = "overview", "benchmark", "runs.csv"
#: By pair and method; scores only where there are runs.
Cells = Mapping[str, Mapping[str, Cell]]
Scores = Mapping[str, Mapping[str, MethodScores]]
_EMPTY = "-"
_MEASURES = tuple(measure.replace("_", " ") for measure in MEASURES)
_HEADER = ("method", "runs", "performance", "p", "rank", *_MEASURES, "known mapping", "steps to a mapping", "seconds", "note")


def write_report(
    pairs: Sequence[Pair],
    methods: Sequence[Method],
    seeds: Sequence[int],
    outcomes: Sequence[Result],
    output: Path,
    command: Sequence[str],
    console: Console,
) -> list[Path]:
    """Make table and picture of each pair, an overview, a CSV of all runs, and the page with the command; return the files."""
    cells = {pair.name: cells_of(pair, methods, outcomes, seeds) for pair in pairs}
    compared = {pair.name: compare(pair, cells[pair.name]) for pair in pairs}
    made, sections = [], []
    for pair in pairs:
        own = cells[pair.name], compared[pair.name]
        table = pair_table(pair, *own)
        made += write_tables([table], output / pair.name, console)
        made += draw_pair(pair, *own, output / pair.name)
        sections.append(_section(pair, table, cells[pair.name]))
    overview = [rank_table(methods, cells, compared), performance_table(pairs, methods, cells, compared)]
    made += write_tables(overview, output / OVERVIEW, console)
    made.append(_write_runs(outcomes, output / RUNS))
    page = output / f"{PAGE}.md"
    few = few_runs(len(seeds), n_compared(pairs, methods))
    write_whole(page, _page(methods, seeds, few, overview, sections, command).encode())
    return [*made, page]


def pair_table(pair: Pair, cells: Mapping[str, Cell], compared: Mapping[str, MethodScores]) -> Table:
    """Make the table of a pair: a row for each method."""
    places = ranks(performance_of(compared), cells)
    rows = []
    for name, cell in cells.items():
        found = compared.get(name)
        if found is None:
            rows.append((name, *[""] * (len(_HEADER) - 2), note_of(name, cell)))
            continue
        recorded = ([each.more[key] for each in cell.outcomes] for key in ("known_share", "mapping_steps"))
        shares, steps = ([value for value in values if value is not None] for values in recorded)
        performance = estimate_text(found.estimate), p_text(found.p_value), f"{places[name]:g}"
        measures = (_measure_text(pair, found, measure) for measure in MEASURES)
        of_mapping = f"{np.mean(shares):.0%}" if shares else _EMPTY, f"{np.mean(steps):,.0f}" if steps else _EMPTY
        seconds = f"{np.mean([each.seconds for each in cell.outcomes]):.1f}"
        rows.append((name, str(len(cell.outcomes)), *performance, *measures, *of_mapping, seconds, note_of(name, cell)))
    return Table(f"{pair.name}, {pair.budget}", _HEADER, rows)


def note_of(name: str, cell: Cell) -> str:
    """Say why a method does not fit, which runs failed, whose they are, and whether they differ (else tests say less)."""
    notes = []
    if cell.misfit:
        notes.append(f"does not fit: {cell.misfit}")
    for error in dict.fromkeys(cell.errors.values()):
        seeds = [str(seed) for seed, each in cell.errors.items() if each == error]
        notes.append(f"failed (seed {', '.join(seeds)}): {error}")
    if cell.run_as != name:
        notes.append(f"the same as {cell.run_as}")
    if len(cell.outcomes) > 1 and len({(*each.steps, *each.returns) for each in cell.outcomes}) == 1:
        notes.append("all runs alike")
    return "; ".join(notes)


def estimate_text(estimate: Estimate) -> str:
    """An interquartile mean with its interval, if there is one."""
    mean = number_text(float(estimate.mean))
    if not np.isfinite(estimate.low):
        return mean
    return f"{mean} [{number_text(float(estimate.low))}, {number_text(float(estimate.high))}]"


def number_text(number: float) -> str:
    """A return for a table."""
    digits = 0 if abs(number) >= 1000 else 1
    return f"{without_minus_zero(number, digits):,.{digits}f}"


def _measure_text(pair: Pair, found: MethodScores, measure: str) -> str:
    """The effect of a measure against no transfer and, in brackets, its corrected p-value."""
    if found.measures is None:
        return _EMPTY
    comparison: Comparison | None = getattr(found.measures, measure_name(pair, measure))
    if comparison is None or not np.isfinite(comparison.effect):
        return _EMPTY
    p_value = found.p_values[measure]
    percent = measure == "transfer_ratio"
    effect = without_minus_zero(comparison.effect, 2 if percent else 1)
    text = f"{effect:+.0%}" if percent else f"{effect:+,.0f}" if abs(effect) >= 100 else f"{effect:+.1f}"
    return text if np.isnan(p_value) else f"{text} ({p_text(p_value)})"


def rank_table(methods: Sequence[Method], cells: Cells, compared: Scores) -> Table:
    """Make the table of mean ranks, and of how many pairs a method is better and worse in than no transfer, corrected."""
    found = mean_ranks({pair: performance_of(scores) for pair, scores in compared.items()}, cells)
    rows = []
    for name in sorted(found, key=lambda each: found[each].rank):
        rank = found[name]
        tested = [of_pair[name] for of_pair in compared.values() if name in of_pair and not np.isnan(of_pair[name].p_value)]
        differs = [each for each in tested if each.p_value < ALPHA]
        better = sum(each.better for each in differs)
        against = (str(better), str(len(differs) - better)) if tested else (_EMPTY, _EMPTY)
        rows.append((name, f"{rank.rank:.2f}", str(rank.n_pairs), *against))
    rows += [(method.name, "", "0", "", "") for method in methods if method.name not in found]
    header = ("method", "mean rank", "pairs", "better than none", "worse than none")
    return Table(f"Mean rank over pairs, and in how many a method differs from none (p < {ALPHA:g})", header, rows)


def performance_table(pairs: Sequence[Pair], methods: Sequence[Method], cells: Cells, compared: Scores) -> Table:
    """Make the table of interquartile mean performances, ranks in brackets; a row for each method, a column for each pair."""
    places = {name: ranks(performance_of(scores), cells[name]) for name, scores in compared.items()}
    rows = []
    for method in methods:
        row = [method.name]
        for pair in pairs:
            found = compared[pair.name].get(method.name)
            if found is None:
                row.append("failed" if cells[pair.name][method.name].errors else "")
            else:
                mark = "*" if found.p_value < ALPHA else ""
                row.append(f"{number_text(float(found.estimate.mean))}{mark} ({places[pair.name][method.name]:g})")
        rows.append(tuple(row))
    title = f"Performance, interquartile mean (rank); *: differs from none (p < {ALPHA:g})"
    return Table(title, ("method", *(pair.name for pair in pairs)), rows)


def _section(pair: Pair, table: Table, cells: Mapping[str, Cell]) -> str:
    over = "episodes"
    if pair.n_steps is not None:
        n_steps, shortest = steps_of_all(cells)
        over = f"the first {n_steps:,} steps, as many as all runs have in episodes that have ended (fewest: {shortest})"
    threshold = "" if pair.threshold is None else f" Threshold: a return of {pair.threshold:g}."
    text = f"{pair.description} Budget: {pair.budget}. Performance: mean return of an episode over {over}.{threshold}"
    return f"## {pair.name}\n\n{text}\n\n![{pair.name}]({pair.name}.png)\n\n{table.as_markdown()}"


def _page(
    methods: Sequence[Method],
    seeds: Sequence[int],
    few: str,
    overview: Sequence[Table],
    sections: Sequence[str],
    command: Sequence[str],
) -> str:
    """The results as Markdown, with the command."""
    parts = [
        "# The benchmark, pair by pair",
        f"Made by `{shlex.join(command)}`, seeds {seeds[0]} to {seeds[-1]}.",
        *([f"**{few}**"] if few else []),
        *(table.as_markdown() for table in overview),
        Table("The methods", ("method", "what it is"), [(each.name, each.description) for each in methods]).as_markdown(),
        *sections,
    ]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def few_runs(n_seeds: int, n_methods: int) -> str:
    """What is said where there are too few seeds for an interval, or for any of so many methods to differ from none; or ""."""
    smallest = smallest_p_value(n_seeds, n_seeds, n_methods)
    advice = f"take at least {max(FEWEST_RUNS, fewest_runs(n_methods))}, better 10"
    if n_seeds < FEWEST_RUNS:
        needed = f"which need at least {FEWEST_RUNS} runs of each method"
        return f"seeds={n_seeds} is too few for intervals and tests, {needed}: tables have means alone; {advice}"
    if smallest < ALPHA:
        return ""
    compared = f"of {n_methods} method{'s' if n_methods > 1 else ''} compared with none"
    corrected = f"{compared} the smallest possible is {p_text(smallest)}, by Holm's method"
    return f"seeds={n_seeds} is too few for p < {ALPHA:g}: {corrected}; {advice}"


def _write_runs(results: Sequence[Result], path: Path) -> Path:
    """Write one line for each run, as far as it got."""
    rows = []
    for each in sorted(results, key=lambda one: (one.group, one.method, one.seed)):
        run = {"pair": each.group, "method": each.method, "seed": each.seed, "n_steps": each.n_steps}
        more = {key: each.more.get(key) for key in ("known_share", "mapping_steps", "misfit")}
        steps, returns = " ".join(map(str, each.steps)), " ".join(f"{total:.10g}" for total in each.returns)
        rows.append({**run, **more, "error": each.error, "steps_of_episodes": steps, "returns_of_episodes": returns})
    return write_csv(pd.DataFrame(rows, dtype=object), path)
