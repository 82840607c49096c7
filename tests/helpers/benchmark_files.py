"""The files of docs/add_to_the_benchmark.md, and calls of ``sb3-combrel benchmark``."""

import re
from functools import partial
from pathlib import Path

from helpers import command_line

PAGE = Path(__file__).resolve().parents[2] / "docs" / "add_to_the_benchmark.md"


def write_files(folder):
    """Write the files of the page into a folder; their names."""
    found = re.findall(r"```python file=(\S+)\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for name, text in found:
        (folder / name).write_text(text)
    return [name for name, _ in found]


def command():
    """The arguments of the command that the page has."""
    (line,) = re.findall(r"```bash\nsb3-combrel benchmark (.*)\n```", PAGE.read_text())
    return line.split()


call, succeed, fail = (partial(each, "benchmark") for each in (command_line.call, command_line.succeed, command_line.fail))
