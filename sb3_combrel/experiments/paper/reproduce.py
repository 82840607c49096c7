"""The command ``sb3-combrel reproduce``: carries out the runs that figures and tables need, and makes these."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_combrel import __version__
from sb3_combrel.common.checks import check_count
from sb3_combrel.common.files import write_whole
from sb3_combrel.experiments.engines import JobError, carry_out_on, check_engine
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baseline_runs import baseline_runs, carry_out_baseline
from sb3_combrel.experiments.paper.diagnosis import diagnosis_jobs
from sb3_combrel.experiments.paper.domains import DOMAINS, SETTINGS, Domain
from sb3_combrel.experiments.paper.plan import BASELINES, DIAGNOSIS, frequent_mapping, jobs_of, methods_of, targets_of
from sb3_combrel.experiments.paper.report import write_report
from sb3_combrel.experiments.paper.runs import AnyJob, Result, ResultFiles, carry_out
from sb3_combrel.experiments.paper.sources import prepare_sources

SETTINGS_FILE = "settings.json"
#: Where a run's exception is kept with its traceback: on the worker it is lost.
TRACEBACK_FILE = "error.txt"
OUTPUT = "reproduction"


@dataclass(frozen=True)
class Engine:
    """
    Where runs are carried out.

    :param name: "joblib" for local processes, "ray" or "dask" for a running cluster
    :param n_jobs: local processes at a time; None: one a core
    :param address: of the cluster
    """

    name: str = "joblib"
    n_jobs: int | None = None
    address: str | None = None

    def carry_out(self, function: Callable[[Any], Result], jobs: Sequence[Any]) -> Generator[tuple[int, Result], None, None]:
        """Carry out jobs by a function of one; yield the place of each and its result as it is done."""
        return carry_out_on(self.name, function, jobs, n_jobs=self.n_jobs, address=self.address)


LOCAL = Engine()


def reproduce(
    target: str,
    *,
    setting: str = "paper",
    runs: int | None = None,
    episodes: int | None = None,
    output: Path | None = None,
    engine: Engine = LOCAL,
    console: Console | None = None,
) -> list[Path]:
    """
    Carry out the runs that a figure or table needs, unless they were carried out before, and make it.

    :param target: name of a figure or table, or "all"
    :param setting: "paper", "explore" or "best"
    :param runs: of each method; None: as many as in the paper
    :param episodes: of each run; None: 200 for Mountain Car, 300 for the iCub
    :param output: folder for all results; None: ``reproduction/<setting>``
    :param engine: where the runs are carried out
    :param console: where to write; None for the standard output
    :return: the files made
    :raises ValueError: if an argument is unknown or out of range, or the folder has results of other settings
    :raises ConnectionError: if no cluster answers at the engine's address
    :raises JobError: if a run raises an exception, or its workers died too often
    """
    if setting not in SETTINGS:
        raise ValueError(f"setting must be one of {', '.join(SETTINGS)}, got {setting!r}")
    for name, number in (("runs", runs), ("episodes", episodes), ("jobs", engine.n_jobs)):
        check_count(name, number, none_allowed=True)
    targets = targets_of(target, setting)
    # Before anything is learned or written.
    check_engine(engine.name, n_jobs=engine.n_jobs, address=engine.address)
    console = console or Console()
    output = output or Path(OUTPUT) / setting
    domains = [domain for domain in DOMAINS.values() if any(domain.name in each.methods for each in targets)]
    prepare_folder(output, setting, {domain.name: episodes or domain.n_episodes for domain in domains})
    files = ResultFiles(output)
    results: dict[str, list[Result]] = {}
    for domain in domains:
        methods = methods_of(targets, domain, setting)
        counts = runs or domain.n_runs, episodes or domain.n_episodes
        results[domain.name] = _results_of(domain, setting, methods, counts, files, engine, console)
        wanted = {each.name for each in targets if domain.name in each.methods}
        if DIAGNOSIS in wanted:
            jobs = diagnosis_jobs(domain, setting, prepare_sources(domain, output, console), *counts)
            carry_out_missing(jobs, files, engine, console)
            results[domain.name] += files.read_all(jobs)
        if BASELINES in wanted:
            others = baseline_runs(domain, setting, prepare_sources(domain, output, console), runs, counts[1])
            carry_out_missing(others, files, engine, console, carry_out_baseline)
            results[domain.name] += files.read_all(others)
    return write_report(targets, setting, results, output, console)


def _results_of(
    domain: Domain,
    setting: str,
    methods: Sequence[str],
    counts: tuple[int, int],
    files: ResultFiles,
    engine: Engine,
    console: Console,
) -> list[Result]:
    """Carry out what is missing of a domain's runs and return the results of all."""
    sources = prepare_sources(domain, files.folder, console)
    first = [name for name in methods if name != m.TIMBREL_FREQUENT]
    jobs = jobs_of(domain, setting, first, sources, *counts)
    carry_out_missing(jobs, files, engine, console)
    if m.TIMBREL_FREQUENT in methods:
        # It takes the mapping that COMBREL used most in all of its runs.
        sources = replace(sources, frequent=frequent_mapping(files.read_all(jobs), domain, sources))
        console.print(f"{m.TIMBREL_FREQUENT}: {sources.frequent!r}", markup=False)
        more = jobs_of(domain, setting, [m.TIMBREL_FREQUENT], sources, *counts)
        carry_out_missing(more, files, engine, console)
        jobs = jobs + more
    return files.read_all(jobs)


