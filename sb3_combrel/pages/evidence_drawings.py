"""The evidence for a source over time: of one run by target action, and of several methods on average."""

from __future__ import annotations

import itertools
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sb3_combrel.pages.drawings import CHARACTERS, FONT_SIZE, HIGHEST_ERROR, LINE, figure_of, label_axes
from sb3_combrel.pages.palette import NONE_COLOUR
from sb3_combrel.transfer.report import EvidencePoint

#: So many mappings are shown in their colours, those in use for longest; all others are grey.
MAX_NAMED = 10
OTHERS = "others, for shorter"
OTHERS_COLOUR = "#CCCCCC"
#: Names of actions beside the strips are shortened to so many letters an inch of the figure's width.
NAME_CHARACTERS = 3.0
_DASHES = ("-", "--", ":", "-.")


def evidence_figure(
    history: Sequence[EvidencePoint], action_names: Sequence[str], colours: Mapping[str, str], width: float
) -> Figure:
    """Draw what each target action was taken for over time, as how much the source counted, and its prediction error.

    :param history: of one run, at least one point
    :param colours: of each mapping, see :func:`~sb3_combrel.pages.palette.mapping_colours`
    :param width: in inches
    """
    shown = _colours_in_use(history, colours)
    labels = [textwrap.fill(name, int(width * CHARACTERS) - 6, break_long_words=True) for name in shown]
    heights = (0.24 * len(action_names) + 0.3, 1.7, 1.3)
    n_lines = 1 + sum(1.15 * (label.count("\n") + 1) for label in labels)
    figure = figure_of(width, sum(heights) + 0.9 + LINE * n_lines)
    strips, strengths, errors = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": heights})
    _draw_strips(strips, history, [shortened(name, int(NAME_CHARACTERS * width)) for name in action_names], shown)
    _draw_strengths(strengths, history, action_names, shown, width)
    _draw_errors(errors, history)
    errors.set_xlabel("environment steps", fontsize=FONT_SIZE)
    errors.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    patches = [Patch(color=_visible(each), label=label) for each, label in zip(shown.values(), labels, strict=True)]
    figure.legend(
        handles=patches, loc="outside lower left", frameon=False, fontsize=FONT_SIZE, title="mapping", alignment="left"
    )
    return figure


def shortened(name: str, n: int) -> str:
    """Shorten a name to ``n`` letters: what is left out is in the middle, for names often differ at the end."""
    return name if len(name) <= n else f"{name[: (n - 1) // 2]}…{name[len(name) - n // 2 :]}"


def _colours_in_use(history: Sequence[EvidencePoint], colours: Mapping[str, str]) -> dict[str, str]:
    """Find the colours of the mappings in use for longest, in the order in which they came up, and of all others."""
    steps: Counter[str] = Counter()
    for point, after in itertools.pairwise([*history, history[-1]]):
        for name in point.mappings:
            # Those in use at the end count more than none at all.
            steps[name] += max(after.step - point.step, 1)
    longest = {name for name, _ in steps.most_common(MAX_NAMED)}
    named = {name: colours.get(name, NONE_COLOUR) for name in steps if name in longest}
    return named if len(steps) <= MAX_NAMED else {**named, OTHERS: OTHERS_COLOUR}


def _draw_strips(axes: Axes, history: Sequence[EvidencePoint], action_names: Sequence[str], shown: Mapping[str, str]) -> None:
    """Draw a strip a target action, coloured by the mapping in use."""
    steps = [point.step for point in history]
    for action in range(len(action_names)):
        used = [point.mappings[action] for point in history]
        # Where it changes, and the end: a seam between bars of one colour would be seen.
        ends = [k for k in range(1, len(used)) if k == len(used) - 1 or used[k] != used[k - 1]]
        for begin, end in itertools.pairwise([0, *ends]):
            colour = shown.get(used[begin], OTHERS_COLOUR)
            axes.barh(action, steps[end] - steps[begin], left=steps[begin], height=0.8, color=colour, linewidth=0)
    axes.set_yticks(range(len(action_names)), action_names, fontsize=FONT_SIZE)
    axes.set_ylim(len(action_names) - 0.5, -0.5)
    label_axes(axes, "what each target action is taken for", "")
    axes.grid(visible=False)


def _draw_strengths(
    axes: Axes, history: Sequence[EvidencePoint], action_names: Sequence[str], shown: Mapping[str, str], width: float
) -> None:
    """Draw a line a target action, in the colour of its mapping in the end; dashes tell those of one colour apart."""
    steps = [point.step for point in history]
    for action, name in enumerate(action_names):
        colour = _visible(shown.get(history[-1].mappings[action], OTHERS_COLOUR))
        values = [point.strengths[action] for point in history]
        dashes = _DASHES[action % len(_DASHES)]
        axes.step(steps, values, where="post", label=name, linewidth=1.5, color=colour, linestyle=dashes)
    n_columns = int(0.7 * width * CHARACTERS) // (max(map(len, action_names)) + 7)
    n_rows = -(-len(action_names) // n_columns) if n_columns else len(action_names)
    note = ""
    if n_columns and n_rows <= 3:
        axes.legend(fontsize=FONT_SIZE - 1, frameon=False, ncols=n_columns, loc="upper left").set_in_layout(False)
    else:
        n_rows, note = 0, "; colours: as the strips end"
    # Room for the legend above the curves.
    highest = max(max(point.strengths) for point in history)
    axes.set_ylim(0.0, max(1e-9, (1.1 + 0.2 * n_rows) * highest))
    label_axes(axes, f"as how many of the target's own instances the source counts{note}", "instances")


def _draw_errors(axes: Axes, history: Sequence[EvidencePoint]) -> None:
    errors = [point.error for point in history]
    axes.step([point.step for point in history], errors, where="post", color="#333333", linewidth=1.5)
    axes.axhline(1.0, color="#999999", linewidth=1.0, linestyle=":")
    axes.set_ylim(0.0, 1.15 * min(np.nanmax([1.0, *errors]), HIGHEST_ERROR))
    for point, after in itertools.pairwise(history):
        if point.bounds_values:
            axes.axvspan(point.step, after.step, color="#009E73", alpha=0.12, linewidth=0)
    label_axes(axes, 'prediction error ("no change": 1); shaded: the source bounds values', "error")


def _visible(colour: str) -> str:
    """A colour in which a line can be seen: that of nothing is darkened."""
    return "#999999" if colour == NONE_COLOUR else colour


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
    label_axes(strengths, "as how many own instances the source counts", "instances")
    label_axes(errors, 'prediction error ("no change": 1)', "error")
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
