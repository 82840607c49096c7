"""A picture for each pair: learning curves, and the performance of each method with its interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.comparison.curves import LearningCurves, curves_of, moving_average
from sb3_combrel.comparison.figures import COLOURS, figure_of, save
from sb3_combrel.comparison.statistics import ALPHA, Estimate, bootstrap_band
from sb3_combrel.experiments.benchmark.methods import NONE
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.scores import FEWEST_RUNS, Cell, MethodScores

#: Moving average over so many episodes.
WINDOW = 5
#: No transfer, which all others are compared with; and the method of a panel.
_COLOUR_NONE, _COLOUR = COLOURS[:2]
_PANELS_IN_A_ROW = 4
#: A curve over environment steps has so many points.
_N_POINTS = 100


def draw_pair(pair: Pair, cells: Mapping[str, Cell], compared: Mapping[str, MethodScores], path: Path) -> list[Path]:
    """Draw each method's learning curve beside no transfer's (IQM, 95% band), and performances; full: differs from none."""
    # Methods whose runs are the same are drawn once.
    names = [name for name in compared if cells[name].run_as == name or cells[name].run_as not in compared]
    drawn = [name for name in names if name != NONE] or names
    n_rows = math.ceil(len(drawn) / _PANELS_IN_A_ROW)
    figure = figure_of(12.4, 1.6 + 1.7 * max(2, n_rows))
    figure.suptitle(f"{pair.name}: {pair.budget} (grey: no transfer)")
    of_curves, of_performance = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.2, 1.0))[0]
    if names:
        panels = of_curves.subplots(n_rows, _PANELS_IN_A_ROW, sharex=True, sharey=True, squeeze=False).ravel()
        _draw_curves(panels, {name: _curve_of(pair, cells[name]) for name in names}, drawn)
        of_curves.supxlabel("episode" if pair.n_steps is None else "environment steps", fontsize="medium")
        of_curves.supylabel(f"return (mean of {WINDOW} episodes)", fontsize="medium")
        _draw_performance(of_performance.subplots(), pair, {name: compared[name] for name in names})
    else:
        of_curves.text(0.5, 0.5, "no run has succeeded", ha="center")
    return save(figure, path)


def _draw_curves(panels: Sequence[Any], curves: Mapping[str, _Curve], drawn: Sequence[str]) -> None:
    """A panel for each method that is ``drawn``, with no transfer's curve behind its own."""
    for panel, name in zip(panels, drawn, strict=False):
        panel.set_title(f"{name} ({curves[name].n_runs})", fontsize="small")
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize="small")
        for each in dict.fromkeys((NONE, name)):
            if each not in curves:
                continue
            where, band, n_runs = curves[each]
            colour = _COLOUR_NONE if each == NONE else _COLOUR
            panel.plot(where, band.mean, color=colour, linewidth=1.2)
            if n_runs >= FEWEST_RUNS:
                panel.fill_between(where, band.low, band.high, color=colour, alpha=0.2, linewidth=0)
    for empty in panels[len(drawn) :]:
        empty.set_visible(False)
    # Of each column the last, which need not be in the last row.
    for panel in panels[max(0, len(drawn) - _PANELS_IN_A_ROW) : len(drawn)]:
        panel.tick_params(labelbottom=True)


def _draw_performance(axes: Any, pair: Pair, compared: Mapping[str, MethodScores]) -> None:
    """The performance of each method with its interval; a line at that of no transfer."""
    names = list(compared)[::-1]
    for place, name in enumerate(names):
        estimate, differs = compared[name].estimate, compared[name].p_value < ALPHA
        colour = _COLOUR_NONE if name == NONE else _COLOUR
        if np.isfinite(estimate.low):
            axes.plot([estimate.low, estimate.high], [place, place], "-", color=colour)
        axes.plot([estimate.mean], [place], "o", color=colour, markerfacecolor=colour if differs else "white")
    if NONE in compared:
        axes.axvline(float(compared[NONE].estimate.mean), color=_COLOUR_NONE, linewidth=0.8, linestyle="--", zorder=0)
    axes.set_yticks(range(len(names)), names)
    over = "" if pair.n_steps is None else ", over steps"
    axes.set_xlabel(f"mean return{over}\n(full: differs from none)")
    axes.grid(alpha=0.3, axis="x")


class _Curve(NamedTuple):
    """Where a curve has points, its values with their band, and the number of runs."""

    where: np.ndarray
    band: Estimate
    n_runs: int


def _curve_of(pair: Pair, cell: Cell) -> _Curve:
    curves = curves_of(cell.outcomes)
    where, values = _by_episodes(curves) if pair.n_steps is None else _by_steps(curves)
    return _Curve(where, bootstrap_band(values, "iqm"), len(values))


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
