"""Numbers in the documentation are those of the CSV file that a mark before the table or paragraph names.

``<!-- table: results/paper/table6.md, 1 -->``: a table that ``make results`` has filled in; cells are those of the CSV file.

``<!-- numbers: FILE | ROWS``, lines ``ROWS | FIGURE; FIGURE ...``, ``-->``: each FIGURE, of the rows of FILE (relative to the
page) that both ROWS, queries of pandas, select, is a number of the paragraph or table that follows. Where a mark has
``{heading}``, this is a cell of the table's row, and all figures are the last cells of each row. A FIGURE is one of

- ``count``; ``value COLUMN``, the cell as it is written
- ``mean COLUMN``, ``median``, ``min``, ``max``, ``sum``: COLUMN may be an expression of columns; ``mean:.1f`` for other digits
- ``error COLUMN``: mean ± standard error; ``interval COLUMN``: mean ± half the width of its 95% interval, by Student's t
- ``saved COLUMN | than ROWS``, ``costs``: in parts of the mean of other rows; ``welch``, ``mann-whitney``, ``permutation``: p

Docstrings have them in a comment of reStructuredText: ``.. numbers: ...`` up to an empty line.
"""

import functools
import re

import numpy as np
import pandas as pd
import pytest
from helpers.pages import DOCS, ROOT, name_of, pages
from scipy import stats

from sb3_combrel.comparison.statistics import TESTS, p_value_of_difference

FIGURES_IN = ("results.md", "benchmark.md", "results/learner.md", "results/transfer.md")
WITH_FIGURES = [ROOT / "README.md", *(DOCS / name for name in FIGURES_IN)]
#: Tables that need no mark, by their first heading.
UNMARKED = {
    "| | paper | explore | best |": "settings",
}
MARK = re.compile(r"<!-- (table|numbers): (.*?) ?-->\n+((?:<!-- .*?-->\n+)*)", re.DOTALL)
IN_DOCSTRING = re.compile(r"^ *\.\. (numbers): (.*?)\n\s*\n()", re.DOTALL | re.MULTILINE)


def marks():
    """Page, kind, content of each mark, and the table or paragraph that follows it."""
    found = []
    for page in [*pages(), *(ROOT / "sb3_combrel").rglob("*.py")]:
        text, position, pattern = page.read_text(), 0, MARK if page.suffix == ".md" else IN_DOCSTRING
        while match := pattern.search(text, position):
            position = match.end(2)
            below = text[match.end() :].partition("\n\n")[0].partition("\n<!-- end")[0]
            mark = match[2] if pattern is MARK else re.sub(r"\n +", "\n", match[2])
            found.append(pytest.param(page, match[1], mark, below, id=f"{name_of(page)}-{mark[:60]}"))
    return found


def cells_of(table):
    """Headings and rows of a Markdown table."""
    rows = [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in table.splitlines() if "|" in line]
    return rows[0], rows[2:]


@functools.cache
def read(file):
    """The CSV file with numbers as numbers, and as it is written."""
    data, as_written = pd.read_csv(file), pd.read_csv(file, dtype=str, keep_default_na=False)
    if "steps_of_episodes" in data:
        data["first_episode"] = data.steps_of_episodes.str.split().str[0].astype(float)
    return data.drop(columns=["settings", "steps_of_episodes"], errors="ignore"), as_written


@functools.cache
def rows_of(file, *queries):
    """The rows of a file that all queries select, if they are not empty."""
    rows = functools.reduce(lambda data, query: data.query(query) if query else data, queries, read(file)[0])
    assert len(rows), f"{file.name} has no rows {queries}"
    return rows


