"""A page to look at: one HTML file that needs nothing else, with pictures as data in it and without scripts."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2

from sb3_combrel.common.files import write_whole
from sb3_combrel.common.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Widths of a picture in inches, for screens and for telephones: text has about its own size on both.
WIDE, NARROW = 10.0, 4.2


@dataclass(frozen=True)
class Picture:
    """A picture in two widths, as addresses that hold the data themselves."""

    wide: str
    narrow: str
    words: str  #: what it shows, for who cannot see it


@dataclass(frozen=True)
class Cell:
    """An entry of a table."""

    text: str
    colour: str = ""  #: of the mark before it; "" for none


@dataclass(frozen=True)
class PageTable:
    """A table of a page; the first ``n_names`` columns hold words, the others numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    n_names: int = 1


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    title: str
    text: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    table: PageTable | None = None


@dataclass(frozen=True)
class Page:
    """A page: its title, the sentence that it is about, facts, warnings, and sections. Any text is escaped."""

    title: str
    sentences: Sequence[str]
    facts: Sequence[str]
    sections: Sequence[Section]
    warnings: Sequence[str] = ()

    def html(self) -> str:
        """Return the page."""
        environment = jinja2.Environment(
            autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
        )
        template = environment.from_string((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))
        return template.render(page=self, version=__version__) + "\n"

    def write(self, path: Path) -> None:
        """Write the page.

        :raises OSError: if the file cannot be written
        """
        write_whole(path, self.html().encode("utf-8"))


def picture(draw: Callable[[float], Figure], words: str) -> Picture:
    """Draw a picture in both widths; ``draw`` makes a figure of a width in inches."""
    return Picture(data_address(draw(WIDE)), data_address(draw(NARROW)), words)


def data_address(figure: Figure) -> str:
    """Return a figure as an SVG in a data address: the same figure gives the same text, without dates and random names."""
    from matplotlib import rc_context

    file = io.BytesIO()
    with rc_context({"svg.hashsalt": "sb3_combrel"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue().decode()
    # Clip paths are named after where they lie in memory.
    for number, name in enumerate(dict.fromkeys(re.findall(r'<clipPath id="(\w+)"', text))):
        text = text.replace(name, f"clip{number}")
    return f"data:image/svg+xml;base64,{base64.b64encode(text.encode()).decode()}"
