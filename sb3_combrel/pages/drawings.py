"""What dashboard and pages draw alike: values, bound and policy in a plane, returns, contradictions.

Each is a figure of matplotlib of a given width in inches, in which text keeps its size: narrow ones stack their panels. No
display is needed, and pyplot is left alone. Importing this imports matplotlib.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator

from sb3_combrel.pages.palette import ACTION_COLOURS, MAPPING_COLOURS, NONE_COLOUR, colour
from sb3_combrel.pages.plane import Plane
from sb3_combrel.pages.snapshot import Snapshot

FONT_SIZE = 9
LINE = 0.18  # inches, of a line of text of that size
CHARACTERS = 13.5  # about as many fit into an inch
# A figure that is narrower has its panels one above the other.
NARROW = 5.0
AN_OPTIMISTIC_ACTION = "one has no model"
# Shares of squared errors above 1 are contradictions; beyond this they are drawn alike.
HIGHEST_ERROR = 2.0


def figure_of(width: float, height: float) -> Figure:
    """Make a figure; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def value_figure(snapshot: Snapshot, plane: Plane, width: float) -> Figure:
    """Draw V over a plane, what the source's values bound it by, if they do, and the greedy action of the model."""
    maps = [("value V", snapshot.values[plane.points])]
    if snapshot.bound is not None:
        maps.append(("bound by the source's values", snapshot.bound[plane.points]))
    n_panels = len(maps) + 1
    n_columns = 1 if width < NARROW else n_panels
    names = snapshot.action_names
    title = f"at {plane.held}" if plane.held else ""
    row_height = min(0.85 * width / n_columns, 2.6)
    figure, panels = panels_with_legend(
        width, (n_panels // n_columns, n_columns), row_height, title, (names, AN_OPTIMISTIC_ACTION, ""), ACTION_COLOURS
    )
    lowest, highest = (limit([values for _, values in maps]) for limit in (np.min, np.max))
    for panel, (words, values) in zip(panels, maps, strict=False):
        # V between grid points is interpolated, so the picture is too.
        style = dict(aspect="auto", interpolation="bilinear", vmin=lowest, vmax=highest)
        image = panel.imshow(values, origin="lower", extent=plane.extent, **style)  # type: ignore[arg-type]
        bar = figure.colorbar(image, ax=panel, ticks=MaxNLocator(4), fraction=0.09, pad=0.04)
        bar.ax.tick_params(labelsize=FONT_SIZE - 1, pad=1)
        label_plane(panel, plane, words)
    show_numbers(panels[-1], snapshot.greedy[plane.points], plane, len(names), ACTION_COLOURS)
    label_plane(panels[-1], plane, "greedy action")
    return figure


def returns_figure(ends: np.ndarray, returns: np.ndarray, unit: str, width: float) -> Figure:
    """Draw the returns of the episodes of one run, and their running mean over ten.

    :param ends: at which each episode ended, in ``unit``, such as environment steps, shape (n_episodes,); ``returns``: of each
    """
    figure = figure_of(width, 2.8)
    axes = figure.subplots()
    axes.plot(ends, returns, ".", color=MAPPING_COLOURS[0], alpha=0.45, label="an episode", markersize=5)
    window = min(10, len(returns) // 2)
    if window > 1:
        mean = np.convolve(returns, np.ones(window) / window, mode="valid")
        axes.plot(ends[window - 1 :], mean, color=MAPPING_COLOURS[0], linewidth=1.8, label=f"mean of {window}")
    label_axes(axes, "return of the episodes", "return")
    axes.set_xlabel(unit, fontsize=FONT_SIZE)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.legend(fontsize=FONT_SIZE - 1, frameon=False)
    return figure


def contradictions_figure(
    errors: np.ndarray, action_names: Sequence[str], edges: Mapping[str, np.ndarray], width: float
) -> Figure:
    """Draw prediction errors by target action and part of each variable's range: blue is better than "no change", red worse.

    :param errors: over those of "no change", NaN where too few steps were compared, shape (n_actions, n_variables, n_parts)
    :param edges: by variable, where its parts begin and end, raw units, each of shape (n_parts + 1,)
    """
    n_actions, n_variables, n_parts = errors.shape
    n_columns = 1 if width < NARROW else n_variables
    n_rows = n_variables if n_columns == 1 else 1
    figure = figure_of(width, n_rows * (0.24 * n_actions + 0.75) + 0.8)
    panels = figure.subplots(n_rows, n_columns, squeeze=False, sharey=True)
    colours = colormaps["RdBu_r"].with_extremes(bad=NONE_COLOUR)
    for panel, (k, (name, edge)) in zip(panels.flat, enumerate(edges.items()), strict=True):
        shown = np.ma.masked_invalid(np.minimum(errors[:, k], HIGHEST_ERROR))
        image = panel.imshow(shown, cmap=colours, norm=TwoSlopeNorm(1.0, 0.0, HIGHEST_ERROR), aspect="auto")
        panel.set_xticks(np.arange(n_parts + 1) - 0.5, [f"{value:.3g}" for value in edge], fontsize=FONT_SIZE - 1)
        panel.set_yticks(range(n_actions), action_names, fontsize=FONT_SIZE)
        panel.set_xlabel(name, fontsize=FONT_SIZE)
    bar = figure.colorbar(
        image, ax=list(panels.flat), location="bottom", shrink=0.8, aspect=40, ticks=[0.0, 1.0, HIGHEST_ERROR]
    )
    bar.ax.set_xticklabels(["0: exact", "1: as no change", "2 or more"], fontsize=FONT_SIZE - 1)
    return figure


def panels_with_legend(
    width: float,
    shape: tuple[int, int],
    row_height: float,
    title: str,
    legend: tuple[Sequence[str], str, str],
    colours: tuple[str, ...],
) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels, with a title of any length above and a legend of the names' colours below.

    :param shape: rows and columns of panels; ``row_height``: of one, in inches
    :param legend: names, what stands for none of them, and what they are names of
    """
    names, for_none, names_of = legend
    n_characters = int(width * CHARACTERS)
    lines = textwrap.wrap(title, n_characters)
    n_columns_of_legend = max(1, min(len(names) + 1, n_characters // (max(map(len, (*names, for_none))) + 6)))
    n_lines = len(lines) + 1 + -(-(len(names) + 1) // n_columns_of_legend)
    height = 0.55 + LINE * n_lines + (row_height + 0.45) * shape[0]
    figure = figure_of(width, height)
    axes = figure.subplots(*shape, squeeze=False)
    if lines:
        figure.suptitle("\n".join(lines), fontsize=FONT_SIZE)
    patches = [Patch(color=colour(k, colours), label=name) for k, name in enumerate(names)]
    figure.legend(
        handles=[*patches, Patch(color=NONE_COLOUR, label=for_none)],
        loc="outside lower center",
        ncols=n_columns_of_legend,
        frameon=False,
        fontsize=FONT_SIZE,
        title=names_of or None,
        title_fontsize=FONT_SIZE,
        borderpad=0.1,
        labelspacing=0.25,
        columnspacing=1.0,
        handlelength=1.2,
    )
    return figure, list(axes.flat)


def show_numbers(axes: Axes, numbers: np.ndarray, plane: Plane, n: int, colours: tuple[str, ...] = MAPPING_COLOURS) -> None:
    """Draw a colour for each number below ``n``, and light grey for -1."""
    palette = np.array([to_rgb(each) for each in (*(colour(k, colours) for k in range(n)), NONE_COLOUR)])
    axes.imshow(palette[numbers], origin="lower", extent=plane.extent, aspect="auto", interpolation="nearest")


def label_plane(axes: Axes, plane: Plane, title: str) -> None:
    """Label the axes of a panel with the plane's variables."""
    axes.set_title(title, fontsize=FONT_SIZE, pad=3)
    axes.set_xlabel(plane.names[0], fontsize=FONT_SIZE, labelpad=1)
    axes.set_ylabel(plane.names[1], fontsize=FONT_SIZE, labelpad=1)
    axes.tick_params(labelsize=FONT_SIZE - 1, pad=2)
    # Most of the time that a picture takes is spent on ticks.
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3) if plane.names[1] else NullLocator())
    axes.label_outer()


def label_axes(axes: Axes, title: str, y_label: str) -> None:
    """Put a title above an axes at the left, as wide as there is room, and name what goes up."""
    room = int((axes.figure.get_figwidth() - 0.8) * CHARACTERS)  # type: ignore[union-attr]
    axes.set_title(textwrap.fill(title, room), fontsize=FONT_SIZE, loc="left", pad=4)
    axes.set_ylabel(y_label, fontsize=FONT_SIZE)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.grid(alpha=0.25)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
