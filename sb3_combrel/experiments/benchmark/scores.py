"""What a pair's runs say of each method: performance, rank, and measures of transfer with corrected p-values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import stats

from sb3_combrel.comparison.curves import curves_of
from sb3_combrel.comparison.measures import (
    TransferMeasures,
    compare_learning,
    counts_within,
    total_reward,
    total_reward_by_steps,
)
from sb3_combrel.comparison.statistics import (
    Estimate,
    bootstrap_band,
    holm,
    interquartile_mean,
    p_value_of_difference,
)
from sb3_combrel.experiments.benchmark.methods import NONE, Method, run_as
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.runs.job import Result

#: With fewer runs of each method there are neither intervals nor tests.
FEWEST_RUNS = 3
#: Taylor & Stone's measures, by the fields of :class:`~sb3_combrel.comparison.measures.TransferMeasures`; the areas
#: are those over environment steps where the budget is in steps.
MEASURES = ("jumpstart", "asymptotic_performance", "total_reward", "transfer_ratio", "time_to_threshold")
_AREAS = ("total_reward", "transfer_ratio")


@dataclass(frozen=True)
class Cell:
    """What came of a method in a pair."""

    outcomes: tuple[Result, ...]  # of the runs that succeeded, by seed
    misfit: str = ""  # why the method does not fit the pair, or ""
    errors: Mapping[int, str] = field(default_factory=dict)  # of the runs that failed, by seed
    run_as: str = ""  # name of the method whose runs these are


class MethodScores(NamedTuple):
    """A method against no transfer."""

    performance: np.ndarray  # of each run with the method, shape (n_runs,)
    estimate: Estimate  # their interquartile mean, with its bootstrap interval
    p_value: float  # of the permutation test of equal means, by Holm over the methods; NaN for no transfer, or too few runs
    better: bool  # whether its mean performance is higher
    measures: TransferMeasures | None  # Taylor & Stone's, or None for no transfer itself and where it has no runs
    p_values: Mapping[str, float]  # of each of :data:`MEASURES`, by Holm's method over the pair's methods


def cells_of(pair: Pair, methods: Sequence[Method], outcomes: Sequence[Result], seeds: Sequence[int]) -> dict[str, Cell]:
    """Gather the outcomes of a pair, and of the seeds that count, by method."""
    own = sorted((each for each in outcomes if each.group == pair.name and each.seed in seeds), key=lambda each: each.seed)
    cells = {}
    for method in methods:
        name = run_as(method, methods, pair)
        of_method = [each for each in own if each.method == name]
        misfits = [each.more["misfit"] for each in of_method if each.more.get("misfit")]
        errors = {each.seed: each.error for each in of_method if each.error}
        succeeded = tuple(each for each in of_method if each.steps)
        cells[method.name] = Cell(succeeded, misfits[0] if misfits else "", errors, name)
    return cells


def n_compared(pairs: Sequence[Pair], methods: Sequence[Method]) -> int:
    """Count the methods that are compared with no transfer in a pair, if all fit it: in that with the fewest."""
    if NONE not in [method.name for method in methods]:
        return 0
    return min(len({run_as(method, methods, pair) for method in methods} - {NONE}) for pair in pairs)


def performances(pair: Pair, cells: Mapping[str, Cell]) -> dict[str, np.ndarray]:
    """Compute each run's mean return of an episode, or over environment steps, as many as the pair's shortest run has."""
    curves = {name: curves_of(cell.outcomes) for name, cell in cells.items() if cell.outcomes}
    if pair.n_steps is None:
        return {name: total_reward(each, pair.n_episodes) / float(pair.n_episodes or 1) for name, each in curves.items()}
    n_steps, _ = steps_of_all(cells)
    return {name: total_reward_by_steps(each, n_steps) / n_steps for name, each in curves.items()}


def steps_of_all(cells: Mapping[str, Cell]) -> tuple[int, str]:
    """Environment steps that each run has in episodes that have ended, and the run with the fewest.

    What is measured over steps ends there, in all rows: a run that is stuck shortens all others.
    """
    ended = ((sum(each.steps), f"{name}, seed {each.seed}") for name, cell in cells.items() for each in cell.outcomes)
    return min(ended, default=(1, "none"))


def compare(pair: Pair, cells: Mapping[str, Cell]) -> dict[str, MethodScores]:
    """Compare the methods of a pair that have runs with no transfer, where that has been run."""
    of_runs = performances(pair, cells)
    without = of_runs.get(NONE)
    raw, measures = {}, {}
    floor = min((min(each.returns) for name in of_runs for each in cells[name].outcomes), default=0.0)
    n_steps, _ = steps_of_all(cells)
    for name, its_own in of_runs.items():
        # Of methods whose runs are the same, one is tested.
        if without is None or name == NONE or (cells[name].run_as != name and cells[name].run_as in of_runs):
            continue
        measures[name] = _measures(pair, cells[name], cells[NONE], floor, n_steps)
        enough = min(len(its_own), len(without)) >= FEWEST_RUNS
        raw[name] = p_value_of_difference(its_own, without, "permutation") if enough else np.nan
    corrected = holm(raw)
    of_measures = {measure: holm(_p_values(pair, measures, measure)) for measure in MEASURES}
    found = {}
    for name, its_own in of_runs.items():
        tested = cells[name].run_as if cells[name].run_as in measures else name
        better = without is not None and bool(its_own.mean() > without.mean())
        p_values = {measure: of_measures[measure].get(tested, np.nan) for measure in MEASURES}
        tests = corrected.get(tested, np.nan), better, measures.get(tested), p_values
        found[name] = MethodScores(its_own, interquartile(its_own), *tests)
    return found


def interquartile(performance: np.ndarray) -> Estimate:
    """Compute the interquartile mean of runs with its 95% bootstrap interval, NaN with fewer than :data:`FEWEST_RUNS`."""
    found = bootstrap_band(performance, "iqm")
    return found if len(performance) >= FEWEST_RUNS else Estimate(found.mean, np.array(np.nan), np.array(np.nan))


def measure_name(pair: Pair, measure: str) -> str:
    """The field of a measure: areas are over environment steps where the pair's budget is in steps."""
    return f"{measure}_by_steps" if measure in _AREAS and pair.n_steps is not None else measure


