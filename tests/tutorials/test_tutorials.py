"""The tutorials run from the first cell to the last, and what is recorded in them is complete."""

import re
import shutil
from pathlib import Path

import jupytext
import pytest

from sb3_combrel.experiments.tutorials import execute, figures_of, recorded_outputs, tutorial_files

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"
FILES = tutorial_files(FOLDER)
PAGES = [FOLDER / "README.md", *FILES]


def named(file):
    return file.stem


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.parametrize("file", FILES, ids=named)
def test_all_cells_run(file, tmp_path):
    copy = shutil.copytree(FOLDER, tmp_path / "tutorials", ignore=shutil.ignore_patterns("output", "figures"))
    (copy / "figures").mkdir()
    for beside in ("docs", "zoo_configs"):
        (tmp_path / beside).symlink_to(ROOT / beside)
    text = file.read_text()
    outputs = execute(copy / file.name)
    missing = [figure for figure in figures_of(text) if not (copy / figure).exists()]
    assert not missing, "figures that the tutorial shows and no cell has saved"
    prints = [output != "" for output in outputs]
    assert prints == [recorded is not None for recorded in recorded_outputs(text)], "make tutorials renews what is recorded"


@pytest.mark.parametrize("file", FILES, ids=named)
def test_jupyter_need_not_ask_for_a_kernel(file):
    assert jupytext.read(file).metadata["kernelspec"]["name"] == "python3"
    assert file.read_text().startswith("<!--\n"), "a code host would show the header"


def test_there_are_five_and_the_index_has_them():
    assert len(FILES) == 5
    index = (FOLDER / "README.md").read_text()
    for file in FILES:
        assert f"]({file.name})" in index


def test_every_figure_is_shown_and_all_are_small():
    shown = {figure for file in FILES for figure in figures_of(file.read_text())}
    present = {f"figures/{path.name}" for path in (FOLDER / "figures").iterdir()}
    assert shown == present
    sizes = [(FOLDER / figure).stat().st_size for figure in present]
    assert max(sizes) < 300_000 and sum(sizes) < 1_200_000


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text()):
        assert (FOLDER / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_make_targets_exist(page):
    rules = "\n".join(re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)).split()
    assert set(re.findall(r"`make ([a-z-]+)", page.read_text())) <= set(rules)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_lines_are_as_short_as_elsewhere(page):
    """Apart from the rows of tables and what cells have printed."""
    text = re.sub(r"<!-- output -->.*?<!-- end of output -->", "", page.read_text(), flags=re.DOTALL)
    assert [line for line in text.splitlines() if len(line) > 127 and not line.startswith("|")] == []


@pytest.mark.parametrize("file", FILES, ids=named)
def test_outputs_say_nothing_of_the_machine(file):
    for output in recorded_outputs(file.read_text()):
        assert not re.search(r"/(home|root|tmp|work|usr)/|site-packages|\x1b|Traceback", output or "")
