"""What a comparison of methods has found: measures, p-values, a sentence, a table and a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_combrel.comparison.curves import LearningCurves, curves_of, returns_over_steps
from sb3_combrel.comparison.measures import (
    WINDOW,
    Comparison,
    TransferMeasures,
    asymptotic_return,
    compare_learning,
    counts_within,
)
from sb3_combrel.comparison.statistics import ALPHA, bootstrap_band, fewest_runs, holm, smallest_p_value
from sb3_combrel.comparison.tables import markdown_table
from sb3_combrel.runs.job import Result
from sb3_combrel.transfer.report import TransferReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A curve of the picture has so many points.
N_POINTS = 200


@dataclass(frozen=True, eq=False)
class CompareResult:
    """Learning with several methods of transfer, and without; ``print`` it for the sentence and the table.

    :param curves: for each method its runs, by the order of the seeds
    :param baseline: name of the method that all others are compared with
    :param measures: for each other method Taylor & Stone's measures against the baseline
    :param p_values: for each other method, of the return averaged over environment steps, corrected by Holm's method if there
        are several
    :param threshold: the return of the time to threshold
    :param n_steps: environment steps that returns are averaged over: those of the shortest run, complete episodes only
    :param reports: for each method with transfer what it did in each run
    """

    curves: Mapping[str, LearningCurves]
    baseline: str
    measures: Mapping[str, TransferMeasures]
    p_values: Mapping[str, float]
    threshold: float
    n_steps: int
    reports: Mapping[str, tuple[TransferReport, ...]]

    @property
    def sentence(self) -> str:
        """Whether transfer helped, in one plain sentence for each method."""
        return " ".join(self._sentence(method) for method in self.measures)

    @property
    def table(self) -> str:
        """Taylor & Stone's measures, as Markdown."""
        header = ("measure", "method", self.baseline, "with", "difference", "95% interval", "p")
        return markdown_table(header, [row for method in self.measures for row in self._rows(method)], n_names=2)

    def figure(self) -> Figure:
        """Draw the learning curves: return over environment steps, mean of the runs with 95% bootstrap bands.

        :return: a figure of its own, which pyplot does not know: save it with ``figure.savefig("curves.png")``
        """
        # Matplotlib takes a moment to import.
        from sb3_combrel.comparison.figures import COLOURS, draw_band, figure_of

        figure = figure_of(7.0, 4.2)
        axes = figure.add_subplot()
        at = np.linspace(0.0, self.n_steps, N_POINTS, endpoint=False)
        for k, (method, curves) in enumerate(self.curves.items()):
            band = bootstrap_band(returns_over_steps(curves, at), n_resamples=500)
            draw_band(axes, at, band, COLOURS[k % len(COLOURS)], label=f"{method} ({len(curves.returns)} runs)")
        axes.set_xlabel("environment steps")
        axes.set_ylabel("return of the episode")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
        return figure

    def __str__(self) -> str:
        return f"{self.sentence}\n\n{self.table}"

    def _sentence(self, method: str) -> str:
        measure, p_value = self.measures[method].total_reward_by_steps, self.p_values[method]
        with_it, without = (float(runs.mean()) / self.n_steps for runs in (measure.with_transfer, measure.without))
        figures = f"its mean return over {self.n_steps:,} steps is {with_it:.4g}, that of {self.baseline} {without:.4g}"
        smallest = smallest_p_value(len(measure.with_transfer), len(measure.without), len(self.measures))
        if not smallest < ALPHA:
            advice = f"take at least {fewest_runs(len(self.measures))} seeds, better 10."
            return f"{method}: too few runs to tell ({figures}); so many runs cannot show a difference, {advice}"
        tested = f"{figures} (p = {p_value:.2g})"
        if p_value >= ALPHA:
            return f"{method}: it is not shown that transfer helps or harms: {tested}."
        return f"{method}: transfer {'helped' if measure.effect > 0.0 else 'harmed'}: {tested}."

    def _rows(self, method: str) -> Iterator[tuple[str, ...]]:
        measures = self.measures[method]
        listed: list[tuple[str, Comparison | None, Callable[[np.ndarray], np.floating[Any]], float]] = [
            ("jumpstart", measures.jumpstart, np.mean, 1.0),
            ("asymptotic performance", measures.asymptotic_performance, np.mean, 1.0),
            ("mean return over steps", measures.total_reward_by_steps, np.mean, 1.0 / self.n_steps),
            ("transfer ratio, over steps", measures.transfer_ratio_by_steps, np.mean, 1.0),
            (f"steps to a return of {self.threshold:.4g}", measures.time_to_threshold, np.median, 1.0),
        ]
        for name, measure, average, scale in listed:
            if measure is None:
                continue
            is_ratio = name.startswith("transfer ratio")
            sides = ("", "") if is_ratio else tuple(f"{average(runs) * scale:.4g}" for runs in (measure[1], measure[0]))
            interval = f"{measure.low * scale:.3g} to {measure.high * scale:.3g}" if np.isfinite(measure.low) else ""
            p_value = f"{measure.p_value:.2g}" if np.isfinite(measure.p_value) else ""
            yield name, method, *sides, f"{measure.effect * scale:+.3g}", interval, p_value


def evaluate(results: Mapping[str, Sequence[Result]], baseline: str, threshold: float | None) -> CompareResult:
    """Compare methods with one of them, the baseline, given the runs of each by the order of the seeds."""
    curves = {method: curves_of(runs) for method, runs in results.items()}
    shortest = min(int(each.n_episodes.min()) for each in curves.values())
    counts = counts_within(shortest)
    if threshold is None:
        threshold = float(np.median(asymptotic_return(curves[baseline], counts["n_last"])))
    # All comparisons are of the same number of steps, so that their figures can be compared.
    n_steps = min(int(each.n_steps.min()) for each in curves.values())
    measures = {
        method: compare_learning(
            each, curves[baseline], threshold=threshold, **counts, window=min(WINDOW, shortest), n_steps=n_steps
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
    )


def _reports(runs: Sequence[Result]) -> tuple[TransferReport, ...]:
    return tuple(run.more["report"] for run in runs if run.more["report"] is not None)
