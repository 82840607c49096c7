"""The command ``sb3-combrel benchmark``: carries out the runs of methods and pairs, and makes tables, pictures and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from rich.console import Console

from sb3_combrel import SourceInstances, __version__
from sb3_combrel.common.checks import check_count
from sb3_combrel.experiments.benchmark.methods import METHODS, Method, method_of, run_as
from sb3_combrel.experiments.benchmark.pair import Pair, described
from sb3_combrel.experiments.benchmark.pairs import PAIRS
from sb3_combrel.experiments.benchmark.report import few_runs, write_report
from sb3_combrel.experiments.benchmark.runs import BenchmarkJob, Outcome, carry_out, jobs_of
from sb3_combrel.experiments.benchmark.scores import FEWEST_RUNS
from sb3_combrel.experiments.benchmark.third_party import load_attribute
from sb3_combrel.experiments.carrying_out import LOCAL, Engine, progress_of
from sb3_combrel.experiments.output_folder import prepare_folder
from sb3_combrel.experiments.result_files import RunFiles, run_name
from sb3_combrel.runs.runner import JobError
from sb3_combrel.runs.source_files import FOLDER, load_or_learn

ALL = "all"
OUTPUT = Path("benchmark")
#: No setting was chosen with this seed or those after it.
FIRST_SEED = 7000
N_SEEDS = 10


def benchmark(
    pairs: Sequence[str] = (ALL,),
    methods: Sequence[str] = (ALL,),
    *,
    seeds: int = N_SEEDS,
    first_seed: int = FIRST_SEED,
    output: Path = OUTPUT,
    engine: Engine = LOCAL,
    console: Console | None = None,
) -> list[Path]:
    """
    Carry out the runs of some methods on some pairs, unless they were carried out before, and report on them.

    :param pairs: names of :data:`PAIRS`, files that define ``PAIR``, or "all" for all of the package
    :param methods: names of :data:`METHODS`, "package.module:Name" or "file.py:Name", or "all" for all of the package
    :param seeds: number of runs of each method on each pair
    :param first_seed: seed of the first
    :param output: folder for all results
    :param engine: where the runs are carried out
    :param console: where to write; None for the standard output
    :return: the files made
    :raises ValueError: if an argument is unknown or out of range, or the folder has results of other settings
    :raises ConnectionError: if no cluster answers at the engine's address
    """
    for name, number in (("seeds", seeds), ("jobs", engine.n_jobs)):
        check_count(name, number, none_allowed=name == "jobs")
    check_count("first_seed", first_seed, min=0)
    chosen_pairs, digests = pairs_of(pairs)
    chosen_methods = methods_of(methods)
    _check_names("pairs", [pair.name for pair in chosen_pairs])
    _check_names("methods", [method.name for method in chosen_methods])
    _check_run_names(chosen_pairs, chosen_methods)
    _check_sources(chosen_pairs)
    engine.check()
    console = console or Console()
    prepare_folder(output, settings_of(chosen_pairs, chosen_methods, digests))
    if seeds < FEWEST_RUNS:
        console.print(few_runs(seeds), markup=False, soft_wrap=True)
    all_seeds = range(first_seed, first_seed + seeds)
    sources, failed = prepare_sources(chosen_pairs, output, console)
    jobs = jobs_of(chosen_pairs, chosen_methods, all_seeds, sources)
    outcomes = carry_out_all(jobs, RunFiles(output, Outcome), engine, console)
    outcomes += _without_source(chosen_pairs, chosen_methods, all_seeds, failed)
    command = ["sb3-combrel", "benchmark", "--pairs", *pairs, "--methods", *methods, "--seeds", str(seeds)]
    command += ["--first-seed", str(first_seed)]
    return write_report(chosen_pairs, chosen_methods, all_seeds, outcomes, output, command, console)


def pairs_of(names: Sequence[str]) -> tuple[list[Pair], dict[str, str]]:
    """
    Return the pairs of some names.

    :param names: of :data:`PAIRS`, files that define ``PAIR``, or "all"
    :return: the pairs, and by name a digest of the file of each that is not the package's own
    :raises ValueError: if there is no such pair
    """
    found: list[Pair] = []
    digests = {}
    for name in names:
        if name == ALL:
            found += PAIRS.values()
        elif name in PAIRS:
            found.append(PAIRS[name])
        elif name.endswith(".py"):
            pair, digest = load_attribute("pairs", f"{name}:PAIR")
            if not isinstance(pair, Pair):
                raise ValueError(f"pairs: PAIR of {name} must be a Pair, got {pair!r}")
            found.append(pair)
            digests[pair.name] = digest
        else:
            raise ValueError(
                f"pairs must be of {', '.join(PAIRS)}, or all; a pair of your own is the path of a file that ends in .py and "
                f"defines PAIR; got {name!r}"
            )
    if not found:
        raise ValueError("pairs must name at least one pair, got none")
    return found, digests


def methods_of(names: Sequence[str]) -> list[Method]:
    """
    Return the methods of some names.

    :param names: see :func:`benchmark`
    :raises ValueError: if there is no such method
    """
    found = [method for name in names for method in (METHODS.values() if name == ALL else [method_of(name)])]
    if not found:
        raise ValueError("methods must name at least one method, got none")
    return found


def settings_of(pairs: Sequence[Pair], methods: Sequence[Method], digests: dict[str, str]) -> dict[str, Any]:
    """What the results in a folder depend on."""
    now: dict[str, Any] = {"version": __version__}
    for pair in pairs:
        now[f"pair {pair.name}"] = pair.settings() | ({"digest": digests[pair.name]} if pair.name in digests else {})
        # Pairs of other calls may have a source in the same file.
        now |= {f"source {source.name}": described(source.learn) for source in pair.sources}
    return now | {f"method {method.name}": method.digest for method in methods}


def prepare_sources(
    pairs: Sequence[Pair], output: Path, console: Console
) -> tuple[dict[str, tuple[SourceInstances, ...]], dict[str, str]]:
    """
    Learn the source tasks of pairs, or load what was learned before.

    :param pairs: the pairs
    :param output: the output folder
    :param console: where to show what is being done
    :return: instances by the name of the pair; and why those of other pairs could not be learned
    """
    found, failed = {}, {}
    for pair in pairs:
        try:
            found[pair.name] = tuple(
                load_or_learn(output / FOLDER / f"{source.name}.npz", source.learn, console) for source in pair.sources
            )
        except Exception as error:  # a third party's environment raises what it likes
            failed[pair.name] = f"its source could not be learned: {type(error).__name__}: {' '.join(str(error).split())}"
            console.print(f"{pair.name}: {failed[pair.name]}", markup=False, soft_wrap=True)
    return found, failed


def carry_out_all(jobs: Sequence[BenchmarkJob], files: RunFiles[Outcome], engine: Engine, console: Console) -> list[Outcome]:
    """
    Carry out the jobs that have no result yet, and write each result as it arrives. One that fails does not stop the others.

    :param jobs: the jobs
    :param files: where results are
    :param engine: where to carry them out
    :param console: where to show the progress
    :return: the results of all jobs
    """
    missing = [job for job in jobs if not files.is_complete(job)]
    if len(missing) < len(jobs):
        console.print(f"{len(jobs) - len(missing)} of {len(jobs)} runs were complete already.")
    with progress_of(jobs, missing, console, _bar_of, _why_not) as advance:

        def take(job: BenchmarkJob, outcome: Outcome) -> None:
            files.write(outcome)
            advance(job, outcome)
            done.add(job.name)
            # Below bars there are no lines of runs.
            if console.is_terminal and _why_not(outcome):
                console.print(f"  {job.title}: {_why_not(outcome)}", markup=False, soft_wrap=True)

        while missing:
            done: set[str] = set()
            try:
                with closing(engine.carry_out(carry_out, missing)) as results:
                    for place, outcome in results:
                        take(missing[place], outcome)
            except JobError as error:
                # What a run raises is in its outcome: here its workers have died, or it cannot be sent.
                (job,) = (each for each in missing if each.name == error.name)
                take(job, job.outcome(error=" ".join(error.reason.split()), traceback=error.worker_traceback))
            missing = [job for job in missing if job.name not in done]
    return files.read_all(jobs)


def _bar_of(job: BenchmarkJob) -> str:
    return job.pair.name


def _why_not(outcome: Outcome) -> str:
    """Say why there are no results of a run, "" if there are."""
    if outcome.misfit:
        return f"does not fit: {outcome.misfit}"
    return f"failed: {outcome.error}" if outcome.error else ""


def _without_source(
    pairs: Sequence[Pair], methods: Sequence[Method], seeds: Sequence[int], failed: dict[str, str]
) -> list[Outcome]:
    """The outcomes of pairs whose source could not be learned."""
    return [
        BenchmarkJob(pair, method, seed, ()).outcome(error=failed[pair.name])
        for pair in pairs
        if pair.name in failed
        for method in methods
        for seed in seeds
        if run_as(method, methods, pair) == method.name
    ]


def _check_names(argument: str, names: Sequence[str]) -> None:
    twice = [name for name, n in Counter(map(str.lower, names)).items() if n > 1]
    if twice:
        raise ValueError(f"{argument} must have different names, got {', '.join(twice)} twice")


def _check_run_names(pairs: Sequence[Pair], methods: Sequence[Method]) -> None:
    """
    :raises ValueError: if runs of two methods or pairs have the same file
    """
    seen: dict[str, str] = {}
    for pair in pairs:
        for method in methods:
            title = f"{method.name} on {pair.name}"
            other = seen.setdefault(run_name(pair.name, method.name, 0), title)
            if other != title:
                raise ValueError(f"methods: the runs of {title} and of {other} would have the same files; rename one")


def _check_sources(pairs: Sequence[Pair]) -> None:
    """
    :raises ValueError: if two sources have the same file and are recorded in different ways
    """
    seen: dict[str, Any] = {}
    for pair in pairs:
        for source in pair.sources:
            how = described(source.learn)
            if seen.setdefault(source.name, how) != how:
                raise ValueError(
                    f"{pair.name}: another pair has a source of the name {source.name!r} that is recorded in another way; "
                    "rename one"
                )
