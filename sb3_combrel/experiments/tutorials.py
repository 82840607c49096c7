"""Execute the tutorials, and write what their cells print and draw into them.

A tutorial is a notebook in jupytext's Markdown format: fences of ``python`` and ``bash`` are its cells. What a cell printed
stands below it between two comments, so that it can be read without running anything; cells save their figures themselves.
Run as ``python -m sb3_combrel.experiments.tutorials``.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_combrel.common.files import write_whole

FOLDER = Path("tutorials")
#: What a cell may take, in seconds, on a machine that is busy with other things.
TIMEOUT = 600

BEGIN, END = "<!-- output -->", "<!-- end of output -->"
_CELL = re.compile(
    rf"^```(?P<language>python|bash)\n(?P<code>.*?)^```\n(?:\n{BEGIN}\n```text\n(?P<output>.*?)\n```\n{END}\n)?",
    re.DOTALL | re.MULTILINE,
)
_FIGURE = re.compile(r"!\[[^\]]*\]\((figures/[^)]+)\)")
_COLOURS = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


def tutorial_files(folder: Path = FOLDER) -> list[Path]:
    """Return the tutorials of a folder, the files whose names begin with a number, in their order."""
    return sorted(folder.glob("[0-9]*.md"))


def figures_of(text: str) -> list[str]:
    """Return the figures that a tutorial shows, as paths relative to its folder."""
    return list(dict.fromkeys(_FIGURE.findall(text)))


def recorded_outputs(text: str) -> list[str | None]:
    """Return what is recorded in a tutorial of each cell's output, None where there is nothing."""
    return [cell["output"] for cell in _CELL.finditer(text)]


def execute(file: Path) -> list[str]:
    """Execute all cells of a tutorial in its folder and a Python of its own; return what each printed on standard output."""
    import jupytext
    from nbclient import NotebookClient

    text = file.read_text()
    notebook = jupytext.reads(text, fmt="md")
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    expected = [("%%bash\n" if cell["language"] == "bash" else "") + cell["code"].strip() for cell in _CELL.finditer(text)]
    if [cell.source.strip() for cell in cells] != expected:
        raise ValueError(f"{file} must have its cells in fences of python or bash that begin and end at the start of a line")
    # Commands in cells are those of this Python's environment.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    folder = {"metadata": {"path": str(file.parent)}}
    with tempfile.TemporaryDirectory() as private:
        client = NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", resources=folder)
        manager = client.create_kernel_manager()
        if os.name == "posix":
            # Files of its own in place of ports, for which kernels that start at the same time could compete.
            manager.transport, manager.connection_file = "ipc", str(Path(private) / "kernel.json")
        client.execute(env={**os.environ, "PATH": path})
    return [_printed(cell.outputs) for cell in cells]


def _printed(outputs: Sequence[Any]) -> str:
    """Return the text of a cell's outputs; figures are saved by the cells."""
    parts = []
    for output in outputs:
        if output.output_type == "stream" and output.name == "stdout":
            parts.append(output.text)
        elif output.output_type in ("execute_result", "display_data") and set(output.data) == {"text/plain"}:
            parts.append(output.data["text/plain"] + "\n")
    lines = _COLOURS.sub("", "".join(parts)).splitlines()
    return "\n".join(line.rstrip() for line in lines).strip("\n")


def with_outputs(text: str, outputs: Sequence[str]) -> str:
    """Put the outputs of its cells, "" for nothing, into a tutorial, in the place of those that are recorded there."""
    n_cells = len(_CELL.findall(text))
    if len(outputs) != n_cells:
        raise ValueError(f"outputs must have one entry for each of the {n_cells} cells, got {len(outputs)}")
    following = iter(outputs)

    def renewed(cell: re.Match[str]) -> str:
        output = next(following)
        code = f"```{cell['language']}\n{cell['code']}```\n"
        return code if not output else f"{code}\n{BEGIN}\n```text\n{output}\n```\n{END}\n"

    return _CELL.sub(renewed, text)


def tutorials(files: tuple[Path, ...] = (), /) -> None:
    """Execute tutorials and renew the outputs and figures in them.

    :param files: tutorials; all of tutorials/ by default
    """
    for file in files or tutorial_files():
        began = time.perf_counter()
        outputs = execute(file)
        write_whole(file, with_outputs(file.read_text(), outputs).encode())
        print(f"{file}: {time.perf_counter() - began:.0f} seconds", flush=True)


if __name__ == "__main__":
    import tyro

    tyro.cli(tutorials)
