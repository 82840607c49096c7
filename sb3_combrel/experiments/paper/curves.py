"""Figures 2, 3, 5 and 6: learning curves, and the training needed to reach a threshold; with the controls beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_combrel.comparison.curves import moving_average
from sb3_combrel.comparison.figures import COLOURS, panels_of, readable_ticks, save
from sb3_combrel.comparison.measures import steps_to_reach
from sb3_combrel.comparison.statistics import bootstrap_band
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import Domain

#: Moving average, and the median for thresholds, over so many episodes.
WINDOW = 5
_GREY, _BLUE, _VERMILLION, _GREEN, _PURPLE = COLOURS
_SKY, _ORANGE = "#56B4E9", "#E69F00"
#: Colour and line of each method, the same in all figures; controls have no solid line.
STYLES = {
    m.NO_TRANSFER: (_GREY, "-"),
    m.TIMBREL_INTUITIVE: (_BLUE, "-"),
    m.COMBREL_PLAIN: (_VERMILLION, "-"),
    m.COMBREL_RELEVANCE: (_ORANGE, "-"),
    m.TIMBREL_RELEVANCE: (_SKY, "-"),
    m.COMBREL_WHOLE: (_GREEN, "-"),
    m.TIMBREL_RANDOM: (_PURPLE, "-"),
    m.ONE_RANDOM: (_PURPLE, "--"),
    m.TIMBREL_FREQUENT: (_BLUE, "-"),
    m.ORACLE: (_GREEN, "--"),
    m.UNRELATED: ("black", ":"),
    m.NO_TRANSFER_BEST: (_GREY, "--"),
}
_MARKS = (_BLUE, _VERMILLION, _GREEN, _PURPLE, _SKY, _ORANGE)


def draw_curves(panels: Mapping[str, Mapping[str, np.ndarray]], domain: Domain, title: str, path: Path) -> list[Path]:
    """
    Draw learning curves, one panel beside the other: mean over the runs of the moving average, 95% bootstrap bands.

    :param panels: for each panel's title the steps of each method's runs, shape (n_runs, n_episodes)
    :param domain: the domain
    :param title: title of the figure
    :param path: file to write, without its suffix
    :return: the PNG and the SVG file
    """
    figure, all_axes = panels_of(len(panels), title)
    for axes, (name, steps) in zip(all_axes, panels.items(), strict=True):
        for method, samples in steps.items():
            colour, line = STYLES[method]
            smooth = moving_average(samples, WINDOW)
            band = bootstrap_band(smooth)
            episodes = np.arange(samples.shape[1] - smooth.shape[1] + 1, samples.shape[1] + 1)
            axes.plot(episodes, band.mean, line, color=colour, label=f"{method} ({len(samples)} runs)")
            axes.fill_between(episodes, band.low, band.high, color=colour, alpha=0.15, linewidth=0)
        axes.set_title(name, fontsize="medium")
        # The methods differ in the first tenth of the episodes.
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        readable_ticks(axes.yaxis)
        axes.set_xlabel("episode")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small")
    all_axes[0].set_ylabel(f"{domain.unit} (mean of {WINDOW} episodes)")
    return save(figure, path)


def draw_times(panels: Mapping[str, Mapping[str, np.ndarray]], domain: Domain, title: str, path: Path) -> list[Path]:
    """
    Draw the environment steps until the median of the last episodes is at most a threshold; median over the runs.

    A method whose median run never gets there has no point; the band is the bootstrap's 95% interval of the median.

    Parameters: see :func:`draw_curves`.
    """
    figure, all_axes = panels_of(len(panels), title)
    places = np.arange(len(domain.thresholds))
    anything = False
    for axes, (name, steps) in zip(all_axes, panels.items(), strict=True):
        for method, samples in steps.items():
            colour, line = STYLES[method]
            needed = np.array([steps_to_reach(samples, threshold, WINDOW) for threshold in domain.thresholds]).T
            band = bootstrap_band(needed, "median")
            reached = np.isfinite(band.mean)
            axes.plot(places[reached], band.mean[reached], line, color=colour, marker="o", markersize=4, label=method)
            shown = reached & np.isfinite(band.low) & np.isfinite(band.high)
            axes.fill_between(places[shown], band.low[shown], band.high[shown], color=colour, alpha=0.12, linewidth=0)
            anything = anything or bool(reached.any())
        axes.set_title(name, fontsize="medium")
        axes.set_xticks(places, [str(threshold) for threshold in domain.thresholds])
        axes.set_xlabel(f"threshold: {domain.unit} an episode (median of {WINDOW})")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small")
    all_axes[0].set_ylabel("environment steps until the threshold")
    for axes in all_axes:
        if anything:
            axes.set_yscale("log")
            readable_ticks(axes.yaxis)
        else:
            # As in a short trial. A logarithmic axis cannot be drawn without data.
            axes.text(0.5, 0.5, "no threshold was reached", transform=axes.transAxes, ha="center")
    return save(figure, path)


def draw_selection(
    panels: Mapping[str, tuple[np.ndarray, np.ndarray, Sequence[str]]], *labels: tuple[str, str], title: str, path: Path
) -> list[Path]:
    """
    Draw which source action is selected over planes of the state space (Figure 4).

    :param panels: for each title the coordinates of points along both variables, shape (n, 2), the place of each point's
        source action in the names, -1 for none, shape (n,), and the names
    :param labels: of each panel the names of the two variables
    :param title: title of the figure
    :param path: file to write, without its suffix
    :return: the PNG and the SVG file
    """
    figure, all_axes = panels_of(len(panels), title, sharey=False)
    for axes, (name, (points, action, names)), (below, beside) in zip(all_axes, panels.items(), labels, strict=True):
        for k, (label, marker) in enumerate(zip(("nothing", *names), (".", "<", "o", ">", "^", "v"), strict=False), start=-1):
            here = action == k
            if here.any():
                colour = "#BBBBBB" if k < 0 else _MARKS[k]
                axes.scatter(*points[here].T, color=colour, marker=marker, s=8 if k < 0 else 60, label=label)
        axes.set_title(name, fontsize="medium")
        axes.set_xlabel(below)
        axes.set_ylabel(beside)
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.15), ncols=4, frameon=False, fontsize="small")
    return save(figure, path)
