"""Learning with and without transfer, compared in one call: runs, measures, tests, a picture, and a sentence."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from sb3_combrel.common.checks import as_count, check_count, check_finite
from sb3_combrel.experiments.bootstrap import bootstrap_band
from sb3_combrel.experiments.figures import COLOURS
from sb3_combrel.experiments.runs import coarse_on_purpose, outside_bounds_on_purpose
from sb3_combrel.experiments.statistics import holm
from sb3_combrel.experiments.suite_runs import EpisodeRecorder
from sb3_combrel.experiments.transfer_measures import (
    Comparison,
    LearningCurves,
    TransferMeasures,
    asymptotic_return,
    compare_learning,
)
from sb3_combrel.fitted_rmax.arguments import MAX_SEED
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.sources.recipes import task_spec
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.report import TransferReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MakeEnv = Callable[[], gym.Env[Any, Any]]
TransferLike = Transfer | dict[str, Any] | str | None

#: A difference with a p-value below this counts as shown.
SIGNIFICANCE = 0.05
N_FIRST, N_LAST, WINDOW = 5, 10, 5
N_POINTS = 200
# What ``compare`` passes to the learner itself.
_TAKEN = ("env", "transfer", "seed", "_init_setup_model")


@dataclass(frozen=True)
class ComparedRun:
    """
    One run: Fitted R-Max learns the task with one method and one seed.

    :param method: its name
    :param seed: of learner and environment
    :param env: specification of the task, which need not be registered where the run is carried out; or a function that makes
        the environment
    :param transfer: as :class:`~sb3_combrel.FittedRMax` takes it
    :param steps: environment steps
    :param learner: further arguments of :class:`~sb3_combrel.FittedRMax`
    """

    method: str
    seed: int
    env: EnvSpec | MakeEnv
    transfer: TransferLike
    steps: int
    learner: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the run in messages."""
        return f"{self.method}, seed {self.seed}"

    def make_model(self) -> FittedRMax:
        """Make environment and learner, which has learned nothing yet."""
        env = gym.make(self.env) if isinstance(self.env, EnvSpec) else self.env()
        if not isinstance(env, gym.Env):
            raise ValueError(f"env must make Gymnasium environments, got {env!r}")
        with coarse_on_purpose():
            return FittedRMax(env, transfer=self.transfer, seed=self.seed, **self.learner)


@dataclass(frozen=True)
class RunResult:
    """
    What a run has brought.

    :param returns: of each complete episode
    :param steps: of each complete episode
    :param report: what transfer did; None without
    """

    returns: tuple[float, ...]
    steps: tuple[float, ...]
    report: TransferReport | None


@dataclass(frozen=True, eq=False)
class CompareResult:
    """
    Learning with several methods of transfer, and without; ``print`` it for the sentence and the table.

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
        header = ("measure", "method", f"{self.baseline}", "with", "difference", "95% interval", "p")
        lines = [f"| {' | '.join(header)} |", "| --- | --- |" + " ---: |" * (len(header) - 2)]
        lines += [f"| {' | '.join(row)} |" for method in self.measures for row in self._rows(method)]
        return "\n".join(lines)

    def figure(self) -> Figure:
        """
        Draw the learning curves: return over environment steps, mean of the runs with 95% bootstrap bands.

        :return: a figure of its own, which pyplot does not know: save it with ``figure.savefig("curves.png")``
        :raises ModuleNotFoundError: if matplotlib is not installed
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.0, 4.2), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        at = np.linspace(0.0, self.n_steps, N_POINTS, endpoint=False)
        for k, (method, curves) in enumerate(self.curves.items()):
            mean, low, high = bootstrap_band(returns_over_steps(curves, at), n_resamples=500)
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(at, mean, color=colour, label=f"{method} ({len(curves.returns)} runs)")
            axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
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
        if not smallest < SIGNIFICANCE:
            return (
                f"{method}: too few runs to tell ({figures}); so many runs cannot show a difference, "
                "take at least 4 seeds, better 10."
            )
        tested = f"{figures} (p = {p_value:.2g})"
        if p_value >= SIGNIFICANCE:
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


