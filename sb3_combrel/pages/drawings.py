"""What dashboard and pages draw alike: values, bound and policy in a plane, evidence over time, returns, contradictions.

Each is a figure of matplotlib of a given width in inches, in which text keeps its size: narrow ones stack their panels. No
display is needed, and pyplot is left alone. Importing this imports matplotlib.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sb3_combrel.pages.palette import ACTION_COLOURS, MAPPING_COLOURS, NONE_COLOUR, colour
from sb3_combrel.pages.plane import Plane
from sb3_combrel.pages.snapshot import Snapshot
from sb3_combrel.transfer.report import EvidencePoint

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


def evidence_figure(
    history: Sequence[EvidencePoint], action_names: Sequence[str], colours: Mapping[str, str], width: float
) -> Figure:
    """Draw what each target action was taken for over time, as how much the source counted, and its prediction error.

    :param history: of one run, at least one point
    :param colours: of each mapping, see :func:`~sb3_combrel.pages.palette.mapping_colours`
    """
    steps = [point.step for point in history]
    heights = (0.24 * len(action_names) + 0.3, 1.6, 1.3)
    names = [name for name in dict.fromkeys(name for point in history for name in point.mappings) if name in colours]
    legend_lines = sum(len(textwrap.wrap(name, int(width * CHARACTERS) - 6)) for name in names)
    figure = figure_of(width, sum(heights) + 0.9 + LINE * (legend_lines + 1))
    strips, strengths, errors = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": heights})
    _draw_strips(strips, history, action_names, colours)
    for action, name in enumerate(action_names):
        # The colour is that of what the action is taken for in the end; dashes tell actions of one mapping apart.
        style = dict(color=_visible(colours.get(history[-1].mappings[action], "")), linestyle=_DASHES[action % len(_DASHES)])
        values = [point.strengths[action] for point in history]
        strengths.step(steps, values, where="post", label=name, linewidth=1.5, **style)
    strengths.set_ylim(bottom=0.0)
    _label(strengths, "as how many of the target's own instances the source counts", "instances")
    strengths.legend(fontsize=FONT_SIZE - 1, frameon=False, ncols=2 if width < NARROW else 5, loc="upper left")
    # Room for the legend above the curves.
    room = 1.0 + 0.3 * -(-len(action_names) // (2 if width < NARROW else 5))
    strengths.set_ylim(top=max(1e-9, room * max(max(point.strengths) for point in history)))
    errors.step(steps, [point.error for point in history], where="post", color="#333333", linewidth=1.5)
    errors.axhline(1.0, color="#999999", linewidth=1.0, linestyle=":")
    highest = np.nanmax([1.0, *(point.error for point in history)])
    errors.set_ylim(0.0, 1.15 * min(highest, HIGHEST_ERROR))
    _shade_bounds(errors, history)
    _label(errors, 'prediction error ("no change": 1); shaded: the source bounds values', "error")
    errors.set_xlabel("environment steps", fontsize=FONT_SIZE)
    errors.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    patches = [Patch(color=_visible(colours[name]), label=textwrap.fill(name, int(width * CHARACTERS) - 6)) for name in names]
    figure.legend(
        handles=patches, loc="outside lower left", frameon=False, fontsize=FONT_SIZE, title="mapping", alignment="left"
    )
    return figure


def _draw_strips(
    axes: Axes, history: Sequence[EvidencePoint], action_names: Sequence[str], colours: Mapping[str, str]
) -> None:
    """Draw a strip a target action, coloured by the mapping in use."""
    steps = [point.step for point in history]
    for action in range(len(action_names)):
        used = [point.mappings[action] for point in history]
        # Where it changes, and the end: a seam between bars of one colour would be seen.
        ends = [k for k in range(1, len(used)) if k == len(used) - 1 or used[k] != used[k - 1]]
        for begin, end in itertools.pairwise([0, *ends]):
            shown = colours.get(used[begin], NONE_COLOUR)
            axes.barh(action, steps[end] - steps[begin], left=steps[begin], height=0.8, color=shown, linewidth=0)
    axes.set_yticks(range(len(action_names)), action_names, fontsize=FONT_SIZE)
    axes.set_ylim(len(action_names) - 0.5, -0.5)
    _label(axes, "what each target action is taken for", "")
    axes.grid(visible=False)


def _shade_bounds(axes: Axes, history: Sequence[EvidencePoint]) -> None:
    for point, after in itertools.pairwise(history):
        if point.bounds_values:
            axes.axvspan(point.step, after.step, color="#009E73", alpha=0.12, linewidth=0)


def mean_evidence_figure(
    histories: Mapping[str, Sequence[Sequence[EvidencePoint]]], colours: Mapping[str, str], width: float
) -> Figure:
    """Draw strength and error over time, averaged over target actions and runs, with each run as a thin line.

    :param histories: by method, of each run; points are few and early, so the steps are on a logarithmic axis
    :param colours: of each method
    """
    figure = figure_of(width, 4.4)
    strengths, errors = figure.subplots(2, 1, sharex=True)
    for method, runs in histories.items():
        at = np.unique([point.step for run in runs for point in run if point.step > 0])
        for axes, values_of in ((strengths, _mean_strength), (errors, _error)):
            rows = [_held([point.step for point in run], [values_of(point) for point in run], at) for run in runs]
            for row in rows:
                axes.step(at, row, where="post", color=colours[method], alpha=0.25, linewidth=0.8)
            with np.errstate(invalid="ignore"):
                n = np.isfinite(rows).sum(axis=0)
                mean = np.where(n > 0, np.nansum(rows, axis=0) / np.maximum(n, 1), np.nan)
            axes.step(at, mean, where="post", color=colours[method], linewidth=2.0, label=f"{method} ({len(runs)} runs)")
    errors.axhline(1.0, color="#999999", linewidth=1.0, linestyle=":")
    errors.set_ylim(0.0, 1.15 * HIGHEST_ERROR)
    strengths.set_ylim(bottom=0.0)
    strengths.set_xscale("log")
    strengths.xaxis.set_major_formatter("{x:,.0f}")
    _label(strengths, "as how many own instances the source counts", "instances")
    _label(errors, 'prediction error ("no change": 1)', "error")
    errors.set_xlabel("environment steps", fontsize=FONT_SIZE)
    strengths.legend(fontsize=FONT_SIZE - 1, frameon=False, loc="upper left")
    return figure


def _mean_strength(point: EvidencePoint) -> float:
    return float(np.mean(point.strengths))


def _error(point: EvidencePoint) -> float:
    return point.error


def _held(steps: Sequence[int], values: Sequence[float], at: np.ndarray) -> np.ndarray:
    """Values that hold from one step to the next, at other steps; NaN before the first."""
    number = np.searchsorted(steps, at, side="right") - 1
    return np.where(number < 0, np.nan, np.asarray(values)[np.maximum(number, 0)])


def returns_figure(steps: np.ndarray, returns: np.ndarray, width: float) -> Figure:
    """Draw the returns of the episodes of one run, and their running mean over ten.

    :param steps: environment steps at which each episode ended, shape (n_episodes,); ``returns``: of each
    """
    figure = figure_of(width, 2.8)
    axes = figure.subplots()
    axes.plot(steps, returns, ".", color=MAPPING_COLOURS[0], alpha=0.45, label="an episode", markersize=5)
    window = min(10, len(returns) // 2)
    if window > 1:
        mean = np.convolve(returns, np.ones(window) / window, mode="valid")
        axes.plot(steps[window - 1 :], mean, color=MAPPING_COLOURS[0], linewidth=1.8, label=f"mean of {window}")
    _label(axes, "return of the episodes", "return")
    axes.set_xlabel("environment steps", fontsize=FONT_SIZE)
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
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.label_outer()


_DASHES = ("-", "--", ":", "-.")


def _visible(shown: str) -> str:
    """A colour in which a line can be seen: that of nothing is darkened."""
    return "#BBBBBB" if shown in ("", NONE_COLOUR) else shown


def _label(axes: Axes, title: str, y_label: str) -> None:
    room = int((axes.figure.get_figwidth() - 0.8) * CHARACTERS)  # type: ignore[union-attr]
    axes.set_title(textwrap.fill(title, room), fontsize=FONT_SIZE, loc="left", pad=4)
    axes.set_ylabel(y_label, fontsize=FONT_SIZE)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.grid(alpha=0.25)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
