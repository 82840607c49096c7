"""The command ``sb3-combrel benchmark``: carries out the runs of methods and pairs, and makes tables, pictures and a page."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, product
from pathlib import Path

from rich.console import Console

from sb3_combrel import SourceInstances
from sb3_combrel.common.checks import check_count
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.common.version import __version__
from sb3_combrel.experiments.benchmark.methods import METHODS, Method, method_of
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.pairs import PAIRS
from sb3_combrel.experiments.benchmark.report import OVERVIEW, PAGE, few_runs, write_report
from sb3_combrel.experiments.benchmark.runs import jobs_of
from sb3_combrel.experiments.benchmark.scores import n_compared
from sb3_combrel.experiments.benchmark.third_party import load_attribute
from sb3_combrel.experiments.suite.tasks import Source
from sb3_combrel.fitted_rmax.arguments import MAX_SEED
from sb3_combrel.runs.described import described
from sb3_combrel.runs.job import file_name
from sb3_combrel.runs.runner import FOLDER as RUNS
from sb3_combrel.runs.runner import LOCAL, Backend, JobError, prepare_folder, run_missing
from sb3_combrel.runs.source_files import FOLDER, SourceJob, try_sources

ALL = "all"
OUTPUT = Path("benchmark")
#: No setting was chosen with this seed or those after it.
FIRST_SEED = 7000
N_SEEDS = 10
# Names of files and folders besides those of pairs.
_FILES = (OVERVIEW, f"{OVERVIEW}_1", f"{OVERVIEW}_2", PAGE, RUNS, FOLDER)


def benchmark(
    pairs: Sequence[str] = (ALL,),
    methods: Sequence[str] = (ALL,),
    *,
    seeds: int = N_SEEDS,
    first_seed: int = FIRST_SEED,
    output: Path = OUTPUT,
    backend: Backend = LOCAL,
    console: Console | None = None,
) -> list[Path]:
    """Carry out the runs of some methods on some pairs, unless they were carried out before, and report on them.

    :param pairs: names of :data:`PAIRS`, files that define ``PAIR``, "package.module:Name", or "all" for all of the package
    :param methods: names of :data:`METHODS`, "package.module:Name" or "file.py:Name", or "all" for all of the package
    :param seeds: number of runs of each method on each pair
    :param first_seed: seed of the first
    :param output: folder for all results
    :param backend: where the runs are carried out
    :param console: where to write; None for the standard output
    :return: the files made
    :raises ValueError: if an argument is unknown or out of range, the folder has results of other settings, or a pair's known
        mapping does not fit its tasks
    :raises ConnectionError: if no cluster answers at the backend's address
    :raises JobError: if runs failed, once the report is written
    """
    check_count("seeds", seeds, max=MAX_SEED)
    check_count("first_seed", first_seed, min=0, max=MAX_SEED + 1 - seeds)
    chosen_pairs, chosen_methods = pairs_of(pairs), methods_of(methods)
    _check_names("pairs", chosen_pairs)
    _check_names("methods", chosen_methods)
    for pair in chosen_pairs:
        if pair.name.lower() in _FILES:
            raise ValueError(f"pairs must not have the name of another file of the report, got {pair.name}")
    backend.check()
    console = console or Console()
    prepare_folder(output)
    if few := few_runs(seeds, n_compared(chosen_pairs, chosen_methods)):
        console.print(few, markup=False, soft_wrap=True)
    all_seeds = range(first_seed, first_seed + seeds)
    sources, failed = prepare_sources(chosen_pairs, all_seeds, output, backend, console)
    any_sources = [next((given for seed in all_seeds if (given := sources[pair.name, seed])), ()) for pair in chosen_pairs]
    chosen_pairs = [pair.check_known(given) for pair, given in zip(chosen_pairs, any_sources, strict=True)]
    jobs = jobs_of(chosen_pairs, chosen_methods, all_seeds, sources)
    results = run_missing([job for job in jobs if (job.group, job.seed) not in failed], output, backend, console)
    results += [job.result(error=failed[job.group, job.seed]) for job in jobs if (job.group, job.seed) in failed]
    command = ["sb3-combrel", "benchmark", "--pairs", *pairs, "--methods", *methods, "--seeds", str(seeds)]
    command += ["--first-seed", str(first_seed)]
    made = write_report(chosen_pairs, chosen_methods, all_seeds, results, output, command, console)
    n_failed = sum(bool(each.error) for each in results)
    if n_failed:
        where = f"the notes in {made[-1]} say why, and the same command tries them again"
        raise JobError(f"{n_failed} of {len(results)} runs failed: {where}")
    return made


def pairs_of(names: Sequence[str]) -> list[Pair]:
    """Return the pairs of some names, see :func:`benchmark`."""
    found: list[Pair] = []
    for name in names:
        if name == ALL:
            found += PAIRS.values()
        elif name in PAIRS:
            found.append(PAIRS[name])
        elif name.endswith(".py") or ":" in name:
            text = name if ":" in name else f"{name}:PAIR"
            pair, digest = load_attribute("pairs", text)
            if not isinstance(pair, Pair):
                raise ValueError(f"pairs: {text} must be a Pair, got {pair!r}")
            found.append(replace(pair, digest=digest))
        else:
            own = 'a pair of your own is "path/to/file.py", which defines PAIR, or "package.module:Name"'
            raise ValueError(f"pairs must be of {', '.join(PAIRS)}, or all; {own}; got {name!r}{did_you_mean(name, PAIRS)}")
    return found


def methods_of(names: Sequence[str]) -> list[Method]:
    """Return the methods of some names, see :func:`benchmark`."""
    return [method for name in names for method in (METHODS.values() if name == ALL else [method_of(name)])]


def prepare_sources(
    pairs: Sequence[Pair], seeds: Sequence[int], output: Path, backend: Backend, console: Console
) -> tuple[dict[tuple[str, int], tuple[SourceInstances, ...]], dict[tuple[str, int], str]]:
    """Learn or load the sources of pairs, one of each for each seed.

    :return: by the pair's name and the seed, instances, () where they could not be learned; and why not
    """

    def job_of(source: Source, pair: Pair, seed: int) -> SourceJob:
        path = output / FOLDER / file_of(source, pair, seed)
        return SourceJob(group=pair.name, method=f"source {source.name}", seed=seed, path=path, learn=source.learn)

    jobs = {(pair.name, seed): [job_of(source, pair, seed) for source in pair.sources] for pair, seed in product(pairs, seeds)}
    results = iter(try_sources([job for row in jobs.values() for job in row], backend, console))
    found: dict[tuple[str, int], tuple[SourceInstances, ...]] = {}
    failed: dict[tuple[str, int], str] = {}
    for (pair_name, seed), row in jobs.items():
        made = list(islice(results, len(row)))
        errors = [each.error for each in made if each.error]
        found[pair_name, seed] = () if errors else tuple(each.more["instances"] for each in made)
        if errors:
            failed[pair_name, seed] = why = f"its source could not be learned: {errors[0]}"
            console.print(f"{pair_name}, seed {seed}: {why}", markup=False, soft_wrap=True)
    return found, failed


def _check_names(argument: str, chosen: Sequence[Pair] | Sequence[Method]) -> None:
    """There must be some; names of files do not tell capital letters, nor some signs, apart."""
    names = [each.name for each in chosen]
    if not names or len({file_name(name, "", 0) for name in names}) < len(names):
        raise ValueError(f"{argument} must be at least one, with different names, got {', '.join(names) or 'none'}")


def file_of(source: Source, pair: Pair, seed: int) -> str:
    """Name of the file of a pair's source, recorded with a seed: another one if it is recorded in another way."""
    how = json.dumps([__version__, pair.digest, described(source.learn)])
    return f"{source.name}-{hashlib.sha256(how.encode()).hexdigest()[:8]}_seed{seed}.npz"
