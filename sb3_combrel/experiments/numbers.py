"""Numbers in the documentation: what a mark in a page says of a CSV file is computed here, filled in, and tested.

``<!-- numbers: FILE | ROWS``, lines ``ROWS | FIGURE; FIGURE ...``, ``-->``: each FIGURE, of the rows of FILE (relative to the
page) that both ROWS, queries of pandas, select, is a number of the paragraph or table that follows. Where a mark has
``{heading}``, this is a cell of the table's row, and all figures are the last cells of each row. A FIGURE is one of

- ``count``; ``value COLUMN``, the cell as it is written
- ``mean COLUMN``, ``median``, ``min``, ``max``, ``sum``: COLUMN may be an expression of columns; ``mean:.1f`` for other digits
- ``error COLUMN``: mean ± standard error; ``interval COLUMN``: mean ± half the width of its 95% interval, by Student's t
- ``saved COLUMN | than ROWS``, ``costs``: in parts of the mean of other rows; ``saved:interval`` adds a 95% bootstrap interval
- ``welch COLUMN | than ROWS``, ``mann-whitney``, ``permutation``: p; ``welch:holm``: by Holm's method over the table's rows

Docstrings have them in a comment of reStructuredText: ``.. numbers: ...`` up to an empty line.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from sb3_combrel.common.files import write_whole
from sb3_combrel.comparison.statistics import TESTS, bootstrap_relative_difference, holm, p_value_of_difference

MARK = re.compile(r"<!-- (table|numbers): (.*?) ?-->\n+((?:<!-- .*?-->\n+)*)", re.DOTALL)
IN_DOCSTRING = re.compile(r"^ *\.\. (numbers): (.*?)\n\s*\n()", re.DOTALL | re.MULTILINE)
#: Of a table's row, by heading.
Cells = dict[str, str]


class Mark(NamedTuple):
    """A mark in a page, and the table or paragraph below it."""

    kind: str  # "table" or "numbers"
    content: str
    below: str

    @property
    def is_of_rows(self) -> bool:
        """Whether the figures are the last cells of each row of a table."""
        return self.below.startswith("|") and "{" in self.content


def marks_in(page: Path) -> list[Mark]:
    """All marks of a page, or of the docstrings of a Python file, in their order."""
    text, position, found = page.read_text(), 0, []
    pattern = MARK if page.suffix == ".md" else IN_DOCSTRING
    while match := pattern.search(text, position):
        position = match.end(2)
        below = text[match.end() :].partition("\n\n")[0].partition("\n<!-- end")[0]
        found.append(Mark(match[1], match[2] if pattern is MARK else re.sub(r"\n +", "\n", match[2]), below))
    return found


def cells_of(table: str) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of a Markdown table."""
    rows = [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in table.splitlines() if "|" in line]
    return rows[0], rows[2:]


