"""Why a claim does not hold where it does not: what transfer saves at different breadths of the learner's kernel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_combrel.comparison.figures import COLOURS, panels_of, readable_ticks, save
from sb3_combrel.comparison.statistics import bootstrap_band, bootstrap_relative_difference, holm, p_value_of_difference
from sb3_combrel.comparison.tables import Table, p_text
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import Domain
from sb3_combrel.experiments.paper.methods import Sources
from sb3_combrel.experiments.paper.plan import jobs_of
from sb3_combrel.experiments.paper.runs import Job
from sb3_combrel.experiments.paper.verdicts import interval_text, share_text

BREADTHS = (0.05, 0.1, 0.2, 0.3, 0.4)
METHODS = (m.NO_TRANSFER, m.COMBREL_PLAIN, m.TIMBREL_RANDOM)
#: The methods differ in the first episodes.
MOST_EPISODES = 25


def diagnosis_jobs(domain: Domain, setting: str, sources: Sources, n_runs: int, n_episodes: int) -> list[Job]:
    """
    Make the jobs: no transfer, COMBREL and random mappings at each of :data:`BREADTHS`.

    Parameters: see :func:`~sb3_combrel.experiments.paper.plan.jobs_of`; of the episodes at most :data:`MOST_EPISODES`.
    """
    jobs = jobs_of(domain, setting, METHODS, sources, n_runs, min(n_episodes, MOST_EPISODES))
    return [
        replace(
            job,
            method=method_at(job.method, breadth),
            learner={**job.learner, "model_breadth": breadth},
            records_selections=False,
        )
        for breadth in BREADTHS
        for job in jobs
    ]


def method_at(method: str, breadth: float) -> str:
    """Name of a method at a breadth."""
    return f"{method} at {breadth:g}"


def diagnosis_table(steps: Mapping[str, np.ndarray]) -> Table:
    """
    Make a table of what COMBREL and random mappings save at each breadth.

    :param steps: by method at a breadth the steps of each run's episodes, shape (n_runs, n_episodes)
    """
    rows, p_values = [], []
    for breadth in BREADTHS:
        none, combrel, random = (steps[method_at(method, breadth)].sum(axis=1).astype(float) for method in METHODS)
        savings = [bootstrap_relative_difference(each, none) for each in (combrel, random)]
        cells = [f"{share_text(-each.value)} ({interval_text(-each.high, -each.low)})" for each in savings]
        p_values.append(p_value_of_difference(combrel, random, "permutation"))
        rows.append((f"{breadth:g}", f"{none.mean():,.0f}", *cells))
    corrected = holm(np.array(p_values)).tolist()
    header = (
        "model_breadth",
        "no transfer, steps",
        "COMBREL saves",
        "random mappings save",
        "p (Holm), COMBREL against random",
    )
    n_runs, n_episodes = steps[method_at(METHODS[0], BREADTHS[0])].shape
    title = f"What transfer saves at each breadth of the learner's kernel: {n_episodes} episodes, {n_runs} runs"
    return Table(title, header, [(*row, p_text(p)) for row, p in zip(rows, corrected, strict=True)])


def draw_diagnosis(steps: Mapping[str, np.ndarray], domain: Domain, path: Path) -> list[Path]:
    """
    Draw the steps of all episodes against the breadth, mean of the runs with 95% bootstrap intervals.

    :param steps: as above
    :param domain: the domain
    :param path: file to write, without its suffix
    :return: the PNG and the SVG file
    """
    figure, (axes,) = panels_of(1, f"{domain.title}: what transfer can save depends on the learner's kernel")
    for method, colour in zip(METHODS, COLOURS, strict=False):
        bands = [bootstrap_band(steps[method_at(method, breadth)].sum(axis=1)) for breadth in BREADTHS]
        mean, low, high = (np.array([float(getattr(band, name)) for band in bands]) for name in ("mean", "low", "high"))
        errors: Any = np.maximum([mean - low, high - mean], 0.0)
        axes.errorbar(BREADTHS, mean, errors, color=colour, marker="o", capsize=3, label=method)
    axes.set_yscale("log")
    readable_ticks(axes.yaxis)
    axes.set_xlabel("model_breadth")
    n_episodes = steps[method_at(METHODS[0], BREADTHS[0])].shape[1]
    axes.set_ylabel(f"{domain.unit} in {n_episodes} episodes")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return save(figure, path)
