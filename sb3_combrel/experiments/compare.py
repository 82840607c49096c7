"""Learning with and without transfer, compared in one call: runs, measures, tests, a picture, and a sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_combrel.common.checks import as_count, check_count, check_finite
from sb3_combrel.experiments.compare_arguments import check_learner, check_methods, check_seeds, task_of
from sb3_combrel.experiments.compare_result import CompareResult, evaluate
from sb3_combrel.experiments.compared_runs import ComparedRun, MakeEnv, RunResult, TransferLike, carry_out
from sb3_combrel.experiments.learning_curves import returns_over_steps
from sb3_combrel.experiments.statistics import smallest_p_value

__all__ = [
    "CompareResult",
    "ComparedRun",
    "RunResult",
    "carry_out",
    "compare",
    "returns_over_steps",
    "smallest_p_value",
]


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
    baseline = check_methods(methods, baseline)
    numbers = check_seeds(seeds)
    steps = as_count("steps", steps)
    check_count("n_jobs", n_jobs, none_allowed=True)
    if threshold is not None:
        check_finite("threshold", threshold)
    learner = check_learner(learner)
    task = task_of(env)
    runs = [
        ComparedRun(method, seed, task, transfer, steps, learner) for method, transfer in methods.items() for seed in numbers
    ]
    for run in runs[:: len(numbers)]:
        _try_out(run)
    results = _carry_out(runs, n_jobs, progress_bar)
    by_method = {method: results[k * len(numbers) : (k + 1) * len(numbers)] for k, method in enumerate(methods)}
    return evaluate(by_method, baseline, threshold)


def _try_out(run: ComparedRun) -> None:
    """Make the model of a run, so that what does not fit is found before anything is learned."""
    try:
        model = run.make_model()
    except (ValueError, TypeError, OSError) as error:
        # Subclasses may ask for more than a message.
        kind = next(kind for kind in (FileNotFoundError, OSError, TypeError, ValueError) if isinstance(error, kind))
        raise kind(f"{run.method}: {error}") from error
    assert model.env is not None
    model.env.close()


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
