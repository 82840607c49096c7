"""A picture for each pair: learning curves, and the performance of each method with its interval."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.scores import FEWEST_RUNS, Cell, MethodScores
from sb3_combrel.experiments.bootstrap import bootstrap_band
from sb3_combrel.experiments.figures import COLOURS, moving_average, panels_of, save
from sb3_combrel.experiments.learning_curves import LearningCurves, curves_of

#: Moving average over so many episodes.
WINDOW = 5
_COLOURS = (*COLOURS, "#56B4E9", "#E69F00", "#000000", "#8C564B", "#999933")
_LINES = ("-", "--", ":")
#: A curve over environment steps has so many points.
_N_POINTS = 100


def style_of(number: int) -> tuple[str, str]:
    """Colour and line of the method with this number; the first thirty differ."""
    return _COLOURS[number % len(_COLOURS)], _LINES[number // len(_COLOURS) % len(_LINES)]


def draw_pair(pair: Pair, cells: Mapping[str, Cell], compared: Mapping[str, MethodScores], path: Path) -> list[Path]:
    """
    Draw the learning curves of a pair, interquartile means with 95% bootstrap bands, and the performance of its methods.

    :param pair: the pair
    :param cells: by method, in the order of colours
    :param compared: what was computed of those that have runs
    :param path: file to write, without its suffix
    :return: the PNG and the SVG file
    """
    figure, (left, right) = panels_of(2, f"{pair.name}: {pair.budget}", sharey=False)
    # Methods whose runs are the same are drawn once.
    names = [name for name in compared if cells[name].run_as == name or cells[name].run_as not in compared]
    numbers = {name: number for number, name in enumerate(cells)}
    for name in names:
        curves = curves_of(cells[name].outcomes)
        where, values = _by_episodes(curves) if pair.n_steps is None else _by_steps(curves)
        colour, line = style_of(numbers[name])
        band = bootstrap_band(values, "iqm")
        left.plot(where, band.mean, line, color=colour, label=f"{name} ({len(values)})")
        if len(values) >= FEWEST_RUNS:
            left.fill_between(where, band.low, band.high, color=colour, alpha=0.12, linewidth=0)
    left.set_xlabel("episode" if pair.n_steps is None else "environment steps")
    left.set_ylabel(f"return (mean of {WINDOW} episodes)")
    left.grid(alpha=0.3)
    for place, name in enumerate(reversed(names)):
        estimate, colour = compared[name].estimate, style_of(numbers[name])[0]
        if np.isfinite(estimate.low):
            right.plot([estimate.low, estimate.high], [place, place], "-", color=colour)
        right.plot([estimate.mean], [place], "o", color=colour)
    right.set_yticks(range(len(names)), list(reversed(names)))
    right.set_xlabel("mean return of an episode" + ("" if pair.n_steps is None else ", over steps"))
    right.grid(alpha=0.3, axis="x")
    if names:
        left.legend(frameon=False, fontsize="x-small")
    else:
        left.text(0.5, 0.5, "no run has succeeded", transform=left.transAxes, ha="center")
    return save(figure, path)


def _by_episodes(curves: LearningCurves) -> tuple[np.ndarray, np.ndarray]:
    """Moving averages by episode: where each ends, and values of shape (n_runs, n_points)."""
    returns = curves.first_episodes().returns
    smooth = moving_average(returns, WINDOW)
    return np.arange(returns.shape[1] - smooth.shape[1] + 1, returns.shape[1] + 1), smooth


def _by_steps(curves: LearningCurves) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the last episodes that have ended by a step: steps, and values of shape (n_runs, n_points)."""
    ends = [np.cumsum(steps[: int(n)]) for steps, n in zip(curves.steps, curves.n_episodes, strict=True)]
    where = np.linspace(max(each[0] for each in ends), max(each[-1] for each in ends), _N_POINTS)
    values = np.empty((len(ends), _N_POINTS))
    for run, its_ends in enumerate(ends):
        total = np.concatenate([[0.0], np.cumsum(curves.returns[run, : len(its_ends)])])
        n_ended = np.searchsorted(its_ends, where, side="right")
        first = np.maximum(n_ended - WINDOW, 0)
        values[run] = (total[n_ended] - total[first]) / (n_ended - first)
    return where, values