def compare(
    env: str | MakeEnv,
    methods: Mapping[str, TransferLike],
    *,
    seeds: int | Sequence[int] = 10,
    steps: int = 20_000,
    learner: Mapping[str, Any] | None = None,
    baseline: str | None = None,
    threshold: float | None = None,
    n_jobs: int | None = 1,
    progress_bar: bool = False,
) -> CompareResult:
    """
    Learn a task with several methods of transfer and without, and say whether transfer helped.

    Each method learns with the same seeds; everything is tested before the first run begins::

        result = sb3_combrel.compare(
            "combrel/MountainCar4D-v0", {"none": None, "COMBREL": COMBREL(source)}, seeds=10, steps=5_000, n_jobs=2
        )
        print(result.sentence)
        print(result.table)
        result.figure().savefig("curves.png")

    The question is answered by the return averaged over environment steps, exploration included, with the permutation test of
    the difference of means, corrected by Holm's method if several methods are compared with the baseline. The steps of
    learning the source do not count.

    :param env: id of the task, or a function without arguments that makes the environment; each run has its own
    :param methods: for each name a transfer method, as :class:`~sb3_combrel.FittedRMax` takes it, or None for no transfer
    :param seeds: number of runs of each method, with seeds from 0 on; or the seeds themselves
    :param steps: environment steps of each run; episodes that are not complete by then do not count
    :param learner: further arguments of :class:`~sb3_combrel.FittedRMax`, the same for all methods
    :param baseline: the method that the others are compared with; None: the one without transfer
    :param threshold: return that the time to threshold is measured to; None: the median, over the baseline's runs, of the mean
        return of their last episodes
    :param n_jobs: runs at a time, each in a process of its own; 1: one after the other in this process; None: one a core.
        Results do not depend on it.
    :param progress_bar: show how many runs are complete
    :return: learning curves, measures, p-values, table, figure and sentence
    :raises ValueError: if an argument is wrong or a method does not fit the task, before any run; or if a run was too short
        for a single episode
    :raises FileNotFoundError: if a source does not exist
    :raises ~sb3_combrel.experiments.engine_jobs.JobError: if a run in another process failed
    """
    baseline = _check_methods(methods, baseline)
    numbers = _check_seeds(seeds)
    steps = as_count("steps", steps)
    check_count("n_jobs", n_jobs, none_allowed=True)
    if threshold is not None:
        check_finite("threshold", threshold)
    learner = _check_learner(learner)
    task = _task(env)
    runs = [
        ComparedRun(method, seed, task, transfer, steps, learner) for method, transfer in methods.items() for seed in numbers
    ]
    for run in runs[:: len(numbers)]:
        _try_out(run)
    results = _carry_out(runs, n_jobs, progress_bar)
    by_method = {method: results[k * len(numbers) : (k + 1) * len(numbers)] for k, method in enumerate(methods)}
    return _evaluate(by_method, baseline, threshold)


def carry_out(run: ComparedRun) -> RunResult:
    """Learn."""
    recorder = EpisodeRecorder()
    model = run.make_model()
    assert model.env is not None
    with closing(model.env), outside_bounds_on_purpose():
        model.learn(run.steps, recorder, log_interval=None)
    episodes = recorder.episodes
    if len(episodes.steps) == 0:
        raise ValueError(
            f"steps={run.steps} is too few: no episode ended in the run of {run.name}; take more, or a time limit"
        )
    report = None if model.transfer is None else model.transfer.report()
    return RunResult(tuple(map(float, episodes.returns)), tuple(map(float, episodes.steps)), report)


def returns_over_steps(curves: LearningCurves, at: np.ndarray) -> np.ndarray:
    """
    Return, for each run, the return of the episode that was under way after so many environment steps.

    :param at: environment steps, none beyond the last episode of a run, shape (n_points,)
    :return: shape (n_runs, n_points)
    """
    ends = np.cumsum(np.nan_to_num(curves.steps), axis=1)
    rows = [
        returns[np.searchsorted(end[:n], at, side="right")]
        for returns, end, n in zip(curves.returns, ends, curves.n_episodes, strict=True)
    ]
    return np.array(rows)


def smallest_p_value(n_first: int, n_second: int, n_methods: int) -> float:
    """
    Compute the smallest p-value that a permutation test of so many runs can have, after Holm's correction; 1 for one run.

    :param n_first: runs of a method; ``n_second``: of the other
    :param n_methods: number of tests
    """
    if min(n_first, n_second) < 2:
        return 1.0
    # The two extreme groupings are equally far apart if the groups are equally large.
    extreme = 2 if n_first == n_second else 1
    return min(1.0, n_methods * extreme / math.comb(n_first + n_second, n_first))


# --------------------------------------------------------------------------------------------- checks


