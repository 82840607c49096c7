"""Takes results into the documentation: ``python -m sb3_combrel.experiments.pages`` (``make results``)."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pandas as pd

from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.numbers import fill_numbers
from sb3_combrel.experiments.paper.domains import SETTINGS

#: What is copied of the folders that ``reproduce``, ``benchmark`` and ``make learner`` write. Single runs, sources and SVG
#: figures stay where they are, and the benchmark's other Markdown files: its page has their tables.
COPIED = {Path("reproduction") / setting: ("*.md", "*.csv", "*.png") for setting in SETTINGS}
COPIED[Path("benchmark")] = ("benchmark.md", "*.csv", "*.png")
COPIED[Path("learner")] = ("*.md", "tables_*.csv", "runs.csv")
#: The folders below it are those of ``make transfer``, whose runs are one file.
JOINED = Path("transfer")
DOCS = Path("docs/results")
#: Pages that may have marks.
PAGES = ("README.md", "docs/*.md", "docs/results/*.md", "tutorials/*.md")

# <!-- table: path, number --> ... <!-- end of table -->; the number is that of the table in the file, from 1 on.
_MARKED = re.compile(r"(<!-- table: (?P<path>[^,>]+), (?P<number>\d+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def main(folder: Path = Path()) -> None:
    """Copy what results there are, and fill the pages in.

    :param folder: the repository, with the results in it
    """
    for output, patterns in COPIED.items():
        made = copy(folder / output, folder / DOCS / output.name, patterns)
        print(f"{output}: {len(made)} files copied to {DOCS / output.name}")
    print(f"{JOINED}: runs of {join(folder / JOINED, folder / DOCS / 'transfer.csv')} folders joined")
    for page in sorted(page for pattern in PAGES for page in folder.glob(pattern)):
        n, missing = fill_in(page), fill_numbers(page)
        if n or missing:
            to_write = f"; to be written by hand: {', '.join(missing)}" if missing else ""
            print(f"{page.relative_to(folder)}: {n} tables of files filled in{to_write}")


def copy(output: Path, docs: Path, patterns: tuple[str, ...]) -> list[Path]:
    """Copy the files of a folder that match patterns, none if it does not exist; return the copies."""
    made = []
    for file in sorted(file for pattern in patterns for file in output.glob(pattern)):
        docs.mkdir(parents=True, exist_ok=True)
        made.append(Path(shutil.copyfile(file, docs / file.name)))
    return made


def join(output: Path, file: Path) -> int:
    """Write the runs of all folders below one to a file, in place of all that it has of their tasks; return how many folders.

    :param output: with a ``runs.csv`` in each of its folders
    """
    made = [pd.read_csv(runs, dtype=str, keep_default_na=False) for runs in sorted(output.glob("*/runs.csv"))]
    if made:
        new = pd.concat(made)
        before = pd.read_csv(file, dtype=str, keep_default_na=False) if file.exists() else new.iloc[:0]
        joined = pd.concat([before[~before["task"].isin(new["task"])], new]).fillna("")
        write_whole(file, joined.to_csv(index=False, lineterminator="\n").encode())
    return len(made)


def fill_in(page: Path) -> int:
    """Replace what stands between marks in a page by the tables of files, paths relative to it; return how many."""

    def table_of(match: re.Match[str]) -> str:
        tables = tables_in((page.parent / match["path"]).read_text())
        number = int(match["number"])
        if not 1 <= number <= len(tables):
            raise ValueError(f"{page}: {match['path']} has tables 1 to {len(tables)}, and number {number} is asked for")
        return f"{match[1]}{tables[number - 1]}\n{match[4]}"

    text, n = _MARKED.subn(table_of, page.read_text())
    write_whole(page, text.encode())
    return n


def tables_in(text: str) -> list[str]:
    """Return the tables of a Markdown text, without their titles."""
    return [match.group(0).rstrip("\n") for match in re.finditer(r"(?:^\|.*\n?)+", text, re.MULTILINE)]


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
