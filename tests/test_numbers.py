"""Numbers in the documentation are those of the CSV file that a mark before the table or paragraph names.

``<!-- table: results/paper/table6.md, 1 -->``: a table that ``make results`` has filled in; cells are those of the CSV file.
``<!-- numbers: ... -->``: see ``sb3_combrel.experiments.numbers``.
"""

import re

import numpy as np
import pytest
from helpers.pages import DOCS, ROOT, name_of, pages
from scipy import stats

from sb3_combrel.experiments.numbers import cells_of, figures_of, fill_numbers, marks_in, missing_from, read, rows_with_figures

FIGURES_IN = ("results.md", "benchmark.md", "results/learner.md", "results/transfer.md")
WITH_FIGURES = [ROOT / "README.md", *(DOCS / name for name in FIGURES_IN)]
#: Tables that need no mark, by their first heading.
UNMARKED = {
    "| | paper | best |": "settings",
    "| parameter | Mountain Car | iCub |": "settings, see tests/experiments/paper/test_methods_and_jobs.py",
}


def marks():
    """Page and mark of each mark."""
    files = [*pages(), *(ROOT / "sb3_combrel").rglob("*.py")]
    return [pytest.param(page, mark, id=f"{name_of(page)}-{mark.content[:60]}") for page in files for mark in marks_in(page)]


@pytest.mark.parametrize(("page", "mark"), marks())
def test_numbers_are_those_of_the_file(page, mark):
    if mark.kind == "table":
        file, number = mark.content.rsplit(", ", 1)
        stem = (page.parent / file).with_suffix("")
        names = (f"{stem.name}_{number}.csv", f"{stem.name}.csv", f"overview_{number}.csv")
        [written] = [read(stem.with_name(name))[1] for name in names if stem.with_name(name).exists()]
        assert cells_of(mark.below) == (list(written), written.to_numpy().tolist())
    elif mark.is_of_rows:
        for cells, expected in zip(*rows_with_figures(page, mark), strict=True):
            assert cells[-len(expected) :] == expected
    else:
        assert missing_from(mark, page) == []


def test_the_tables_of_a_pair_are_those_of_its_file():
    text = (DOCS / "results/benchmark/benchmark.md").read_text()
    found = re.findall(r"^## ([\w-]+)$.*?((?:^\|[^\n]*\n)+)", text, flags=re.DOTALL | re.MULTILINE)
    assert len(found) == 9
    for pair, table in found:
        written = read(DOCS / f"results/benchmark/{pair}.csv")[1]
        assert cells_of(table) == (list(written), written.to_numpy().tolist()), pair


@pytest.mark.parametrize("page", WITH_FIGURES, ids=name_of)
def test_tables_with_figures_are_marked(page):
    for above, table in re.findall(r"([^\n]*)\n+((?:^\|.*\n)+)", page.read_text(), flags=re.MULTILINE):
        if re.search(r"\| [-+*]*\d[\d,.]*%?(?= )", table):
            assert (above.endswith("-->") and "end of" not in above) or table.startswith(tuple(UNMARKED)), table


TABLE = """who,n
me,1
me,3
you,8
you,9
they,5
they,8
"""
PAGE = """before

<!-- numbers: a.csv |
who == "{who}" | count; error:.1f n; {figure} | than who == "you"
-->
| x | who | count | n | more |
| --- | --- | --- | --- | --- |
| 1 | you | old | old | old |
| 2 | `me` | 7 | 7 | 7 |
| 3 | they | | | |

<!-- numbers: a.csv |
who == "me" | mean n; max n
-->
Two and {paragraph} are mean and largest: 2 of them.
"""


def page_with(folder, figure, paragraph="3"):
    (folder / "a.csv").write_text(TABLE)
    page = folder / "page.md"
    page.write_text(PAGE.replace("{figure}", figure).replace("{paragraph}", paragraph))
    return page


def filled(page):
    """The last cell of each row of the table, once all figures are filled in."""
    assert fill_numbers(page) == []
    [table, _] = marks_in(page)
    headings, rows = cells_of(table.below)
    assert (headings, [cells[:2] for cells in rows]) == (
        ["x", "who", "count", "n", "more"],
        [["1", "you"], ["2", "`me`"], ["3", "they"]],
    )
    assert [cells[2:4] for cells in rows] == [["2", "8.5 ± 0.5"], ["2", "2.0 ± 1.0"], ["2", "6.5 ± 1.5"]]
    before, again = page.read_text(), fill_numbers(page)
    assert (page.read_text(), again) == (before, [])
    return [cells[4] for cells in rows]


def test_tables_are_filled_with_what_their_marks_say(tmp_path):
    assert filled(page_with(tmp_path, "saved n")) == ["", "76%", "24%"]
    assert filled(page_with(tmp_path, "costs:.1% n")) == ["", "-76.5%", "-23.5%"]


def test_a_saving_may_have_its_interval(tmp_path):
    # Of two runs each the extremes of a bootstrap are all draws of one run: 1 - 3/8 and 1 - 1/9, and so on.
    assert filled(page_with(tmp_path, "saved:interval n")) == ["", "76% (62% to 89%)", "24% (0% to 44%)"]


def test_p_values_are_corrected_over_the_rows_of_a_table(tmp_path):
    p = [stats.ttest_ind([8, 9], others, equal_var=False).pvalue for others in ([1, 3], [5, 8])]
    assert filled(page_with(tmp_path, "welch n")) == ["", f"{p[0]:.2g}", f"{p[1]:.2f}"]
    assert filled(page_with(tmp_path, "welch:holm n")) == ["", f"{2 * p[0]:.2f}", f"{p[1]:.2f}"]


def test_a_wrong_number_is_found(tmp_path):
    page = page_with(tmp_path, "saved n", paragraph="4")
    table, paragraph = marks_in(page)
    assert missing_from(paragraph, page) == ["3"]
    with pytest.raises(AssertionError):
        test_numbers_are_those_of_the_file(page, paragraph)
    with pytest.raises(AssertionError):
        test_numbers_are_those_of_the_file(page, table)
    assert fill_numbers(page) == ["3"], "what is to be written by hand"
    test_numbers_are_those_of_the_file(page, marks_in(page)[0])
    with pytest.raises(ValueError, match="must have rows"):
        figures_of(page, "a.csv |\nwho == 'nobody' | count")


def test_what_is_never_reached_has_a_median(tmp_path):
    (tmp_path / "a.csv").write_text("n\n1\n5\ninf\n")
    assert figures_of(tmp_path / "page.md", "a.csv |\n| mean n; interval n") == [["median 5, 1 never"] * 2]
    (tmp_path / "b.csv").write_text("n\n1\n5\n")
    half = stats.sem([1, 5]) * stats.t.ppf(0.975, 1)
    assert figures_of(tmp_path / "page.md", "b.csv |\n| interval n; median:.1f n / 2") == [
        [f"3 ± {np.round(half):.0f}", "1.5"]
    ]
