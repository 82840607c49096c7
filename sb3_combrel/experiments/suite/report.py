"""Tables of the suite: each task and variant, with tests against a reference variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_combrel.comparison.statistics import (
    bootstrap_difference,
    bootstrap_relative_difference,
    holm,
    p_value_of_difference,
)
from sb3_combrel.comparison.tables import Table, share_text
from sb3_combrel.experiments.suite.tasks import Task

#: Not tested: it depends on the machine.
UNTESTED = "ms_per_step"
#: Columns of every task besides its own measures, with whether more is better.
COMMON = {
    **{UNTESTED: False, "last10_return": True, "last10_failed": False},
    **{"greedy_mean": True, "greedy_worst": True, "greedy_failures": False, "greedy_as_good": True},
}


class Cell(NamedTuple):
    """One column of the runs of one task and variant."""

    values: np.ndarray  # one for each seed; NaN and inf where a run has no value or never reached a limit
    higher_is_better: bool  # whether more is better
    p_value: float  # against the reference variant, by Holm's correction; NaN without a test

    def mean(self) -> str:
        """Mean and its standard error; where runs never reached a limit, how many did."""
        finite = np.isfinite(self.values)
        if not finite.all():
            return f"{finite.sum()} of {len(self.values)} reached it"
        error = "" if len(self.values) < 2 else f" ± {format_number(pd.Series(self.values).sem())}"
        return format_number(self.values.mean()) + error

    def worst(self) -> str:
        """The worst seed."""
        return format_number(float(self.values.min() if self.higher_is_better else self.values.max()))


#: By task, column and variant; only where there are runs.
Cells = Mapping[tuple[str, str, str], Cell]


def columns_of(task: Task) -> dict[str, bool]:
    """The columns of a task that tables show, with whether more is better."""
    return {measure.name: measure.higher_is_better for measure in task.measures} | COMMON


def cells_of(
    rows: Sequence[dict[str, Any]], tasks: Sequence[Task], variants: Sequence[str], reference: str | None, test: str
) -> Cells:
    """Gather the values of all columns, and test variants against a reference, if any; Holm's correction is over a column."""
    runs = {key: own for key, own in pd.DataFrame(rows).groupby(["task", "variant"])}
    cells = {}
    for task in tasks:
        own = {variant: runs[task.name, variant] for variant in variants if (task.name, variant) in runs}
        for column, better in columns_of(task).items():
            values = {name: np.array(frame.get(column, [np.nan] * len(frame)), float) for name, frame in own.items()}
            tested = reference in values and column != UNTESTED
            others = [name for name in values if tested and name != reference]
            p_values = holm({name: p_value_of_difference(values[str(reference)], values[name], test) for name in others})
            for name, its_own in values.items():
                cells[task.name, column, name] = Cell(its_own, better, p_values.get(name, np.nan))
    return cells


def headline_table(cells: Cells, tasks: Sequence[Task], variants: Sequence[str], reference: str) -> Table:
    """Make a table with a row for each task and variant: the task's headline, and what it gains over the reference variant."""
    alone = len(variants) == 1
    rows = []
    for task in tasks:
        of_reference = cells.get((task.name, task.headline, reference))
        for variant in variants:
            cell = cells.get((task.name, task.headline, variant))
            if cell is None:
                continue
            row: tuple[str, ...] = (
                str(len(cell.values)),
                cell.mean(),
                format_number(float(np.median(cell.values))),
                cell.worst(),
            )
            if not alone:
                gain = "" if variant == reference or of_reference is None else gain_text(cell, of_reference)
                row = (*row, gain, "" if np.isnan(cell.p_value) else f"{cell.p_value:.2g}")
            rows.append((task.name, task.headline, *(() if alone else (variant,)), *row))
    compared = () if alone else (f"better than {reference} by", "p")
    names = ("task", "measure") if alone else ("task", "measure", "variant")
    title = "Mean over the seeds ± its standard error" + ("" if alone else "; 95% intervals; p by Holm's correction")
    return Table(title, (*names, "seeds", "mean", "median", "worst", *compared), rows)


def gain_text(cell: Cell, reference: Cell) -> str:
    """By how much the mean is better than the reference's, with a bootstrap interval: of steps in parts of the reference's."""
    sign = 1.0 if cell.higher_is_better else -1.0
    if not (np.isfinite(cell.values).all() and np.isfinite(reference.values).all()):
        return "-"
    if cell.higher_is_better or min(cell.values.min(), reference.values.min()) < 0.0:
        found = bootstrap_difference(cell.values, reference.values)
        value, low, high = (format_number(sign * each) for each in found)
    else:
        found = bootstrap_relative_difference(cell.values, reference.values)
        value, low, high = (share_text(sign * each) if np.isfinite(each) else "-" for each in found)
    return f"{value} ({low} to {high})" if sign > 0.0 else f"{value} ({high} to {low})"


def frozen_table(cells: Cells, tasks: Sequence[Task], variants: Sequence[str]) -> Table:
    """Make a table with a row for each task and variant: how good the frozen policy is, compared with the learning agent."""
    rows = []
    for task in tasks:
        for variant in variants:
            if (task.name, UNTESTED, variant) not in cells:
                continue
            own = {column: cells[task.name, column, variant] for column in COMMON}
            good, stuck = own["greedy_as_good"].values, np.sum(own["last10_failed"].values == 1.0)
            greedy = own["greedy_mean"].mean(), own["greedy_worst"].worst(), f"{np.nansum(good):.0f} of {len(good)}"
            rows.append((task.name, variant, own["last10_return"].mean(), *greedy, f"{stuck:.0f}", own[UNTESTED].mean()))
    header = ("task", "variant", "last 10 of learning", "greedy", "worst", "as good")
    as_good = "as good: no failure and at most 5% below the last 10 episodes of learning"
    title = f"Returns of the frozen policy; {as_good}; stuck: runs whose last 10 episodes of learning all failed"
    return Table(title, (*header, "stuck", "ms a step"), rows)


def task_table(cells: Cells, task: Task, variants: Sequence[str], compared: str) -> Table:
    """Make the table of a task: a row for each column of the runs and variant; ``compared`` is what p is."""
    rows = []
    for column in columns_of(task):
        for variant in variants:
            cell = cells.get((task.name, column, variant))
            if cell is not None:
                p_value = "" if np.isnan(cell.p_value) else f"{cell.p_value:.2g}"
                median = format_number(float(np.median(cell.values)))
                rows.append((column, variant, str(len(cell.values)), cell.mean(), median, cell.worst(), p_value))
    header = ("measure", "variant", "seeds", "mean ± standard error", "median", "worst", compared)
    return Table(task.name, header, rows)


def format_number(value: float) -> str:
    """Write a number with about four digits."""
    if not np.isfinite(value):
        return "never" if value > 0 else "-"
    size = abs(value)
    return f"{value:,.0f}" if size >= 1000 else f"{value:.1f}" if size >= 10 else f"{value:.2f}"
