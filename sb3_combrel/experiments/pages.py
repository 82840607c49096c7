"""Pages of the documentation with tables of results in them, between marks."""

from __future__ import annotations

import re
from pathlib import Path

from sb3_combrel.common.files import write_whole

# <!-- table: path, number --> ... <!-- end of table -->; the number is that of the table in the file, from 1 on.
_MARKED = re.compile(r"(<!-- table: (?P<path>[^,>]+), (?P<number>\d+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
# <!-- results: path --> ... <!-- end of results -->
_INCLUDED = re.compile(r"(<!-- results: (?P<path>[^>]+?) -->\n).*?(<!-- end of results -->)", re.DOTALL)
# ![text](path) of a picture that is not elsewhere on the web.
_PICTURE = re.compile(r"(!\[[^\]]*\]\()(?![a-z]+://)([^)]+\))")


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


def include(page: Path) -> int:
    """
    Replace what stands between the marks of results in a page by the Markdown file that is named there.

    :param page: a Markdown file; paths in it are relative to its folder, and those of pictures in the file to that file's
    :return: how many files were included
    """

    def content_of(match: re.Match[str]) -> str:
        file = Path(match["path"])
        text = (page.parent / file).read_text().strip("\n")
        moved = _PICTURE.sub(lambda picture: f"{picture[1]}{file.parent.as_posix()}/{picture[2]}", text)
        return f"{match[1]}{moved}\n{match[3]}"

    text, n = _INCLUDED.subn(content_of, page.read_text())
    write_whole(page, text.encode())
    return n
