"""Tables of what each method takes, uses and gains, of running times (Table 5), of the diagnosis and the baselines.

They are made of results of one domain, or by domain where the table has them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from sb3_combrel.comparison.curves import curves_of
from sb3_combrel.comparison.measures import compare_learning, counts_within, steps_to_reach
from sb3_combrel.comparison.statistics import bootstrap_relative_difference, holm, p_value_of_difference
from sb3_combrel.comparison.tables import Table, interval_text, mean_and_error, p_text, share_text, without_minus_zero
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baselines import ALGORITHMS, always_reached_from
from sb3_combrel.experiments.paper.domains import DOMAINS, Domain
from sb3_combrel.experiments.paper.figures import WINDOW
from sb3_combrel.experiments.paper.jobs import BREADTHS, DIAGNOSED_METHODS, method_at, steps_by_method
from sb3_combrel.runs.job import Result

#: Minutes that the paper gives for 200 episodes (Table 5).
PAPERS_MINUTES = {m.NO_TRANSFER: 24.0, m.TIMBREL_INTUITIVE: 28.1, m.COMBREL_PLAIN: 40.9}
#: Measures of :class:`~sb3_combrel.comparison.measures.TransferMeasures` in the table of measures.
_MEASURES = ("jumpstart", "asymptotic_performance", "total_reward", "transfer_ratio", "time_to_threshold")


def by_method(results: Sequence[Result], names: Sequence[str] = tuple(m.METHODS)) -> dict[str, list[Result]]:
    """Group the results of a domain by method, by seed, in the order of ``names``, without methods that have none."""
    runs = sorted(results, key=lambda result: result.seed)
    grouped = {name: [result for result in runs if result.method == name] for name in names}
    return {name: its_own for name, its_own in grouped.items() if its_own}


def summary_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """Make a table of what each method takes: all steps, the first episodes, the end, and steps until the last threshold."""
    rows = []
    for name, of_domain in results.items():
        hardest = DOMAINS[name].thresholds[-1]
        for method, runs in by_method(of_domain).items():
            samples = np.array([result.steps for result in runs])
            needed = steps_to_reach(samples, hardest, WINDOW)
            parts = samples.sum(axis=1), samples[:, :12].sum(axis=1), samples[:, -20:].mean(axis=1)
            reached = f"{np.isfinite(needed).sum()} of {len(samples)} runs; {hardest}"
            last = f"- (fewer than {WINDOW} episodes)" if samples.shape[1] < WINDOW else f"{_median_text(needed)} ({reached})"
            rows.append((DOMAINS[name].title, method, str(len(samples)), *map(mean_and_error, parts), last))
    n_episodes = max((len(result.steps) for of_domain in results.values() for result in of_domain), default=20)
    first, end = min(12, n_episodes), min(20, n_episodes)
    of_steps = ("steps, all", f"first {first} episodes", f"an episode, last {end}", "steps to the last threshold")
    title = "Environment steps, mean and standard error; median until the last threshold"
    return Table(title, ("domain", "method", "runs", *of_steps), rows)


def _median_text(needed: np.ndarray) -> str:
    return f"{np.median(needed):,.0f}" if np.isfinite(np.median(needed)) else "never"


def thresholds_table(domain: Domain, results: Sequence[Result]) -> Table:
    """Make a table of the environment steps until each threshold (the paper's Figure 6): median of the runs, Holm's p-value.

    The p-value is of Mann and Whitney's test against COMBREL, over the rows of a column.
    """
    steps = {method: np.array([run.steps for run in runs]) for method, runs in by_method(results).items()}
    columns = []
    for threshold in domain.thresholds:
        needed = {method: steps_to_reach(each, threshold, WINDOW) for method, each in steps.items()}
        of_combrel = needed[m.COMBREL_PLAIN]
        others = {name: p_value_of_difference(each, of_combrel, "mann-whitney") for name, each in needed.items()}
        corrected = holm({name: p for name, p in others.items() if name != m.COMBREL_PLAIN})
        p_values = {name: f" ({p_text(p)})" for name, p in corrected.items()}
        columns.append([_median_text(each) + p_values.get(name, "") for name, each in needed.items()])
    title = f"Environment steps until the median of {WINDOW} episodes is at most so many {domain.unit}; p against COMBREL"
    return Table(title, ("method", *map(str, domain.thresholds)), list(zip(steps, *columns, strict=True)))


def measures_table(domain: Domain, results: Sequence[Result]) -> Table:
    """Make a table of Taylor & Stone's measures: effect against no transfer and Holm's p-value over the column."""
    curves = {method: curves_of(runs) for method, runs in by_method(results).items()}
    without = curves.pop(m.NO_TRANSFER)
    # The ratio depends on it: the lowest return of any run, the same for all rows.
    floor = float(min(each.returns.min() for each in (without, *curves.values())))
    threshold = domain.goal_reward - domain.thresholds[-1]
    # In a short trial all episodes are the first, and the last.
    counts = counts_within(without.returns.shape[1])
    found = {
        method: compare_learning(each, without, threshold=threshold, floor=floor, **counts) for method, each in curves.items()
    }
    columns = []
    for field in _MEASURES:
        comparisons = {method: getattr(measures, field) for method, measures in found.items()}
        corrected = holm({method: each.p_value for method, each in comparisons.items()})
        columns.append([_cell(each.effect, corrected[name], field == "transfer_ratio") for name, each in comparisons.items()])
    title = f"{domain.title}: measures of transfer against no transfer; p by Holm's method"
    header = ("method", *(field.replace("_", " ") for field in _MEASURES))
    return Table(f"{title} (threshold: a return of {threshold:g})", header, list(zip(found, *columns, strict=True)))


def _cell(effect: float, p_value: float, percent: bool) -> str:
    if not np.isfinite(effect):
        return "-"
    effect = without_minus_zero(effect, 2 if percent else 0)
    return f"{effect:+.0%} ({p_text(p_value)})" if percent else f"{effect:+,.0f} ({p_text(p_value)})"


def uses_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """Make a table of how often transferred instances were used at the agent's states: what they change is at most that."""
    rows = []
    for name, of_domain in results.items():
        for method, runs in by_method(of_domain).items():
            uses = [result.more["uses"] for result in runs]
            if not any(uses):
                continue
            n_uses = np.array([sum(row[-1] for row in each) for each in uses])
            n_mappings = np.array([len({tuple(row[1:4]) for row in each}) for each in uses])
            per_step = np.mean(n_uses / [sum(result.steps) for result in runs])
            per_episode = np.mean([result.more["mappings_of_episodes"] for result in runs])
            cells = f"{n_uses.mean():,.0f}", f"{per_step:.3f}", f"{n_mappings.mean():,.0f}", f"{per_episode:.1f}"
            rows.append((DOMAINS[name].title, method, *cells))
    header = ("domain", "method", "uses", "uses a step", "mappings used", "in an episode")
    title = "State-action pairs at the agent's states for which transferred instances were used by any run, mean of all runs"
    return Table(title, header, rows)


def running_times_table(results: Sequence[Result]) -> Table:
    """Make a table of the running times of all episodes and of the first (the paper's Table 5), mean of the runs."""
    rows = []
    for method, runs in by_method(results).items():
        seconds = np.array([(result.seconds, result.more["first_episode_seconds"]) for result in runs])
        steps = np.array([sum(result.steps) for result in runs])
        papers = f"{PAPERS_MINUTES[method]:.1f}" if method in PAPERS_MINUTES else ""
        whole, first = seconds.mean(axis=0)
        per_step = f"{1000.0 * seconds[:, 0].sum() / steps.sum():.2f}"
        rows.append((method, papers, f"{whole / 60:.2f}", f"{first:.1f}", per_step, f"{steps.mean():,.0f}"))
    n_episodes = len(results[0].steps) if results else 0
    header = ("method", "paper, minutes", "minutes", "first episode, seconds", "ms a step", "steps")
    return Table(f"Processor time of {n_episodes} episodes, mean of the runs", header, rows)


def diagnosis_table(results: Sequence[Result]) -> Table:
    """Make a table of what COMBREL and random mappings save at each breadth of the learner's kernel."""
    steps = steps_by_method(results)
    rows, p_values = [], {}
    for breadth in BREADTHS:
        none, combrel, random = (steps[method_at(method, breadth)].sum(axis=1).astype(float) for method in DIAGNOSED_METHODS)
        savings = [bootstrap_relative_difference(each, none) for each in (combrel, random)]
        cells = [f"{share_text(-each.value)} ({interval_text(-each.high, -each.low)})" for each in savings]
        p_values[breadth] = p_value_of_difference(combrel, random, "permutation")
        rows.append((f"{breadth:g}", f"{none.mean():,.0f}", *cells))
    savings_of = ("COMBREL saves", "random mappings save", "p (Holm), COMBREL against random")
    n_runs, n_episodes = steps[method_at(DIAGNOSED_METHODS[0], BREADTHS[0])].shape
    title = f"What transfer saves at each breadth of the learner's kernel: {n_episodes} episodes, {n_runs} runs"
    cells_of_p = map(p_text, holm(p_values).values())
    rows = [(*row, p) for row, p in zip(rows, cells_of_p, strict=True)]
    return Table(title, ("model_breadth", "no transfer, steps", *savings_of), rows)


def baselines_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """Make a table of what the baselines reach."""
    rows = []
    for domain, of_domain in results.items():
        for algorithm, runs in by_method(of_domain, ALGORITHMS).items():
            evaluations = [result.more["evaluations"] for result in runs]
            needed = np.array([always_reached_from(each) for each in evaluations])
            totals, returns, _ = zip(*(each[-1] for each in evaluations), strict=True)
            cells = f"{max(totals):,.0f}", f"{np.isfinite(needed).sum()} of {len(runs)}", _median_text(needed)
            rows.append((DOMAINS[domain].title, algorithm, *cells, f"{np.median(returns):,.0f}"))
    reached = ("runs that reach it always", "from step, median", "greedy return at the end, median")
    title = "Baselines: greedy policy, five episodes at ten numbers of steps"
    return Table(title, ("domain", "algorithm", "steps", *reached), rows)


def evaluations_frame(results: Mapping[str, Sequence[Result]]) -> pd.DataFrame:
    """Return what the baselines' evaluations were, a row each: what figure and table are made of."""
    rows = [
        (domain, algorithm, run.seed, int(n_steps), *measured)
        for domain, of_domain in results.items()
        for algorithm, runs in by_method(of_domain, ALGORITHMS).items()
        for run in runs
        for n_steps, *measured in run.more["evaluations"]
    ]
    return pd.DataFrame(rows, columns=["domain", "algorithm", "seed", "steps", "greedy_return", "fraction_reached"])


def runs_frame(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row for each run: the steps of its episodes, and how many of them ended in a terminal state."""
    rows = [
        (result.method, result.seed, sum(result.steps), sum(result.terminated), " ".join(map(str, result.steps)))
        for result in sorted(results, key=lambda each: (each.method, each.seed))
    ]
    return pd.DataFrame(rows, columns=["method", "seed", "steps", "episodes_terminated", "steps_of_episodes"])
