"""Figures, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_combrel.experiments.statistics import mean_of_runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Okabe and Ito's colours, which the colour-blind can distinguish too.
COLOURS = ("#555555", "#0072B2", "#D55E00", "#009E73", "#CC79A7")
MARKERS = ("s", "^", "o", "D", "v")


def figure_of(width: float, height: float) -> Figure:
    """
    Make a figure that pyplot does not know, so that the caller's pyplot and its backend are left alone.

    :param width: in inches; ``height``: likewise
    :raises ModuleNotFoundError: if matplotlib is not installed
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw_learning_curves(steps: Mapping[str, np.ndarray], path: Path, title: str, cap: int) -> Path:
    """
    Draw the steps of each episode, mean of the runs, with bands of 95% confidence.

    :param steps: for each method the steps of each run's episodes, shape (n_runs, n_episodes)
    :param path: PNG file to write
    :param title: title of the figure
    :param cap: steps after which an episode was cut off
    :return: the path
    """
    from matplotlib.ticker import MaxNLocator

    figure = figure_of(7.0, 4.2)
    axes = figure.add_subplot()
    highest = 0.0
    for (method, samples), colour, marker in zip(steps.items(), COLOURS, MARKERS, strict=False):
        episodes = np.arange(1, samples.shape[1] + 1)
        mean, low, high = mean_of_runs(samples)
        highest = max(highest, float(np.minimum(high, cap).max()))
        axes.plot(episodes, mean, color=colour, marker=marker, markersize=5, label=f"{method} ({len(samples)} runs)")
        # No run can need more steps than the cap, nor fewer than none.
        axes.fill_between(episodes, np.maximum(low, 0), np.minimum(high, cap), color=colour, alpha=0.2, linewidth=0)
    axes.set_xlabel("episode")
    axes.set_ylabel(f"steps to goal (at most {cap})")
    axes.set_title(title)
    axes.set_ylim(0, 1.05 * highest)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
    return path


def moving_average(samples: np.ndarray, window: int) -> np.ndarray:
    """
    Compute the mean of ``window`` successive episodes, or of all where there are fewer.

    :param samples: one run a row, shape (n_runs, n_episodes)
    :param window: number of episodes
    :return: shape (n_runs, n_episodes - window + 1)
    """
    window = min(window, samples.shape[1])
    return np.lib.stride_tricks.sliding_window_view(samples.astype(np.float64), window, axis=1).mean(axis=-1)


def panels_of(n: int, title: str, sharey: bool = True) -> tuple[Any, list[Any]]:
    """Make a figure with ``n`` panels side by side; the figure and their axes."""
    figure = figure_of(6.2 * n, 4.4)
    figure.suptitle(title)
    return figure, list(figure.subplots(1, n, sharey=sharey, squeeze=False)[0])


def readable_ticks(axis: Any) -> None:
    """Write numbers such as 200 on a logarithmic axis, not powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:,.0f}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Any, path: Path) -> list[Path]:
    """Save as PNG and SVG; without the date and random names, which would make every file differ."""
    from matplotlib import rc_context

    path.parent.mkdir(parents=True, exist_ok=True)
    png, svg = path.with_suffix(".png"), path.with_suffix(".svg")
    figure.savefig(png, dpi=110)
    with rc_context({"svg.hashsalt": f"sb3_combrel {path.name}"}):
        figure.savefig(svg, metadata={"Date": None})
    return [png, svg]