def _check_methods(methods: Any, baseline: Any) -> str:
    """Check the methods, and return the baseline's name."""
    if not isinstance(methods, Mapping) or not all(isinstance(name, str) for name in methods):
        raise ValueError(f"methods must be a dict from names to transfer methods, got {methods!r}")
    if len(methods) < 2:
        raise ValueError(
            f'methods must have at least two, such as {{"none": None, "COMBREL": COMBREL(source)}}, got {methods!r}'
        )
    for name, transfer in methods.items():
        if not (transfer is None or isinstance(transfer, Transfer | dict | str)):
            raise ValueError(f"methods must be transfer methods or None for no transfer, got {transfer!r} for {name!r}")
    without = [name for name, transfer in methods.items() if transfer is None]
    if baseline is None:
        if len(without) != 1:
            raise ValueError(f"baseline must be one of {', '.join(methods)}, as {len(without)} methods are without transfer")
        return without[0]
    if baseline not in methods:
        raise ValueError(f"baseline must be one of {', '.join(methods)}, got {baseline!r}")
    return str(baseline)


def _check_seeds(seeds: Any) -> list[int]:
    if isinstance(seeds, Sequence) and not isinstance(seeds, str):
        numbers = [as_count("seeds", seed, min=0, max=MAX_SEED) for seed in seeds]
        if not numbers or len(set(numbers)) < len(numbers):
            raise ValueError(f"seeds must be different whole numbers, at least one, got {list(seeds)!r}")
        return numbers
    return list(range(as_count("seeds", seeds)))


def _check_learner(learner: Any) -> dict[str, Any]:
    if learner is None:
        return {}
    known = [name for name in inspect.signature(FittedRMax).parameters if name not in _TAKEN]
    if not isinstance(learner, Mapping):
        raise ValueError(f"learner must be a dict of arguments of FittedRMax, got {learner!r}")
    for name in learner:
        if name not in known:
            raise ValueError(f"learner must have arguments out of {', '.join(known)}, got {name!r}")
    return dict(learner)


def _task(env: Any) -> EnvSpec | MakeEnv:
    if isinstance(env, str):
        spec = task_spec(env)
        if spec is None:
            raise ValueError(f"env must be the id of an environment or a function that makes one; there is no {env!r}")
        return spec
    if not callable(env):
        raise ValueError(
            f"env must be the id of an environment or a function that makes one, as each run has its own, got {env!r}; "
            "for example env=lambda: MyEnv()"
        )
    return env  # type: ignore[no-any-return]


def _try_out(run: ComparedRun) -> None:
    """Make the model of a run, so that what does not fit is found before anything is learned."""
    try:
        model = run.make_model()
    except (ValueError, TypeError, OSError) as error:
        raise type(error)(f"{run.method}: {error}") from error
    assert model.env is not None
    model.env.close()


# ------------------------------------------------------------------------------------------- carrying out


def _carry_out(runs: Sequence[ComparedRun], n_jobs: int | None, progress_bar: bool) -> list[RunResult]:
    from tqdm import tqdm

    with tqdm(total=len(runs), disable=not progress_bar, unit="run") as bar:
        if n_jobs == 1:
            results = []
            for run in runs:
                results.append(carry_out(run))
                bar.update()
            return results
        from sb3_combrel.experiments.engines import carry_out_on

        found: dict[int, RunResult] = {}
        for index, result in carry_out_on("joblib", carry_out, runs, n_jobs=n_jobs):
            found[index] = result
            bar.update()
    return [found[index] for index in range(len(runs))]


def _evaluate(results: Mapping[str, Sequence[RunResult]], baseline: str, threshold: float | None) -> CompareResult:
    curves = {
        method: LearningCurves.from_rows([run.returns for run in runs], [run.steps for run in runs])
        for method, runs in results.items()
    }
    shortest = min(int(each.n_episodes.min()) for each in curves.values())
    n_last = min(N_LAST, shortest)
    if threshold is None:
        threshold = float(np.median(asymptotic_return(curves[baseline], n_last)))
    # All comparisons are of the same number of steps, so that their figures can be compared.
    n_steps = min(int(each.n_steps.min()) for each in curves.values())
    measures = {
        method: compare_learning(
            each,
            curves[baseline],
            threshold=threshold,
            n_first=min(N_FIRST, shortest),
            n_last=n_last,
            window=min(WINDOW, shortest),
            n_steps=n_steps,
        )
        for method, each in curves.items()
        if method != baseline
    }
    corrected = holm(np.array([each.total_reward_by_steps.p_value for each in measures.values()]))
    return CompareResult(
        curves=curves,
        baseline=baseline,
        measures=measures,
        p_values=dict(zip(measures, corrected.tolist(), strict=True)),
        threshold=threshold,
        n_steps=n_steps,
        reports={method: reports for method, runs in results.items() if (reports := _reports(runs))},
    )


def _reports(runs: Sequence[RunResult]) -> tuple[TransferReport, ...]:
    return tuple(run.report for run in runs if run.report is not None)