@functools.cache
def read(file: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The CSV file with numbers as numbers, and as it is written."""
    data, as_written = pd.read_csv(file), pd.read_csv(file, dtype=str, keep_default_na=False)
    if "steps_of_episodes" in data:
        data["first_episode"] = data["steps_of_episodes"].str.split().str[0].astype(float)
    return data.drop(columns=["settings", "steps_of_episodes"], errors="ignore"), as_written


@functools.cache
def rows_of(file: Path, *queries: str) -> pd.DataFrame:
    """The rows of a file that all queries select; a ValueError if there are none."""
    rows = functools.reduce(lambda data, query: data.query(query) if query else data, queries, read(file)[0])
    if not len(rows):
        raise ValueError(f"{file} must have rows {queries}, got none")
    return rows


def figure_of(file: Path, base: str, query: str, figure: str) -> str | float:
    """What a figure should read; of one that is corrected by Holm's method p, which is not."""
    what, _, than = figure.partition("| than ")
    name, _, column = what.strip().partition(" ")
    name, _, form = name.partition(":")
    rows = rows_of(file, base, query)
    if name == "count":
        return str(len(rows))
    if name == "value":
        return str(read(file)[1].loc[rows.index, column].item())
    if than and rows_of(file, base, than).index.equals(rows.index):
        return ""
    values, others = (each.eval(column).to_numpy(dtype=float) for each in (rows, rows_of(file, base, than or query)))
    if name in ("saved", "costs"):
        return _part_of(values, others, -1.0 if name == "saved" else 1.0, form)
    if name in TESTS:
        p = p_value_of_difference(others, values, name)
        return p if form == "holm" else _written_p(p)
    form = form or ",.0f"
    if not np.isfinite(values).all():
        return f"median {np.median(values):{form}}, {np.isinf(values).sum()} never"
    if name in ("error", "interval"):
        half = stats.sem(values) * (1 if name == "error" else stats.t.ppf(0.975, len(values) - 1))
        return f"{values.mean():{form}} ± {half:{form}}"
    return _signed(getattr(np, name)(values), form)


def _part_of(values: np.ndarray, others: np.ndarray, sign: float, form: str) -> str:
    """How much more than others, in parts of their mean; ``sign`` -1: how much less."""
    if form != "interval":
        return _signed(sign * (values.mean() / others.mean() - 1), form or ".0%")
    more = bootstrap_relative_difference(values, others)
    low, high = sorted((sign * more.low, sign * more.high))
    return f"{_signed(sign * more.value)} ({_signed(low)} to {_signed(high)})"


def _signed(number: float, form: str = ".0%") -> str:
    """A number without the sign of a negative zero."""
    return re.sub(r"^-(?=[0.]*%?$)", "", f"{number:{form}}")


def _written_p(p: float) -> str:
    return f"{p:.2f}" if p >= 0.1 else f"{p:.{2 if p >= 0.001 else 1}g}"


def figures_of(page: Path, content: str, rows: Sequence[Cells] = ({},)) -> list[list[str]]:
    """All figures of a mark: for each row of a table; or once, for a paragraph."""
    table = [_figures_of_row(page, content, cells) for cells in rows]
    for k, column in enumerate(zip(*table, strict=True)):
        tested = {row: p for row, p in enumerate(column) if isinstance(p, float)}
        for row, p in holm(tested).items():
            table[row][k] = _written_p(p)
    return [[str(figure) for figure in row] for row in table]


def _figures_of_row(page: Path, content: str, cells: Cells) -> list[str | float]:
    content = re.sub(r"\{([\w -]+)\}", lambda found: cells[found[1]], re.sub(r"\n +", " ", content))
    (file, base), first, *more = ([part.strip() for part in line.split("|", 1)] for line in content.splitlines())
    of_rows = [(query, each.strip()) for query, all_ in (first, *more) for each in all_.split(";")]
    return [figure_of(page.parent / file, base, query, figure) for query, figure in of_rows]


def rows_with_figures(page: Path, mark: Mark) -> tuple[list[list[str]], list[list[str]]]:
    """The rows of the table below a mark, and the figures that are to be the last cells of each."""
    headings, rows = cells_of(mark.below)
    by_heading = [dict(zip(headings, (cell.strip("`*") for cell in cells), strict=True)) for cells in rows]
    return rows, figures_of(page, mark.content, by_heading)


def missing_from(mark: Mark, page: Path) -> list[str]:
    """The figures of a mark that the paragraph, or the table, below it does not have."""
    text = re.sub(r"\s+", " ", mark.below)
    [figures] = figures_of(page, mark.content)
    return [each for each in figures if not re.search(rf"(?<![\d.,]){re.escape(each)}(?![\d%]|[.,]\d)", text)]


def fill_numbers(page: Path) -> list[str]:
    """Write the figures of all marks of tables; what is missing from paragraphs, which are for a person to write."""
    text, missing = page.read_text(), []
    for mark in marks_in(page):
        if mark.kind != "numbers":
            continue
        if not mark.is_of_rows:
            missing += missing_from(mark, page)
            continue
        lines = mark.below.splitlines()
        for number, (cells, figures) in enumerate(zip(*rows_with_figures(page, mark), strict=True), start=2):
            lines[number] = "| " + " | ".join([*cells[: len(cells) - len(figures)], *figures]) + " |"
        text = text.replace(mark.below, "\n".join(lines), 1)
    write_whole(page, text.encode())
    return missing
