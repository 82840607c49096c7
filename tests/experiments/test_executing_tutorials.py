"""Executing a tutorial, and putting what its cells print into it."""

import os
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nbclient.exceptions import CellExecutionError

from sb3_combrel.experiments.tutorials import execute, figures_of, main, recorded_outputs, tutorial_files, with_outputs

TEXT = """# Title

```python
x = 1
```

Text.

```python
print(x + 1)
```

<!-- output -->
```text
something old
```
<!-- end of output -->

```bash
echo $((1 + 2))
```

```yaml
not: a cell
```

![a figure](figures/a.png) and ![another](figures/b.png), ![again](figures/a.png)
"""

printed = st.lists(st.text(alphabet="ab 1`.\n", max_size=20).map(lambda text: text.strip("\n")), min_size=3, max_size=3)


@given(printed)
def test_outputs_that_are_put_in_are_those_that_are_read(outputs):
    text = with_outputs(TEXT, outputs)
    assert recorded_outputs(text) == [output or None for output in outputs]
    assert with_outputs(text, ["", "something old", ""]) == TEXT


def test_outputs_replace_older_ones():
    text = with_outputs(TEXT, ["", "2", "3"])
    assert "something old" not in text
    assert "print(x + 1)\n```\n\n<!-- output -->\n```text\n2\n```\n<!-- end of output -->\n\n```bash" in text


def test_there_must_be_an_output_for_each_cell():
    with pytest.raises(ValueError, match="each of the 3 cells, got 2"):
        with_outputs(TEXT, ["", ""])


def test_figures_are_those_that_are_shown():
    assert figures_of(TEXT) == ["figures/a.png", "figures/b.png"]


def test_files_come_in_their_order_and_the_index_is_none(tmp_path):
    for name in ("2_two.md", "README.md", "1_one.md"):
        (tmp_path / name).touch()
    assert [file.name for file in tutorial_files(tmp_path)] == ["1_one.md", "2_two.md"]


@pytest.mark.integration
class TestExecuting:
    def test_cells_are_executed_in_their_folder_one_after_the_other(self, tmp_path):
        file = tmp_path / "1_small.md"
        file.write_text(TEXT + "\n```python\nimport os, sys\nprint('unseen', file=sys.stderr)\nos.getcwd()\n```\n")
        assert execute(file) == ["", "2", "3", repr(os.path.realpath(tmp_path))]

    def test_commands_are_those_of_this_environment(self, tmp_path):
        file = tmp_path / "1_small.md"
        file.write_text(TEXT.replace("echo $((1 + 2))", "python -c 'import sb3_combrel, sys; print(sys.prefix)'"))
        assert execute(file) == ["", "2", sys.prefix]

    def test_the_command_writes_outputs_into_the_files(self, tmp_path, monkeypatch, capsys):
        file = tmp_path / "1_small.md"
        file.write_text(TEXT)
        monkeypatch.setattr("sys.argv", ["tutorials", str(file)])
        main()
        assert recorded_outputs(file.read_text()) == [None, "2", "3"]
        assert "1_small.md: " in capsys.readouterr().out

    def test_a_cell_that_fails_is_an_error_and_leaves_the_file(self, tmp_path):
        file = tmp_path / "1_small.md"
        text = "```python\nprint(1)\n```\n\n```python\n1 / 0\n```\n"
        file.write_text(text)
        with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
            execute(file)
        assert file.read_text() == text

    def test_cells_that_only_jupytext_finds_are_refused(self, tmp_path):
        file = tmp_path / "1_small.md"
        file.write_text('```python tags=["other"]\nprint(1)\n```\n')
        with pytest.raises(ValueError, match="cells in fences of python or bash"):
            execute(file)
