"""The command ``sb3-combrel benchmark``: carries out the runs of methods and pairs, and makes tables, pictures and a page."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from rich.console import Console

from sb3_combrel import SourceInstances
from sb3_combrel.common.checks import check_count
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.common.version import __version__
from sb3_combrel.experiments.benchmark.methods import METHODS, Method, method_of
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.benchmark.pairs import PAIRS
from sb3_combrel.experiments.benchmark.report import few_runs, write_report
from sb3_combrel.experiments.benchmark.runs import jobs_of
from sb3_combrel.experiments.benchmark.scores import FEWEST_RUNS
from sb3_combrel.experiments.benchmark.third_party import load_attribute
from sb3_combrel.experiments.suite.tasks import Source
from sb3_combrel.runs.job import described, file_name
from sb3_combrel.runs.runner import LOCAL, Backend, prepare_folder, run_missing
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
    :raises ValueError: if an argument is unknown or out of range, or the folder has results of other settings
    :raises ConnectionError: if no cluster answers at the backend's address
    """
    check_count("seeds", seeds)
    check_count("first_seed", first_seed, min=0)
    chosen_pairs, chosen_methods = pairs_of(pairs), methods_of(methods)
    _check_names("pairs", chosen_pairs)
    _check_names("methods", chosen_methods)
    backend.check()
    console = console or Console()
    prepare_folder(output)
    if seeds < FEWEST_RUNS:
        console.print(few_runs(seeds), markup=False, soft_wrap=True)
    all_seeds = range(first_seed, first_seed + seeds)
    sources, failed = prepare_sources(chosen_pairs, all_seeds, output, console)
    jobs = jobs_of(chosen_pairs, chosen_methods, all_seeds, sources)
    results = run_missing([job for job in jobs if job.group not in failed], output, backend, console)
    results += [job.result(error=failed[job.group]) for job in jobs if job.group in failed]
    command = ["sb3-combrel", "benchmark", "--pairs", *pairs, "--methods", *methods, "--seeds", str(seeds)]
    command += ["--first-seed", str(first_seed)]
    return write_report(chosen_pairs, chosen_methods, all_seeds, results, output, command, console)


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
    pairs: Sequence[Pair], seeds: Sequence[int], output: Path, console: Console
) -> tuple[dict[tuple[str, int], tuple[SourceInstances, ...]], dict[str, str]]:
    """Learn or load the sources of pairs, one of each for each seed.

    :return: instances, by the pair's name and the seed, () where they could not be learned; and why not, by the pair's name
    """
    found: dict[tuple[str, int], tuple[SourceInstances, ...]] = {}
    failed: dict[str, str] = {}
    for pair, seed in product(pairs, seeds):
        found[pair.name, seed] = ()
        if pair.name in failed:
            continue
        try:
            rows = [(output / FOLDER / file_of(source, pair, seed), source.learn) for source in pair.sources]
            found[pair.name, seed] = tuple(load_or_learn(file, learn, seed, console) for file, learn in rows)
        except Exception as error:  # a third party's environment raises what it likes
            failed[pair.name] = f"its source could not be learned: {type(error).__name__}: {' '.join(str(error).split())}"
            console.print(f"{pair.name}: {failed[pair.name]}", markup=False, soft_wrap=True)
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
