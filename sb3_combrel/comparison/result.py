"""What a comparison of methods has found: measures, p-values, a sentence, a table and a picture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_combrel.common.files import check_folder
from sb3_combrel.comparison.controls import CONTROL
from sb3_combrel.comparison.curves import LearningCurves, curves_of, returns_over_steps
from sb3_combrel.comparison.measure_table import measure_table, p_value_text
from sb3_combrel.comparison.measures import (
    WINDOW,
    TransferMeasures,
    asymptotic_return,
    compare_learning,
    counts_within,
)
from sb3_combrel.comparison.statistics import (
    ALPHA,
    bootstrap_band,
    fewest_runs,
    holm,
    p_value_of_difference,
    smallest_p_value,
)
from sb3_combrel.comparison.tables import markdown_table
from sb3_combrel.pages.palette import method_colours
from sb3_combrel.pages.plane import VariablePair
from sb3_combrel.pages.snapshot import Snapshot
from sb3_combrel.runs.job import Result
from sb3_combrel.transfer.report import TransferReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: With fewer there is a warning.
FEWEST_SEEDS, FEWEST_EPISODES = 5, 10
#: A curve of the picture has so many points.
N_POINTS = 200


@dataclass(frozen=True, eq=False)
class CompareResult:
    """Learning with several methods of transfer, and without; ``print`` it for the sentence and the table.

    :param curves: for each method its runs, by the order of the seeds
    :param baseline: name of the method that all others are compared with
    :param measures: for each other method Taylor & Stone's measures against the baseline
    :param p_values: for each other method, of the return averaged over environment steps, corrected for their number by Holm's
        method
    :param threshold: the return of the time to threshold
    :param n_steps: environment steps that returns are averaged over: those of the shortest run, complete episodes only
    :param reports: for each method with transfer what it did in each run
    :param snapshots: for each method values, policy and bound after the run of the first seed
    :param task: what the task is called
    :param warnings: why the figures may say little: few runs, few episodes
    :param control: which method, if it is one of them, is a mapping drawn at random
    """

    curves: Mapping[str, LearningCurves]
    baseline: str
    measures: Mapping[str, TransferMeasures]
    p_values: Mapping[str, float]
    threshold: float
    n_steps: int
    reports: Mapping[str, tuple[TransferReport, ...]]
    snapshots: Mapping[str, Snapshot]
    task: str = "the task"
    warnings: tuple[str, ...] = ()
    control: str = CONTROL

    @property
    def sentence(self) -> str:
        """Whether transfer helped, in one plain sentence for each method; or which is better, if the baseline transfers."""
        return " ".join(self.sentences.values())

    @property
    def table(self) -> str:
        """Taylor & Stone's measures, as Markdown, with raw p-values and those corrected by Holm's method."""
        return markdown_table(*self.rows, n_names=2, aligned=True)

    @property
    def rows(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """The header and the rows of :attr:`table`."""
        return measure_table(self.measures, self.baseline, self.n_steps, self.threshold)

    def save(self, path: str | os.PathLike[str], variables: Sequence[VariablePair] | None = None) -> Path:
        """Write a page to look at: one HTML file with sentence, curves, tables, mappings, evidence, values and contradictions.

        :param path: of the file, which ends in .html
        :param variables: pairs of state variables, by number or name, over which values are drawn; None for a variable beside
            its own velocity, told by their names, or else the first two
        :return: the path
        :raises ValueError: if the path ends in something else, or variables do not fit the task
        :raises OSError: if the file cannot be written
        """
        from sb3_combrel.comparison.compare_page import compare_page

        file = Path(path)
        if file.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        check_folder("path", file.parent)
        compare_page(self, variables).write(file)
        return file

    def figure(self, width: float = 7.0) -> Figure:
        """Draw the learning curves: return over environment steps, mean of the runs with 95% bootstrap bands.

        :param width: in inches
        :return: a figure of its own, which pyplot does not know: save it with ``figure.savefig("curves.png")``
        """
        # Matplotlib takes a moment to import.
        from sb3_combrel.comparison.figures import draw_band, figure_of

        figure = figure_of(width, 4.2)
        axes = figure.add_subplot()
        at = np.linspace(0.0, self.n_steps, N_POINTS, endpoint=False)
        colours = method_colours(self.curves, self.baseline)
        for method, curves in self.curves.items():
            band = bootstrap_band(returns_over_steps(curves, at), n_resamples=500)
            draw_band(axes, at, band, colours[method], label=f"{method} ({len(curves.returns)} runs)")
        axes.set_xlabel("environment steps")
        axes.set_ylabel("return of the episode")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
        return figure

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        return "\n\n".join([self.sentence, *self.warnings, self.table])

    @property
    def sentences(self) -> dict[str, str]:
        """Whether transfer helped, in one sentence for each method but the baseline."""
        return {method: self._sentence(method) for method in self.measures}

    def _sentence(self, method: str) -> str:
        measure, p_value = self.measures[method].total_reward_by_steps, self.p_values[method]
        with_it, without = (float(runs.mean()) / self.n_steps for runs in (measure.with_transfer, measure.without))
        figures = f"its mean return over {self.n_steps:,} steps is {with_it:.4g}, that of {self.baseline} {without:.4g}"
        smallest = smallest_p_value(len(measure.with_transfer), len(measure.without), len(self.measures))
        if not smallest < ALPHA:
            advice = f"take at least {fewest_runs(len(self.measures))} seeds, better 10."
            return f"{method}: too few runs to tell ({figures}), {advice}"
        number = f"{len(self.measures)} comparison{'s' if len(self.measures) > 1 else ''}"
        tested = f"{figures} (p = {p_value_text(p_value)}, by Holm's correction for {number})"
        helps = measure.effect > 0.0
        if self.baseline in self.reports:  # it transfers, too
            unclear = f"it is not shown to be better or worse than {self.baseline}"
            clear = f"it is {'better' if helps else 'worse'} than {self.baseline}"
        else:
            unclear, clear = "it is not shown that transfer helps or harms", f"transfer {'helped' if helps else 'harmed'}"
        if p_value >= ALPHA:
            return f"{method}: {unclear}: {tested}."
        return f"{method}: {clear}: {tested}.{self._of_control(method, with_it) if helps else ''}"

    def _of_control(self, method: str, with_it: float) -> str:
        """Say if it is not shown that it does better than a mapping drawn at random."""
        control = self.control
        if (
            method == control
            or control not in self.measures
            or not any(each.mappings for each in self.reports.get(method, ()))
        ):
            return ""
        runs, others = (self.measures[each].total_reward_by_steps.with_transfer for each in (method, control))
        mean, p_value = float(others.mean()) / self.n_steps, p_value_of_difference(runs, others, "permutation")
        if mean < with_it and p_value < ALPHA:
            return ""
        compared = f"{mean:.4g}, p = {p_value_text(p_value)}"
        return f" But it is not shown to be better than {control} ({compared}): it may not be the mapping that helps."


def evaluate(
    results: Mapping[str, Sequence[Result]],
    baseline: str,
    threshold: float | None,
    task: str = "the task",
    control: str = CONTROL,
) -> CompareResult:
    """Compare methods with one of them, the baseline, given the runs of each by the order of the seeds."""
    curves = {method: curves_of(runs) for method, runs in results.items()}
    shortest = min(int(each.n_episodes.min()) for each in curves.values())
    counts = counts_within(shortest)
    if threshold is None:
        threshold = float(np.median(asymptotic_return(curves[baseline], counts["n_last"])))
    # All comparisons are of the same number of steps, and above the same floor, so that their figures can be compared.
    n_steps = min(int(each.n_steps.min()) for each in curves.values())
    floor = min(0.0, *(float(np.nanmin(each.returns)) for each in curves.values()))
    window = min(WINDOW, shortest)
    measures = {
        method: compare_learning(
            each, curves[baseline], threshold=threshold, **counts, window=window, floor=floor, n_steps=n_steps
        )
        for method, each in curves.items()
        if method != baseline
    }
    return CompareResult(
        curves=curves,
        baseline=baseline,
        measures=measures,
        p_values=holm({method: each.total_reward_by_steps.p_value for method, each in measures.items()}),
        threshold=threshold,
        n_steps=n_steps,
        reports={method: reports for method, runs in results.items() if (reports := _reports(runs))},
        snapshots={method: shown for method, runs in results.items() if (shown := runs[0].more.get("snapshot")) is not None},
        task=task,
        control=control,
        warnings=few_data(len(next(iter(results.values()))), shortest),
    )


def few_data(n_seeds: int, n_episodes: int) -> tuple[str, ...]:
    """Warn of few runs, and of few episodes in the shortest of them."""
    found = []
    if n_seeds < FEWEST_SEEDS:
        number = f"{n_seeds} seed{'s' if n_seeds > 1 else ''}"
        found.append(f"Only {number}: runs differ more than methods. Take at least {FEWEST_SEEDS}, better 10.")
    if n_episodes < FEWEST_EPISODES:
        number = f"{n_episodes} episode{'s' if n_episodes > 1 else ''}"
        found.append(f"The shortest run has only {number}: start and end of learning overlap. Take more steps.")
    return tuple(found)


def _reports(runs: Sequence[Result]) -> tuple[TransferReport, ...]:
    return tuple(run.more["report"] for run in runs if run.more["report"] is not None)
