"""The files of docs/add_to_the_benchmark.md, and calls of ``sb3-combrel benchmark``."""

import contextlib
import io
import re
from pathlib import Path

from sb3_combrel import cli

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


def call(*args):
    """Exit status, standard output, and standard error of a call in this process."""
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            status = cli.main(["benchmark", *map(str, args)])
        except SystemExit as error:
            status = error.code
    return status, output.getvalue(), errors.getvalue()


def succeed(*args):
    status, output, errors = call(*args)
    assert status == 0, errors
    return output


def fail(*args):
    """The one line that a call which fails writes."""
    status, output, errors = call(*args)
    assert status == 1, (output, errors)
    assert errors.startswith("sb3-combrel: ") and errors.count("\n") == 1
    assert "Traceback" not in output + errors
    return errors