def carry_out_missing(
    jobs: Sequence[AnyJob],
    files: ResultFiles,
    engine: Engine,
    console: Console,
    function: Callable[[Any], Result] = carry_out,
) -> None:
    """
    Carry out the jobs that have no result yet, and write each result as it arrives.

    :param jobs: the jobs, of one domain
    :param files: where results are
    :param engine: where to carry them out
    :param console: where to show the progress
    :param function: carries out one job
    """
    missing = [job for job in jobs if not files.is_complete(job)]
    if len(missing) < len(jobs):
        console.print(f"{len(jobs) - len(missing)} of {len(jobs)} runs were complete already.")
    if not missing:
        return
    try:
        _carry_out(jobs, missing, files, engine, console, function)
    except JobError as error:
        path = files.folder / TRACEBACK_FILE
        write_whole(path, f"{error}\n".encode())
        raise JobError(error.name, f"{' '.join(error.reason.split())} (traceback: {path})") from error


def _carry_out(
    jobs: Sequence[AnyJob],
    missing: Sequence[AnyJob],
    files: ResultFiles,
    engine: Engine,
    console: Console,
    function: Callable[[Any], Result],
) -> None:
    with _progress_of(jobs, missing, console) as advance, closing(engine.carry_out(function, missing)) as results:
        for place, result in results:
            files.write(result)
            advance(missing[place], result)


@contextmanager
def _progress_of(
    jobs: Sequence[AnyJob], missing: Sequence[AnyJob], console: Console
) -> Iterator[Callable[[AnyJob, Result], None]]:
    """Show a bar for each method; where no bars can be drawn, as in a log file, a line for each run."""
    columns = (
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        n_runs = {job.method: sum(each.method == job.method for each in jobs) for job in jobs}
        n_missing = {method: sum(job.method == method for job in missing) for method in n_runs}
        bars = {method: progress.add_task(method, total=n, completed=n - n_missing[method]) for method, n in n_runs.items()}

        def advance(job: AnyJob, result: Result) -> None:
            progress.advance(bars[job.method])
            if not console.is_terminal:
                console.print(
                    f"  {job.domain}, {job.method}, seed {job.seed}: {sum(result.steps):,} steps, {result.seconds[0]:.0f} s"
                )

        yield advance


def prepare_folder(output: Path, setting: str, episodes: dict[str, int]) -> None:
    """
    Prepare the folder for results; those of an earlier call with the same settings are kept.

    :param output: the folder
    :param setting: name of the setting
    :param episodes: episodes of each run, by domain
    :raises ValueError: if it has results of other settings, or files that are not results of this command
    """
    file = output / SETTINGS_FILE
    if output.exists() and not file.exists() and any(output.iterdir()):
        raise ValueError(f"{output} has files that are not results of this command; choose another --output")
    before = _settings_in(file) if file.exists() else {}
    now: dict[str, Any] = {"version": __version__, "setting": setting}
    now |= {f"episodes of {name}": n for name, n in episodes.items()}
    now |= {f"arguments in {name}": _plain(DOMAINS[name], setting) for name in episodes}
    other = [f"{key} was {before[key]!r} and is {now[key]!r}" for key in now if key in before and before[key] != now[key]]
    if other:
        raise ValueError(f"{output} has results of other settings ({'; '.join(other)}); use another --output")
    write_whole(file, (json.dumps({**before, **now}, indent=2) + "\n").encode())


def _settings_in(file: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(file.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{file} is damaged ({error}), so nobody knows of which settings its folder has results; use another --output"
        ) from error


def _plain(domain: Domain, setting: str) -> dict[str, Any]:
    """What the results of a domain depend on, as JSON represents it."""
    return dict(json.loads(json.dumps({**vars(domain.settings[setting]), "first_seed": domain.first_seed})))
