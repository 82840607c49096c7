"""The command ``sb3-combrel reproduce``: carries out the runs that figures and tables need, and makes these."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from sb3_combrel import InterTaskMapping, __version__
from sb3_combrel.common.checks import check_count
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baselines import baseline_jobs
from sb3_combrel.experiments.paper.domains import DOMAINS, SETTINGS, Domain
from sb3_combrel.experiments.paper.jobs import diagnosis_jobs, jobs_of
from sb3_combrel.experiments.paper.mappings import most_frequent_mapping
from sb3_combrel.experiments.paper.report import write_report
from sb3_combrel.experiments.paper.targets import BASELINES, DIAGNOSIS, methods_of, targets_of
from sb3_combrel.runs.job import Job, Result
from sb3_combrel.runs.runner import (
    LOCAL,
    Backend,
    check_all_succeeded,
    prepare_folder,
    read_result,
    read_results,
    result_file,
    run_missing,
)

OUTPUT = "reproduction"


def reproduce(
    target: str,
    *,
    setting: str = "paper",
    runs: int | None = None,
    episodes: int | None = None,
    output: Path | None = None,
    backend: Backend = LOCAL,
    console: Console | None = None,
) -> list[Path]:
    """Carry out the runs that a figure or table needs, unless they were carried out before, and make it.

    :param target: name of a figure or table, or "all"
    :param setting: "paper" or "best"
    :param runs: of each method; None: 10 on the iCub, on Mountain Car 5 in setting "paper", 15 in "best"
    :param episodes: of each run; None: 200 for Mountain Car, 300 for the iCub
    :param output: folder for all results; None: ``reproduction/<setting>``
    :param backend: where the runs are carried out
    :param console: where to write; None for the standard output
    :return: the files made
    :raises ValueError: if an argument is unknown or out of range, or the folder has results of other settings
    :raises ConnectionError: if no cluster answers at the backend's address
    :raises JobError: if a run raises an exception, or its workers died too often
    """
    if setting not in SETTINGS:
        raise ValueError(f"setting must be one of {', '.join(SETTINGS)}, got {setting!r}{did_you_mean(setting, SETTINGS)}")
    for name, number in (("runs", runs), ("episodes", episodes)):
        check_count(name, number, none_allowed=True)
    targets = targets_of(target, setting)
    backend.check()
    console = console or Console()
    output = output or Path(OUTPUT) / setting
    domains = [domain for domain in DOMAINS.values() if any(domain.name in each.methods for each in targets)]
    prepare_folder(output)
    jobs: list[Job] = []
    sources = {}
    for domain in domains:
        n_episodes = episodes or domain.n_episodes
        _check_folder(output, domain.name, setting, n_episodes)
        seeds = range(domain.first_seed, domain.first_seed + (runs or domain.settings[setting].n_runs))
        sources[domain.name] = own = m.prepare_sources(domain, seeds, output, backend, console)
        methods = [name for name in methods_of(targets, domain, setting) if name != m.TIMBREL_FREQUENT]
        wanted = {each.name for each in targets if domain.name in each.methods}
        jobs += jobs_of(domain, setting, methods, own, n_episodes)
        if DIAGNOSIS in wanted:
            jobs += diagnosis_jobs(domain, setting, own, n_episodes)
        if BASELINES in wanted:
            jobs += baseline_jobs(domain, setting, {seed: each.own for seed, each in own.items()}, n_episodes)
    results = run_missing(jobs, output, backend, console)
    check_all_succeeded(results)
    for domain in domains:
        if m.TIMBREL_FREQUENT in methods_of(targets, domain, setting):
            frequent = frequent_mapping(results, domain, sources[domain.name])
            console.print(f"{m.TIMBREL_FREQUENT}: {frequent!r}", markup=False)
            with_frequent = {seed: replace(own, frequent=frequent) for seed, own in sources[domain.name].items()}
            of_frequent = jobs_of(domain, setting, [m.TIMBREL_FREQUENT], with_frequent, episodes or domain.n_episodes)
            forget_other_mappings(of_frequent, output)
            results += run_missing(of_frequent, output, backend, console)
            check_all_succeeded(results)
    return write_report(targets, setting, results, output, console)


def _check_folder(output: Path, domain: str, setting: str, n_episodes: int) -> None:
    """Raise an error if the folder has runs of a domain's methods that belong into other figures and tables."""
    now = {"version": __version__, "setting": setting, "n_episodes": n_episodes}
    for before, result in read_results(output, f"{domain}_"):
        other = [f"{key} was {before.get(key)!r} and is {now[key]!r}" for key in now if before.get(key) != now[key]]
        if result.method in m.METHODS and other:
            what = f"results of other settings ({result.name}: {'; '.join(other)})"
            raise ValueError(f"{output} has {what}; use another --output")


def forget_other_mappings(jobs: Sequence[Job], output: Path) -> None:
    """Remove results of the mapping that was the most frequent one in fewer runs, or other ones."""
    for job in jobs:
        read = read_result(output, job.name)
        if read is not None and read[0]["transfer"] != job.settings()["transfer"]:
            result_file(output, job.name).unlink()


def frequent_mapping(results: Iterable[Result], domain: Domain, sources: Mapping[int, m.Sources]) -> InterTaskMapping:
    """The mapping that COMBREL used most, over all its runs (Section 5.2)."""
    of_combrel = [each for each in results if (each.group, each.method) == (domain.name, m.COMBREL_PLAIN)]
    uses = [use for result in of_combrel for use in result.more["uses"]]
    if not uses:
        none = f"{m.COMBREL_PLAIN} has used no mapping within episodes={len(of_combrel[0].steps)}"
        raise ValueError(f"{none}, so {m.TIMBREL_FREQUENT} has no mapping; use more --episodes")
    own = next(iter(sources.values())).own
    return most_frequent_mapping(uses, (own.state_names, own.action_names), domain.target_names())
