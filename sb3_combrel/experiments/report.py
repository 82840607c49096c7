"""Tables of an experiment's results, for the terminal and for Markdown files."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table as RichTable

from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.runs import COLUMNS, Run
from sb3_combrel.experiments.statistics import mean_of_runs, saving

MAPPINGS_SHOWN = 8


class Table(NamedTuple):
    """A title, the names of the columns, and rows of text."""

    title: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]

    def for_terminal(self) -> RichTable:
        """Return the table for Rich to print."""
        table = RichTable(title=self.title, title_justify="left")
        for number, name in enumerate(self.header):
            table.add_column(name, justify="left" if number == 0 else "right")
        for row in self.rows:
            table.add_row(*row)
        return table

    def as_markdown(self) -> str:
        """Return the table in GitHub's Markdown."""
        return f"**{self.title}**\n\n{markdown_table(self.header, self.rows)}\n"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], n_names: int = 1) -> str:
    """
    Return a table in GitHub's Markdown, without a line's end after it.

    :param header: names of the columns
    :param rows: their cells; bars in them are escaped
    :param n_names: so many columns at the left hold names; the others hold numbers, which are aligned at the right
    """
    lines = [header, ["---"] * n_names + ["---:"] * (len(header) - n_names), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def episodes_table(steps: Mapping[str, np.ndarray]) -> Table:
    """
    Make a table of the steps of each episode and of all, mean of the runs and half the width of its 95% confidence interval.

    :param steps: for each method the steps of each run's episodes, shape (n_runs, n_episodes)
    """
    n_runs, n_episodes = next(iter(steps.values())).shape
    columns = [
        [_mean_and_half(samples[:, episode]) for episode in range(n_episodes)] + [_mean_and_half(samples.sum(axis=1))]
        for samples in steps.values()
    ]
    labels = [str(episode + 1) for episode in range(n_episodes)] + ["all"]
    title = f"Steps to goal, mean of {n_runs} runs and 95% confidence interval"
    return Table(title, ("episode", *steps), list(zip(labels, *columns, strict=True)))


def savings_table(steps: Mapping[str, np.ndarray], baseline: str) -> Table:
    """
    Make a table of the steps saved over all episodes.

    :param steps: as above
    :param baseline: the method that the others are compared with
    """
    rows = []
    for method, samples in steps.items():
        if method != baseline:
            saved = saving(steps[baseline].sum(axis=1), samples.sum(axis=1))
            interval = "needs more runs" if np.isnan(saved.low) else f"{saved.low:,.0f} to {saved.high:,.0f}"
            p_value = "-" if np.isnan(saved.p_value) else f"{saved.p_value:.1e}"
            rows.append((method, f"{saved.steps:,.0f}", interval, f"{saved.share:.0%}", p_value))
    header = ("method", "steps saved", "95% interval", "share", "p (Welch)")
    return Table(f"Environment steps saved, compared with {baseline}", header, rows)


def mappings_table(runs: Iterable[Run], method: str) -> Table:
    """
    Make a table of the mappings that a method used most, over all its runs.

    :param runs: the experiment's runs
    :param method: name of the method
    """
    counts: Counter[str] = Counter()
    for run in runs:
        if run.method == method:
            counts.update(run.mapping_counts())
    total = max(counts.total(), 1)
    rows = [(name, f"{count / total:.1%}") for name, count in counts.most_common(MAPPINGS_SHOWN)]
    return Table(f"Mappings that {method} used most ({len(counts)} in all)", ("mapping", "share of uses"), rows)


def write_results(runs: Sequence[Run], path: Path) -> Path:
    """
    Write every run's episodes into one CSV file.

    :param runs: the experiment's runs
    :param path: file to write
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("method", "seed", *COLUMNS))
        for run in runs:
            for row in run.episodes()[: run.n_episodes]:
                writer.writerow((run.method, run.seed, *(row[column] for column in COLUMNS)))
    return path


def _mean_and_half(samples: np.ndarray) -> str:
    mean, _, high = mean_of_runs(samples)
    return f"{mean:,.0f}" if np.isnan(high) else f"{mean:,.0f} ± {high - mean:,.0f}"


def write_tables(tables: Sequence[Table], path: Path, console: Console) -> list[Path]:
    """
    Write tables as Markdown, into one file, and as CSV, one file each; and show them.

    :param tables: the tables
    :param path: file to write, without its suffix
    """
    made = [path.with_suffix(".md")]
    write_whole(made[0], "\n".join(table.as_markdown() for table in tables).encode())
    for number, table in enumerate(tables, 1):
        console.print(table.for_terminal())
        file = path.with_name(f"{path.name}{'' if len(tables) == 1 else f'_{number}'}.csv")
        write_whole(file, csv_text([table.header, *table.rows]).encode())
        made.append(file)
    return made


def csv_text(rows: Sequence[Sequence[object]]) -> str:
    """Return rows as the text of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def without_minus_zero(number: float, digits: int = 0) -> float:
    """Round so that what is shown as zero has no minus sign."""
    return round(number, digits) + 0.0


def p_text(p_value: float) -> str:
    """A p-value for a table: "-" where there is none."""
    if np.isnan(p_value):
        return "-"
    return f"{p_value:.2f}" if p_value >= 0.01 else f"{p_value:.1g}"
