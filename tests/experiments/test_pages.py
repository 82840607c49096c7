"""Results are copied into the documentation, and tables filled in between their marks."""

import pytest

from sb3_combrel.experiments import pages
from sb3_combrel.experiments.pages import fill_in

TABLES = "**First**\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n\n**Second**\n\n| c |\n| --- |\n| 3 |\n"
FIRST, SECOND = "| a | b |\n| --- | ---: |\n| 1 | 2 |", "| c |\n| --- |\n| 3 |"
MARKS = "<!-- table: results/t.md, {} -->\n{}<!-- end of table -->"


def test_tables_are_filled_in_and_what_is_around_stays(tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "t.md").write_text(TABLES)
    page = tmp_path / "page.md"
    page.write_text(f"before\n\n{MARKS.format(2, 'old')}\n\nbetween\n\n{MARKS.format(1, '')}\n\nafter\n")
    for _ in range(2):
        assert fill_in(page) == 2
        filled = MARKS.format(2, SECOND + "\n"), MARKS.format(1, FIRST + "\n")
        assert page.read_text() == "before\n\n{}\n\nbetween\n\n{}\n\nafter\n".format(*filled)


def test_a_table_that_is_not_there_is_named(tmp_path):
    (tmp_path / "t.md").write_text(TABLES)
    page, text = tmp_path / "page.md", "<!-- table: t.md, 3 -->\n<!-- end of table -->\n"
    page.write_text(text)
    with pytest.raises(ValueError, match=r"page.md: t.md has tables 1 to 2, and number 3 is asked for"):
        fill_in(page)
    assert page.read_text() == text


def test_results_are_copied_but_runs_are_not(tmp_path):
    names = ("table6.md", "icub.csv", "fig2.png", "fig2.svg", "benchmark.md", "runs/a.json", "sources/a.npz")
    for folder in ("reproduction/paper", "reproduction/best", "benchmark", "learner"):
        for name in (*names, "runs.csv", "tables_1.csv", "episodes.csv"):
            file = tmp_path / folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{folder} {name}")
    page = tmp_path / "docs" / "results.md"
    page.parent.mkdir()
    page.write_text("<!-- table: results/best/table.md, 1 -->\n<!-- end of table -->\n")
    (tmp_path / "reproduction" / "best" / "table.md").write_text("| a |\n| --- |\n| 1 |\n")
    pages.main(tmp_path)
    assert "| a |\n| --- |\n| 1 |\n" in page.read_text()
    docs = tmp_path / pages.DOCS
    made = {str(file.relative_to(docs)) for file in docs.rglob("*") if file.is_file()}
    of_setting, tables = ("table6.md", "benchmark.md", "icub.csv", "fig2.png"), ("runs.csv", "tables_1.csv", "episodes.csv")
    expected = {f"{setting}/{name}" for setting in ("paper", "best") for name in of_setting}
    # The tables of a page of the benchmark are in it.
    expected |= {f"{setting}/{name}" for setting in ("paper", "best") for name in tables}
    expected |= {f"benchmark/{name}" for name in (*of_setting[1:], *tables)}
    # Of single episodes nothing is shown.
    expected |= {f"learner/{name}" for name in ("table6.md", "benchmark.md", "runs.csv", "tables_1.csv")}
    assert made == expected | {"best/table.md"}
    assert (docs / "best" / "icub.csv").read_text() == "reproduction/best icub.csv"


def test_runs_of_transfer_are_joined_and_those_of_tasks_that_were_not_run_stay(tmp_path):
    file, output = tmp_path / "transfer.csv", tmp_path / "transfer"
    assert pages.join(output, file) == 0 and not file.exists()
    file.write_text("run,task,steps,settings\na,Arm,10,{}\nb,Car,20,{}\n")
    for folder, text in (("4d", "run,task,steps\nc,Car,1.50\n"), ("6d", "run,task,steps,first\nd,Big,7,3\n")):
        (output / folder).mkdir(parents=True)
        (output / folder / "runs.csv").write_text(text)
    for _ in range(2):
        assert pages.join(output, file) == 2
        assert file.read_text() == "run,task,steps,settings,first\na,Arm,10,{},\nc,Car,1.50,,\nd,Big,7,,3\n"
