"""The picture of the idea, source, mapping and target: ``python -m sb3_combrel.experiments.concept`` (``make figures``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

FILE = Path("docs/figures/concept.png")
#: Size in inches and dots an inch; fonts are so large that they can be read when the picture is 400 pixels wide.
SIZE, DPI = (9.0, 3.7), 110
TITLE, LABEL, SMALL = 19.0, 15.5, 14.5
#: Okabe and Ito's blue for state variables, their vermilion for actions; fillings are light versions of them.
STATE, ACTION, GROUND, TEXT = "#0072B2", "#D55E00", "#6B8E5A", "#222222"
STATE_LIGHT, ACTION_LIGHT, GOAL_COLOUR = "#DCEBF5", "#FBE3D3", "#E69F00"
LEFT_WALL, GOAL = -1.2, 0.6


def height(position: np.ndarray | float) -> np.ndarray:
    """Height of Mountain Car's road, of the same shape as ``position``."""
    return np.sin(3.0 * np.asarray(position))


def draw_source(axes: Any) -> None:
    """Draw Mountain Car in two dimensions: a valley, a car and a flag."""
    x = np.linspace(LEFT_WALL, GOAL, 200)
    axes.fill_between(x, height(x), -1.5, color=GROUND, alpha=0.35, linewidth=0)
    axes.plot(x, height(x), color=GROUND, linewidth=3.5)
    axes.plot([GOAL - 0.06] * 2, [height(GOAL - 0.06), 1.75], color=TEXT, linewidth=2)
    axes.fill([GOAL - 0.06, GOAL - 0.06, GOAL - 0.32], [1.75, 1.35, 1.55], color=GOAL_COLOUR)
    place = -0.6
    axes.plot(place, height(place) + 0.14, "o", color=STATE, markersize=15, markeredgecolor="white")
    for sign in (-1, 1):
        axes.annotate(
            "",
            xy=(place + sign * 0.46, height(place) + 0.14),
            xytext=(place + sign * 0.14, height(place) + 0.14),
            arrowprops={"arrowstyle": "-|>", "color": ACTION, "linewidth": 2.5, "mutation_scale": 18},
        )
    axes.set(xlim=(LEFT_WALL, GOAL), ylim=(-1.5, 1.9))
    axes.axis("off")


def draw_target(axes: Any) -> None:
    """Draw Mountain Car in four dimensions from above: height as colour and contours, a car and a flag."""
    x = np.linspace(LEFT_WALL, GOAL, 120)
    ground = height(x)[None, :] + height(x)[:, None]
    axes.contourf(x, x, ground, levels=12, cmap="Greens", vmin=-3.5, vmax=3.5)
    axes.contour(x, x, ground, levels=6, colors=GROUND, linewidths=0.8, linestyles="solid")
    axes.plot([GOAL - 0.14] * 2, [GOAL - 0.4, GOAL - 0.06], color=TEXT, linewidth=2)
    axes.fill([GOAL - 0.14, GOAL - 0.14, GOAL - 0.36], [GOAL - 0.06, GOAL - 0.24, GOAL - 0.15], color=GOAL_COLOUR)
    place = (-0.55, -0.6)
    axes.plot(*place, "o", color=STATE, markersize=15, markeredgecolor="white")
    for along in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        start, end = (tuple(p + reach * a for p, a in zip(place, along, strict=True)) for reach in (0.14, 0.46))
        axes.annotate(
            "", xy=end, xytext=start, arrowprops={"arrowstyle": "-|>", "color": ACTION, "linewidth": 2.5, "mutation_scale": 18}
        )
    axes.set(xlim=(LEFT_WALL, GOAL), ylim=(LEFT_WALL, GOAL), aspect="equal")
    axes.axis("off")


def draw_box(axes: Any, centre: tuple[float, float], width: float, text: str, colour: str, filling: str) -> None:
    """Draw a rounded box with a text in it; lengths in parts of the panel."""
    x, y = centre
    box = FancyBboxPatch(
        (x - width / 2, y - 0.06),
        width,
        0.12,
        boxstyle="round,pad=0.01,rounding_size=0.05",
        facecolor=filling,
        edgecolor=colour,
        linewidth=1.8,
    )
    axes.add_patch(box)
    axes.text(x, y - 0.008, text, ha="center", va="center", fontsize=LABEL, color=TEXT)


def draw_mapping(axes: Any) -> None:
    """Draw which variables and actions of the source stand for which of the target."""
    rows = (
        ("x, v", (0.80, "x, vx"), (0.60, "y, vy"), STATE, STATE_LIGHT),
        ("Left, Right", (0.30, "West, East"), (0.10, "South, North"), ACTION, ACTION_LIGHT),
    )
    for source, first, second, colour, filling in rows:
        middle = (first[0] + second[0]) / 2
        draw_box(axes, (0.17, middle), 0.31, source, colour, filling)
        for y, target in (first, second):
            draw_box(axes, (0.80, y), 0.37, target, colour, filling)
            arrow = FancyArrowPatch(
                (0.33, middle), (0.61, y), arrowstyle="-|>", mutation_scale=20, color=colour, linewidth=2.2
            )
            axes.add_patch(arrow)
    axes.set(xlim=(0, 1), ylim=(0, 0.9))
    axes.axis("off")


def concept() -> Figure:
    """Return the picture."""
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    panels = [
        figure.add_axes(place) for place in ((0.015, 0.17, 0.25, 0.64), (0.283, 0.16, 0.43, 0.66), (0.735, 0.165, 0.255, 0.65))
    ]
    for draw, panel in zip((draw_source, draw_mapping, draw_target), panels, strict=True):
        draw(panel)
    for x, title, below in (
        (0.14, "Source", "recorded steps"),
        (0.5, "Mapping", "given (TIMBREL) or found (COMBREL)"),
        (0.86, "Target", "fewer steps to learn"),
    ):
        figure.text(x, 0.91, title, ha="center", va="center", fontsize=TITLE, fontweight="bold", color=TEXT)
        figure.text(x, 0.07, below, ha="center", va="center", fontsize=SMALL, color=TEXT)
    return figure


def main(file: Path = FILE) -> None:
    """Draw the picture and save it, without anything in the file that differs from call to call.

    :param file: the PNG file, whose folder is made if need be
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    concept().savefig(file, metadata={"Software": None})
    print(file)


if __name__ == "__main__":
    main()
