"""Takes results into the documentation: ``python -m sb3_combrel.experiments.paper.page`` (``make results``)."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from sb3_combrel.experiments.pages import fill_in
from sb3_combrel.experiments.paper.domains import SETTINGS
from sb3_combrel.experiments.paper.reproduce import OUTPUT

#: What is copied of a setting's folder. Runs, sources and SVG figures stay where they are.
COPIED = ("*.md", "*.csv", "fig*.png", "diagnosis.png", "baselines.png")
DOCS = Path("docs/results")
PAGES = (Path("docs/results.md"),)


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


def main(pages: Sequence[Path] = PAGES) -> None:
    """Copy the results, and fill the tables of the pages in."""
    made = copy_results(Path(OUTPUT), DOCS)
    print(f"{len(made)} files copied to {DOCS}")
    for page in pages:
        print(f"{page}: {fill_in(page)} tables")


if __name__ == "__main__":
    main()
