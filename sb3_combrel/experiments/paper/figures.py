"""Figures 2 to 6: learning curves, training needed to reach a threshold, selections; diagnosis and baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_combrel.comparison.curves import moving_average
from sb3_combrel.comparison.figures import COLOURS, draw_band, panels_of, readable_ticks, save
from sb3_combrel.comparison.measures import steps_to_reach
from sb3_combrel.comparison.statistics import bootstrap_band
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baselines import ALGORITHMS
from sb3_combrel.experiments.paper.domains import DOMAINS, Domain
from sb3_combrel.experiments.paper.jobs import BREADTHS, DIAGNOSED_METHODS, method_at
from sb3_combrel.runs.job import Result

#: Moving average, and the median for thresholds, over so many episodes.
WINDOW = 5
_GREY, _BLUE, _VERMILLION, _GREEN, _PURPLE, _SKY, _ORANGE = COLOURS
#: Colour and line of each method, the same in all figures; controls have no solid line.
STYLES = {m.NO_TRANSFER: (_GREY, "-"), m.TIMBREL_INTUITIVE: (_BLUE, "-"), m.COMBREL_PLAIN: (_VERMILLION, "-")}
STYLES |= {m.COMBREL_RELEVANCE: (_ORANGE, "-"), m.TIMBREL_RELEVANCE: (_SKY, "-"), m.COMBREL_WHOLE: (_GREEN, "-")}
STYLES |= {m.TIMBREL_RANDOM: (_PURPLE, "-"), m.ONE_RANDOM: (_PURPLE, "--"), m.TIMBREL_FREQUENT: (_BLUE, "-")}
STYLES |= {m.ORACLE: (_GREEN, "--"), m.UNRELATED: ("black", ":"), m.NO_TRANSFER_BEST: (_GREY, "--")}
STYLES |= dict(zip(ALGORITHMS, ((_SKY, "-"), (_ORANGE, "-"), (_PURPLE, "-"), (_PURPLE, "--")), strict=True))
_BELOW: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.15)}


def draw_curves(panels: Mapping[str, Mapping[str, np.ndarray]], domain: Domain, title: str, path: Path) -> list[Path]:
    """Draw learning curves: by panel and method means over runs, shape (n_runs, n_episodes), of moving averages, 95% bands."""
    figure, all_axes = panels_of(len(panels), title)
    for axes, (name, steps) in zip(all_axes, panels.items(), strict=True):
        for method, samples in steps.items():
            smooth = moving_average(samples, WINDOW)
            episodes = np.arange(samples.shape[1] - smooth.shape[1] + 1, samples.shape[1] + 1)
            draw_band(axes, episodes, bootstrap_band(smooth), *STYLES[method], f"{method} ({len(samples)} runs)")
        # The methods differ in the first tenth of the episodes.
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        readable_ticks(axes.yaxis)
        _label(axes, name, "episode")
    all_axes[0].set_ylabel(f"{domain.unit} (mean of {WINDOW} episodes)")
    return save(figure, path)


def draw_times(panels: Mapping[str, Mapping[str, np.ndarray]], domain: Domain, title: str, path: Path) -> list[Path]:
    """Draw the median steps until the last episodes' median reaches a threshold, with 95% bands; no point if never."""
    figure, all_axes = panels_of(len(panels), title)
    places = np.arange(len(domain.thresholds))
    anything = False
    for axes, (name, steps) in zip(all_axes, panels.items(), strict=True):
        for method, samples in steps.items():
            needed = np.array([steps_to_reach(samples, threshold, WINDOW) for threshold in domain.thresholds]).T
            median, low, high = bootstrap_band(needed, "median")
            reached = np.isfinite(median)
            band = median[reached], low[reached], high[reached]
            draw_band(axes, places[reached], band, *STYLES[method], method, marker="o", markersize=4)
            anything = anything or bool(reached.any())
        axes.set_xticks(places, [str(threshold) for threshold in domain.thresholds])
        _label(axes, name, f"threshold: {domain.unit} an episode (median of {WINDOW})")
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
    """Draw by title (points, shape (n, 2), place of source action in the names or -1, names) in two variables: Figure 4."""
    figure, all_axes = panels_of(len(panels), title, sharey=False)
    for axes, (name, (points, action, names)), (below, beside) in zip(all_axes, panels.items(), labels, strict=True):
        for k, (label, marker) in enumerate(zip(("nothing", *names), (".", "<", "o", ">", "^", "v"), strict=False), start=-1):
            here = action == k
            if here.any():
                colour = "#BBBBBB" if k < 0 else COLOURS[1 + k]
                axes.scatter(*points[here].T, color=colour, marker=marker, s=8 if k < 0 else 60, label=label)
        _label(axes, name, below, ncols=4, **_BELOW)
        axes.set_ylabel(beside)
    return save(figure, path)


