"""Takes results into the documentation: ``python -m sb3_combrel.experiments.paper.page`` (``make results``)."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.paper.domains import SETTINGS
from sb3_combrel.experiments.paper.reproduce import OUTPUT

#: What is copied of a setting's folder. Runs, sources and SVG figures stay where they are.
COPIED = ("*.md", "*.csv", "fig*.png", "diagnosis.png", "baselines.png")
DOCS = Path("docs/results")
PAGES = (Path("README.md"), Path("docs/results.md"))

# <!-- table: path, number --> ... <!-- end of table -->; the number is that of the table in the file, from 1 on.
_MARKED = re.compile(r"(<!-- table: (?P<path>[^,>]+), (?P<number>\d+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def copy_results(output: Path, docs: Path) -> list[Path]:
    """
    Copy tables and figures of all settings that have been reproduced.

    :param output: folder with a folder for each setting
    :param docs: folder to copy to, which gets a folder for each setting
    :return: the files
    """
    made = []
    for setting in SETTINGS:
        for pattern in COPIED:
            for file in sorted((output / setting).glob(pattern)):
                (docs / setting).mkdir(parents=True, exist_ok=True)
                made.append(Path(shutil.copyfile(file, docs / setting / file.name)))
    return made


def fill_in(page: Path) -> int:
    """
    Replace what stands between the marks of each table in a page by the table of the file that is named there.

    :param page: a Markdown file; paths in it are relative to its folder
    :return: how many tables were filled in
    :raises ValueError: if a file has no such table
    """

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


def main(pages: Sequence[Path] = PAGES) -> None:
    """Copy the results, and fill the tables of the pages in."""
    made = copy_results(Path(OUTPUT), DOCS)
    print(f"{len(made)} files copied to {DOCS}")
    for page in pages:
        print(f"{page}: {fill_in(page)} tables")


if __name__ == "__main__":
    main()
