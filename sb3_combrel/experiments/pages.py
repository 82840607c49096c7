"""Pages of the documentation with tables of results in them, between marks."""

from __future__ import annotations

import re
from pathlib import Path

from sb3_combrel.common.files import write_whole

# <!-- table: path, number --> ... <!-- end of table -->; the number is that of the table in the file, from 1 on.
_MARKED = re.compile(r"(<!-- table: (?P<path>[^,>]+), (?P<number>\d+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


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