def draw_diagnosis(steps: Mapping[str, np.ndarray], domain: Domain, path: Path) -> list[Path]:
    """Draw the steps of all episodes against the breadth, mean of the runs with 95% bootstrap intervals."""
    figure, (axes,) = panels_of(1, f"{domain.title}: what transfer can save depends on the learner's kernel")
    for method, colour in zip(DIAGNOSED_METHODS, COLOURS, strict=False):
        # Shape (n_runs, n_breadths).
        totals = np.stack([steps[method_at(method, breadth)].sum(axis=1) for breadth in BREADTHS], axis=1)
        mean, low, high = bootstrap_band(totals)
        errors: Any = np.maximum([mean - low, high - mean], 0.0)
        axes.errorbar(BREADTHS, mean, errors, color=colour, marker="o", capsize=3, label=method)
    axes.set_yscale("log")
    readable_ticks(axes.yaxis)
    _label(axes, "", "model_breadth")
    n_episodes = steps[method_at(DIAGNOSED_METHODS[0], BREADTHS[0])].shape[1]
    axes.set_ylabel(f"{domain.unit} in {n_episodes} episodes")
    return save(figure, path)


def draw_baselines(results: Mapping[str, Sequence[Result]], methods: Sequence[str], title: str, path: Path) -> list[Path]:
    """Draw returns against steps, log axis: greedy baselines, mean and range; methods while learning, mean and 95% bands."""
    figure, all_axes = panels_of(len(results), title, sharey=False)
    for axes, (domain, of_domain) in zip(all_axes, results.items(), strict=True):
        for name in (*methods, *ALGORITHMS):
            runs = [result for result in of_domain if result.method == name]
            if runs:
                where, band, kind = _returns_of(runs)
                draw_band(axes, where, band, *STYLES[name], f"{name}, {kind} ({len(runs)} runs)")
        axes.set_xscale("log")
        _label(axes, DOMAINS[domain].title, "environment steps", ncols=2, **_BELOW)
    all_axes[0].set_ylabel("return of an episode")
    return save(figure, path)


def _returns_of(runs: Sequence[Result], n_points: int = 60) -> tuple[np.ndarray, Any, str]:
    """Numbers of steps, returns there with the ends of their band, and what they are of: greedy policy or learning."""
    if "evaluations" in runs[0].more:
        # Those that all runs have: with a filled buffer they begin later.
        by_run = [{int(n): mean for n, mean, _ in run.more["evaluations"]} for run in runs]
        where = sorted(set.intersection(*map(set, by_run)))
        returns = np.array([[of_run[n] for n in where] for of_run in by_run])
        return np.array(where), (returns.mean(axis=0), returns.min(axis=0), returns.max(axis=0)), "greedy"
    ends = [np.cumsum(run.steps) for run in runs]
    steps = np.geomspace(max(each[0] for each in ends), min(each[-1] for each in ends), n_points)
    # Of the episode that ends next.
    at = [np.minimum(np.searchsorted(each, steps), len(each) - 1) for each in ends]
    returns = np.array([np.array(run.returns)[places] for run, places in zip(runs, at, strict=True)])
    return steps, bootstrap_band(returns), "learning"


def _label(axes: Any, title: str, below: str, **legend: Any) -> None:
    axes.set_title(title, fontsize="medium")
    axes.set_xlabel(below)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize="small", **legend)