def figure_of(file, base, query, figure):
    """What a figure should read."""
    what, _, than = figure.partition("| than ")
    name, _, column = what.strip().partition(" ")
    name, _, form = name.partition(":")
    rows = rows_of(file, base, query)
    if name == "count":
        return str(len(rows))
    if name == "value":
        return read(file)[1].loc[rows.index, column].item()
    if than and rows_of(file, base, than).index.equals(rows.index):
        return ""
    values, others = (each.eval(column).to_numpy(dtype=float) for each in (rows, rows_of(file, base, than or query)))
    if name in ("saved", "costs"):
        more = values.mean() / others.mean() - 1
        return f"{more if name == 'costs' else 0.0 - more:{form or '.0%'}}"
    if name in TESTS:
        p = p_value_of_difference(others, values, name)
        return f"{p:.2f}" if p >= 0.1 else f"{p:.{2 if p >= 0.001 else 1}g}"
    form = form or ",.0f"
    if not np.isfinite(values).all():
        return f"median {np.median(values):{form}}, {np.isinf(values).sum()} never"
    if name in ("error", "interval"):
        half = stats.sem(values) * (1 if name == "error" else stats.t.ppf(0.975, len(values) - 1))
        return f"{values.mean():{form}} ± {half:{form}}"
    return f"{getattr(np, name)(values):{form}}"


def figures_of(page, mark, cells=None):
    """All figures of a mark; cells: by heading, of a row of the table that it stands before."""
    mark = re.sub(r"\{([\w -]+)\}", lambda found: cells[found[1]], re.sub(r"\n +", " ", mark))
    (file, base), first, *more = ([part.strip() for part in line.split("|", 1)] for line in mark.splitlines())
    return [
        figure_of(page.parent / file, base, rows, each.strip()) for rows, all_ in [first, *more] for each in all_.split(";")
    ]


@pytest.mark.parametrize(("page", "kind", "mark", "below"), marks())
def test_numbers_are_those_of_the_file(page, kind, mark, below):
    if kind == "table":
        file, number = mark.rsplit(", ", 1)
        stem = (page.parent / file).with_suffix("")
        names = (f"{stem.name}_{number}.csv", f"{stem.name}.csv", f"overview_{number}.csv")
        [written] = [read(stem.with_name(name))[1] for name in names if stem.with_name(name).exists()]
        assert cells_of(below) == (list(written), written.to_numpy().tolist())
    elif below.startswith("|") and "{" in mark:
        headings, rows = cells_of(below)
        for cells in rows:
            expected = figures_of(page, mark, dict(zip(headings, (cell.strip("`*") for cell in cells), strict=True)))
            assert cells[-len(expected) :] == expected
    else:
        text = re.sub(r"\s+", " ", below)
        for figure in figures_of(page, mark):
            assert re.search(rf"(?<![\d.,]){re.escape(figure)}(?![\d%]|[.,]\d)", text), (figure, text)


def test_the_tables_of_a_pair_are_those_of_its_file():
    text = (DOCS / "results/benchmark/benchmark.md").read_text()
    found = re.findall(r"^## ([\w-]+)$.*?((?:^\|[^\n]*\n)+)", text, flags=re.DOTALL | re.MULTILINE)
    assert len(found) == 8
    for pair, table in found:
        written = read(DOCS / f"results/benchmark/{pair}.csv")[1]
        assert cells_of(table) == (list(written), written.to_numpy().tolist()), pair


@pytest.mark.parametrize("page", WITH_FIGURES, ids=name_of)
def test_tables_with_figures_are_marked(page):
    for above, table in re.findall(r"([^\n]*)\n+((?:^\|.*\n)+)", page.read_text(), flags=re.MULTILINE):
        if re.search(r"\| [-+*]*\d[\d,.]*%?(?= )", table):
            assert (above.endswith("-->") and "end of" not in above) or table.startswith(tuple(UNMARKED)), table


def test_a_wrong_number_is_found(tmp_path):
    (tmp_path / "a.csv").write_text("who,n\nme,1\nme,3\nyou,8\n")
    page, mark = tmp_path / "page.md", 'a.csv |\nwho == "{who}" | count; error:.1f n; saved n | than who == "you"'
    assert figures_of(page, mark, {"who": "me"}) == ["2", "2.0 ± 1.0", "75%"]
    for below in ("There are 2.5 or 12 of them", "| they | 12 |\n| --- | --- |\n| I | 2.5 |"):
        with pytest.raises(AssertionError):
            test_numbers_are_those_of_the_file(page, "numbers", 'a.csv |\nwho == "me" | mean n', below)
