"""Figures, drawn without a display and without pyplot, so that the caller's is left alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from sb3_combrel.pages.palette import METHOD_COLOURS

COLOURS = METHOD_COLOURS
MARKERS = ("s", "^", "o", "D", "v")


def figure_of(width: float, height: float) -> Figure:
    """Make a figure; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels_of(n: int, title: str, sharey: bool = True) -> tuple[Figure, list[Any]]:
    """Make a figure with ``n`` panels side by side; the figure and their axes."""
    figure = figure_of(6.2 * n, 4.4)
    figure.suptitle(title)
    return figure, list(figure.subplots(1, n, sharey=sharey, squeeze=False)[0])


def draw_band(
    axes: Any,
    where: np.ndarray,
    band: tuple[np.ndarray, np.ndarray, np.ndarray],
    colour: str,
    line: str = "-",
    label: str | None = None,
    **style: Any,
) -> None:
    """Draw a curve with its band: ``band`` holds the curve and both ends, each of the shape of ``where``, (n_points,)."""
    axes.plot(where, band[0], line, color=colour, label=label, **style)
    axes.fill_between(where, band[1], band[2], color=colour, alpha=0.17, linewidth=0)


def readable_ticks(axis: Any) -> None:
    """Write numbers such as 200 on a logarithmic axis, not powers of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:,.0f}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path) -> list[Path]:
    """Save as PNG and SVG, without the date and random names, which would make every file differ; ``path`` has no suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    png, svg = (path.with_name(f"{path.name}.{kind}") for kind in ("png", "svg"))
    figure.savefig(png, dpi=110)
    with rc_context({"svg.hashsalt": f"sb3_combrel {path.name}"}):
        figure.savefig(svg, metadata={"Date": None})
    return [png, svg]
