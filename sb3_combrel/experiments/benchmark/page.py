"""Takes results into the documentation: ``python -m sb3_combrel.experiments.benchmark.page`` (part of ``make results``)."""

from __future__ import annotations

import shutil
from pathlib import Path

from sb3_combrel.experiments.benchmark.command import OUTPUT
from sb3_combrel.experiments.benchmark.report import PAGE
from sb3_combrel.experiments.pages import fill_in

#: What is copied. Runs, sources and SVG figures stay where they are, and tables as Markdown, of which the report has all.
COPIED = (f"{PAGE}.md", "*.csv", "*.png")
DOCS = Path("docs/results/benchmark")
DOCS_PAGE = Path("docs/benchmark.md")


def copy_results(output: Path, docs: Path) -> list[Path]:
    """
    Copy page, tables and pictures.

    :param output: folder of the command
    :param docs: folder to copy to
    :return: the files
    """
    made = []
    for pattern in COPIED:
        for file in sorted(output.glob(pattern)):
            docs.mkdir(parents=True, exist_ok=True)
            made.append(Path(shutil.copyfile(file, docs / file.name)))
    return made


def main(output: Path = OUTPUT, docs: Path = DOCS, page: Path = DOCS_PAGE) -> None:
    """
    Copy the results, if there are any, and fill the page's tables in.

    :param output: folder of the command
    :param docs: folder to copy to
    :param page: a Markdown file with the marks of :func:`~sb3_combrel.experiments.pages.fill_in`
    """
    if not (output / f"{PAGE}.md").exists():
        print(f"{output} has no results of sb3-combrel benchmark")
        return
    made = copy_results(output, docs)
    print(f"{len(made)} files copied to {docs}; {page}: {fill_in(page)} tables")


if __name__ == "__main__":
    main()
