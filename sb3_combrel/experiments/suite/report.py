"""Tables of the suite: each task and variant, with tests against a reference variant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.comparison.statistics import holm, p_value_of_difference
from sb3_combrel.comparison.tables import Table
from sb3_combrel.experiments.suite.runs import WITH_STATE, WITHOUT_STATE
from sb3_combrel.experiments.suite.tasks import Task

#: Prefixes of the columns of evaluation, see :mod:`~sb3_combrel.experiments.suite.runs`.
POLICIES = (WITH_STATE, WITHOUT_STATE)
#: Columns of every task besides its own measures, with whether more is better.
COMMON = {
    "ms_per_step": False,
    "last10_return": True,
    "last10_failed": False,
    **{
        f"{policy}_{column}": better
        for policy in POLICIES
        for column, better in (("mean", True), ("worst", True), ("failures", False), ("as_good", True))
    },
}
COLUMNS_OF_ALL = tuple(COMMON)
#: Not tested: it depends on the machine.
UNTESTED = ("ms_per_step",)


class Cell(NamedTuple):
    """
    One column of the runs of one task and variant.

    :param values: one for each seed; NaN and inf where a run has no value or never reached a limit
    :param higher_is_better: whether more is better
    :param p_value: against the reference variant, by Holm's correction; NaN without a test
    """

    values: np.ndarray
    higher_is_better: bool
    p_value: float

    def mean(self) -> str:
        """Mean and its standard error; where runs never reached a limit, how many did."""
        finite = np.isfinite(self.values)
        if not finite.all():
            return f"{finite.sum()} of {len(self.values)} reached it"
        error = self.values.std(ddof=1) / np.sqrt(len(self.values)) if len(self.values) > 1 else np.nan
        return format_number(self.values.mean()) + ("" if np.isnan(error) else f" ± {format_number(error)}")

    def median(self) -> str:
        """Median over the seeds."""
        return format_number(float(np.median(self.values)))

    def worst(self) -> str:
        """The worst seed."""
        return format_number(float(self.values.min() if self.higher_is_better else self.values.max()))


def columns_of(task: Task) -> dict[str, bool]:
    """The columns of a task that tables show, with whether more is better."""
    own = {measure.name: measure.higher_is_better for measure in task.measures}
    return own | COMMON


def cells_of(
    rows: Sequence[dict[str, Any]], tasks: Sequence[Task], variants: Sequence[str], reference: str | None, test: str
) -> dict[tuple[str, str, str], Cell]:
    """
    Gather the values of all columns, and test the variants against a reference.

    :param rows: the ``row`` of each run
    :param tasks: the tasks
    :param variants: names of the variants
    :param reference: the variant that the others are compared with; None for no tests
    :param test: ``"welch"`` or ``"mann-whitney"``, see :func:`~sb3_combrel.comparison.statistics.p_value_of_difference`
    :return: by task, column and variant; only where there are runs. Holm's correction is over all tests of one column name
        of a task.
    """
    cells: dict[tuple[str, str, str], Cell] = {}
    for task in tasks:
        for column, better in columns_of(task).items():
            values = {
                variant: _values(rows, task.name, variant, column)
                for variant in variants
                if any(row["task"] == task.name and row["variant"] == variant for row in rows)
            }
            p_values = _p_values(values, None if column in UNTESTED else reference, test)
            for variant, own in values.items():
                cells[task.name, column, variant] = Cell(own, better, p_values.get(variant, np.nan))
    return cells


def overview_table(cells: dict[tuple[str, str, str], Cell], tasks: Sequence[Task], variants: Sequence[str]) -> Table:
    """Make a table with a row for each task and a column for each variant: mean and standard error of the task's headline."""
    rows = []
    for task in tasks:
        found = [cells.get((task.name, task.headline, variant)) for variant in variants]
        rows.append((task.name, task.headline, *("" if cell is None else cell.mean() + _mark(cell) for cell in found)))
    title = "Mean over the seeds and its standard error (*: p < 0.05 against the reference, by Holm's correction)"
    return Table(title, ("task", "measure", *variants), rows)


def frozen_table(cells: dict[tuple[str, str, str], Cell], tasks: Sequence[Task], variants: Sequence[str]) -> Table:
    """Make a table with a row for each task and variant: how good the frozen policy is, compared with the learning agent."""
    rows = []
    for task in tasks:
        for variant in variants:
            if (task.name, COLUMNS_OF_ALL[0], variant) not in cells:
                continue
            own = {column: cells[task.name, column, variant] for column in COLUMNS_OF_ALL}
            row = [task.name, variant, own["last10_return"].mean()]
            for policy in POLICIES:
                n_good, n_seeds = np.nansum(own[f"{policy}_as_good"].values), len(own[f"{policy}_as_good"].values)
                row += [own[f"{policy}_mean"].mean(), own[f"{policy}_worst"].worst(), f"{n_good:.0f} of {n_seeds}"]
            stuck = np.sum(own["last10_failed"].values == 1.0)
            rows.append((*row, f"{stuck:.0f}", own["ms_per_step"].mean()))
    header = ("task", "variant", "last 10 of learning", "greedy", "worst", "as good", "without state", "worst", "as good")
    title = (
        "Returns of the frozen policy; as good: no failure and at most 5% below the last 10 episodes of learning; "
        "stuck: runs whose last 10 episodes of learning all failed"
    )
    return Table(title, (*header, "stuck", "ms a step"), rows)


def task_table(cells: dict[tuple[str, str, str], Cell], task: Task, variants: Sequence[str], compared: str) -> Table:
    """
    Make the table of a task: a row for each column of the runs and variant.

    :param compared: what p is, for its column's name
    """
    rows = []
    for column in columns_of(task):
        for variant in variants:
            cell = cells.get((task.name, column, variant))
            if cell is not None:
                p_value = "" if np.isnan(cell.p_value) else f"{cell.p_value:.2g}"
                rows.append((column, variant, str(len(cell.values)), cell.mean(), cell.median(), cell.worst(), p_value))
    header = ("measure", "variant", "seeds", "mean ± standard error", "median", "worst", compared)
    return Table(task.name, header, rows)


def format_number(value: float) -> str:
    """Write a number with about four digits."""
    if not np.isfinite(value):
        return "never" if value > 0 else "-"
    size = abs(value)
    return f"{value:,.0f}" if size >= 1000 else f"{value:.1f}" if size >= 10 else f"{value:.2f}"


def _values(rows: Sequence[dict[str, Any]], task: str, variant: str, column: str) -> np.ndarray:
    own = [row for row in rows if row["task"] == task and row["variant"] == variant]
    return np.array([row.get(column, np.nan) for row in own], dtype=np.float64)


def _p_values(values: dict[str, np.ndarray], reference: str | None, test: str) -> dict[str, float]:
    if reference is None or reference not in values:
        return {}
    others = [variant for variant in values if variant != reference]
    return holm({variant: p_value_of_difference(values[reference], values[variant], test) for variant in others})


def _mark(cell: Cell) -> str:
    return " *" if cell.p_value < 0.05 else ""
