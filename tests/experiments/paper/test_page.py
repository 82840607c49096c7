"""Results are copied into the documentation, and tables filled in between their marks."""

import pytest

from sb3_combrel.experiments.pages import fill_in, tables_in
from sb3_combrel.experiments.paper.page import copy_results

TABLES = "**First**\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n\n**Second**\n\n| c |\n| --- |\n| 3 |\n"
FIRST, SECOND = "| a | b |\n| --- | ---: |\n| 1 | 2 |", "| c |\n| --- |\n| 3 |"


def test_tables_are_found_without_their_titles():
    assert tables_in(TABLES) == [FIRST, SECOND]
    assert tables_in("no table | here") == []


def test_tables_are_filled_in_and_what_is_around_stays(tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "t.md").write_text(TABLES)
    page = tmp_path / "page.md"
    marks = "<!-- table: results/t.md, {} -->\n{}<!-- end of table -->"
    page.write_text(f"before\n\n{marks.format(2, 'old')}\n\nbetween\n\n{marks.format(1, '')}\n\nafter\n")
    for _ in range(2):
        assert fill_in(page) == 2
        filled = marks.format(2, SECOND + "\n"), marks.format(1, FIRST + "\n")
        assert page.read_text() == f"before\n\n{filled[0]}\n\nbetween\n\n{filled[1]}\n\nafter\n"


def test_a_table_that_is_not_there_is_named(tmp_path):
    (tmp_path / "t.md").write_text(TABLES)
    page = tmp_path / "page.md"
    page.write_text("<!-- table: t.md, 3 -->\n<!-- end of table -->\n")
    with pytest.raises(ValueError, match=r"page.md: t.md has tables 1 to 2, and number 3 is asked for"):
        fill_in(page)
    assert page.read_text() == "<!-- table: t.md, 3 -->\n<!-- end of table -->\n"


def test_results_of_each_setting_are_copied_but_runs_are_not(tmp_path):
    output, docs = tmp_path / "reproduction", tmp_path / "docs"
    for setting in ("paper", "best"):
        for name in ("table6.md", "icub.csv", "fig2.png", "fig2.svg", "runs/a.json", "settings.json"):
            file = output / setting / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{setting} {name}")
    made = copy_results(output, docs)
    names = sorted(str(file.relative_to(docs)) for file in made)
    assert names == sorted(f"{s}/{n}" for s in ("paper", "best") for n in ("table6.md", "icub.csv", "fig2.png"))
    assert (docs / "best" / "icub.csv").read_text() == "best icub.csv"
    assert not (docs / "explore").exists()
