"""Tables of results: for the terminal, as Markdown, and as CSV."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table as RichTable

from sb3_combrel.common.files import write_whole


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


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], n_names: int = 1, aligned: bool = False) -> str:
    """Return a table in GitHub's Markdown; the first ``n_names`` columns hold names, the others numbers, at the right.

    :param aligned: whether columns are as wide as their widest cell, to be read as they are
    """
    lines = [[cell.replace("|", "\\|") for cell in line] for line in (header, *rows)]
    widths = [max(4, *map(len, column)) if aligned else 0 for column in zip(*lines, strict=True)]
    cells = [
        [c.ljust(w) if k < n_names else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))]
        for line in lines
    ]
    rules = [max(w, 3) * "-" if k < n_names else max(w - 1, 3) * "-" + ":" for k, w in enumerate(widths)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (cells[0], rules, *cells[1:]))


def write_tables(tables: Sequence[Table], path: Path, console: Console) -> list[Path]:
    """Show tables, and write them to ``path`` as Markdown, into one file, and as CSV, one file each; the files."""
    made = [path.with_name(f"{path.name}.md")]
    write_whole(made[0], "\n".join(table.as_markdown() for table in tables).encode())
    for number, table in enumerate(tables, 1):
        console.print(table.for_terminal())
        file = path.with_name(f"{path.name}{'' if len(tables) == 1 else f'_{number}'}.csv")
        made.append(write_csv(pd.DataFrame(table.rows, columns=list(table.header)), file))
    return made


def write_csv(frame: pd.DataFrame, path: Path) -> Path:
    """Write a CSV file at once."""
    write_whole(path, frame.to_csv(index=False, lineterminator="\n").encode())
    return path


def without_minus_zero(number: float, digits: int = 0) -> float:
    """Round so that what is shown as zero has no minus sign."""
    return round(number, digits) + 0.0


def p_text(p_value: float) -> str:
    """A p-value for a table: "-" where there is none."""
    if np.isnan(p_value):
        return "-"
    return f"{p_value:.2f}" if p_value >= 0.01 else f"{p_value:.1g}"


def share_text(share: float) -> str:
    """A share in percent for a table."""
    return f"{without_minus_zero(share, 2):.0%}"


def interval_text(low: float, high: float) -> str:
    """An interval of shares for a table: "-" where there is none."""
    return "-" if np.isnan(low) else f"{share_text(low)} to {share_text(high)}"


def mean_and_error(values: np.ndarray) -> str:
    """The mean of runs and its standard error, in whole numbers."""
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{values.mean():,.0f}" if np.isnan(error) else f"{values.mean():,.0f} ± {error:,.0f}"
