"""Figures, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sb3_combrel.experiments.statistics import mean_of_runs

#: Okabe and Ito's colours, which the colour-blind can distinguish too.
COLOURS = ("#555555", "#0072B2", "#D55E00", "#009E73", "#CC79A7")
MARKERS = ("s", "^", "o", "D", "v")


def draw_learning_curves(steps: Mapping[str, np.ndarray], path: Path, title: str, cap: int) -> Path:
    """
    Draw the steps of each episode, mean of the runs, with bands of 95% confidence.

    :param steps: for each method the steps of each run's episodes, shape (n_runs, n_episodes)
    :param path: PNG file to write
    :param title: title of the figure
    :param cap: steps after which an episode was cut off
    :return: the path
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    # The object-oriented interface leaves the caller's pyplot and its backend alone.
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
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
