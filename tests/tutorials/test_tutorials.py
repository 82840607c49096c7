"""Tutorials: cells are executed, outputs go into the files, all cells of the five run, and what is recorded is complete."""

import os
import re
import shutil
import sys
from pathlib import Path

import jupytext
import pytest
from nbclient.exceptions import CellExecutionError

from sb3_combrel.experiments.tutorials import execute, figures_of, recorded_outputs, tutorial_files, tutorials, with_outputs

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"
FILES = tutorial_files(FOLDER)
TEXT = """# Title

```python
x = 1
```

```python
import sys
print(x + 1)
print("unseen", file=sys.stderr)
```

<!-- output -->
```text
something old
```
<!-- end of output -->

```bash
python -c 'import sys; print(sys.prefix)'; pwd
```

![a figure](figures/a.png) and ![another](figures/b.png), ![again](figures/a.png)
"""


def named(file):
    return file.stem


def test_outputs_replace_older_ones_and_outputs_and_figures_are_read_again():
    assert figures_of(TEXT) == ["figures/a.png", "figures/b.png"]
    text = with_outputs(TEXT, ["", "2", "3\n\n`4`"])
    assert recorded_outputs(text) == [None, "2", "3\n\n`4`"] and "something old" not in text
    assert with_outputs(text, ["", "something old", ""]) == TEXT
    with pytest.raises(ValueError, match="each of the 3 cells, got 2"):
        with_outputs(TEXT, ["", ""])


def test_the_command_executes_the_cells_in_their_folder_and_environment_and_writes_outputs(tmp_path):
    file = tmp_path / "1_small.md"
    file.write_text(TEXT)
    tutorials((file,))
    assert recorded_outputs(file.read_text()) == [None, "2", f"{sys.prefix}\n{os.path.realpath(tmp_path)}"]


def test_a_cell_that_fails_is_an_error_and_leaves_the_file(tmp_path):
    file, text = tmp_path / "1_small.md", "```python\nprint(1)\n```\n\n```python\n1 / 0\n```\n"
    file.write_text(text)
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        execute(file)
    assert file.read_text() == text


def test_cells_that_only_jupytext_finds_are_refused(tmp_path):
    file = tmp_path / "1_small.md"
    file.write_text('```python tags=["other"]\nprint(1)\n```\n')
    with pytest.raises(ValueError, match="cells in fences of python or bash"):
        execute(file)


@pytest.mark.long
@pytest.mark.parametrize("file", FILES, ids=named)
def test_all_cells_run(file, tmp_path):
    copy = shutil.copytree(FOLDER, tmp_path / "tutorials", ignore=shutil.ignore_patterns("output", "figures"))
    (copy / "figures").mkdir()
    for beside in ("docs", "zoo_configs"):
        (tmp_path / beside).symlink_to(ROOT / beside)
    text, outputs = file.read_text(), execute(copy / file.name)
    missing = [figure for figure in figures_of(text) if not (copy / figure).exists()]
    assert not missing, "figures that the tutorial shows and no cell has saved"
    prints = [output != "" for output in outputs]
    assert prints == [recorded is not None for recorded in recorded_outputs(text)], "make tutorials renews what is recorded"


@pytest.mark.parametrize("file", FILES, ids=named)
def test_a_tutorial_is_a_notebook_whose_outputs_say_nothing_of_the_machine(file):
    text = file.read_text()
    assert jupytext.read(file).metadata["kernelspec"]["name"] == "python3"
    assert text.startswith("<!--\n"), "a code host would show the header"
    for output in recorded_outputs(text):
        assert not re.search(r"/(home|root|tmp|work|usr)/|site-packages|\x1b|Traceback", output or "")


def test_there_are_five_in_the_index_and_their_figures_are_small():
    assert len(FILES) == 5 and all(f"]({file.name})" in (FOLDER / "README.md").read_text() for file in FILES)
    figures = {f"figures/{path.name}": path.stat().st_size for path in (FOLDER / "figures").iterdir()}
    assert {figure for file in FILES for figure in figures_of(file.read_text())} == set(figures)
    assert max(figures.values()) < 300_000 and sum(figures.values()) < 1_200_000