def _measures(pair: Pair, cell: Cell, without: Cell, floor: float, n_steps: int) -> TransferMeasures:
    both = curves_of(cell.outcomes), curves_of(without.outcomes)
    counts = counts_within(int(min(each.n_episodes.min() for each in both)))
    return compare_learning(both[0], both[1], threshold=pair.threshold, floor=min(0.0, floor), n_steps=n_steps, **counts)


def _p_values(pair: Pair, measures: Mapping[str, TransferMeasures], measure: str) -> dict[str, float]:
    of_methods = {name: getattr(each, measure_name(pair, measure)) for name, each in measures.items()}
    return {
        name: np.nan if each is None or min(map(len, each[:2])) < FEWEST_RUNS else each.p_value
        for name, each in of_methods.items()
    }


def performance_of(scores: Mapping[str, MethodScores]) -> dict[str, np.ndarray]:
    """The performance of each method's runs, shape (n_runs,)."""
    return {name: each.performance for name, each in scores.items()}


def ranks(performance: Mapping[str, np.ndarray], cells: Mapping[str, Cell]) -> dict[str, float]:
    """Rank a pair's methods by interquartile mean performance, 1 the best; equal ones share ranks, same runs are one."""
    distinct = _distinct(performance, cells)
    means = np.array([float(interquartile_mean(each)) for each in distinct.values()])
    found = dict(zip(distinct, stats.rankdata(-means).tolist(), strict=True))
    return {name: found[cells[name].run_as] for name in performance}


class MeanRank(NamedTuple):
    """The mean rank of a method over ``n_pairs`` pairs."""

    rank: float
    n_pairs: int


def mean_ranks(
    performance: Mapping[str, Mapping[str, np.ndarray]], cells: Mapping[str, Mapping[str, Cell]]
) -> dict[str, MeanRank]:
    """Average the ranks of each method over pairs.

    A method is ranked in the pairs where it has runs, among the methods that have. So that places in pairs with many and with
    few methods count alike, ranks are stretched to the number of methods of the pair that has most: the best has 1, the last
    that number. Methods whose runs are the same count as one. There is no interval: to draw runs with replacement adds to
    their noise, which pulls ranks to the middle.
    """
    n_ranked = {pair: len(_distinct(of_methods, cells[pair])) for pair, of_methods in performance.items()}
    most = max(n_ranked.values(), default=0)
    found: dict[str, list[float]] = {}
    for pair, of_methods in performance.items():
        stretch = (most - 1.0) / (n_ranked[pair] - 1.0) if n_ranked[pair] > 1 else 0.0
        for name, rank in ranks(of_methods, cells[pair]).items():
            found.setdefault(name, []).append(1.0 + (rank - 1.0) * stretch)
    return {name: MeanRank(float(np.mean(of_pairs)), len(of_pairs)) for name, of_pairs in found.items()}


def _distinct(performance: Mapping[str, np.ndarray], cells: Mapping[str, Cell]) -> dict[str, np.ndarray]:
    """The performance by whose runs it is: of methods whose runs are the same, once."""
    return {cells[name].run_as: its_own for name, its_own in performance.items()}
