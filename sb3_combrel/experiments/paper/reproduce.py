"""The command ``sb3-combrel reproduce``: carries out the runs that figures and tables need, and makes these."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from sb3_combrel import __version__
from sb3_combrel.common.checks import check_count
from sb3_combrel.experiments.carrying_out import LOCAL, Engine, carry_out_missing
from sb3_combrel.experiments.output_folder import prepare_folder
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baseline_runs import baseline_runs, carry_out_baseline
from sb3_combrel.experiments.paper.diagnosis import diagnosis_jobs
from sb3_combrel.experiments.paper.domains import DOMAINS, SETTINGS, Domain
from sb3_combrel.experiments.paper.plan import BASELINES, DIAGNOSIS, frequent_mapping, jobs_of, methods_of, targets_of
from sb3_combrel.experiments.paper.report import write_report
from sb3_combrel.experiments.paper.runs import Result, ResultFiles, carry_out
from sb3_combrel.experiments.paper.sources import prepare_sources

OUTPUT = "reproduction"


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
    engine.check()
    console = console or Console()
    output = output or Path(OUTPUT) / setting
    domains = [domain for domain in DOMAINS.values() if any(domain.name in each.methods for each in targets)]
    prepare_folder(output, _settings(setting, {domain.name: episodes or domain.n_episodes for domain in domains}))
    files = ResultFiles(output)
    results: dict[str, list[Result]] = {}
    for domain in domains:
        methods = methods_of(targets, domain, setting)
        counts = runs or domain.n_runs, episodes or domain.n_episodes
        results[domain.name] = _results_of(domain, setting, methods, counts, files, engine, console)
        wanted = {each.name for each in targets if domain.name in each.methods}
        if DIAGNOSIS in wanted:
            jobs = diagnosis_jobs(domain, setting, prepare_sources(domain, output, console), *counts)
            carry_out_missing(jobs, files, engine, console, carry_out)
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
    carry_out_missing(jobs, files, engine, console, carry_out)
    if m.TIMBREL_FREQUENT in methods:
        # It takes the mapping that COMBREL used most in all of its runs.
        sources = replace(sources, frequent=frequent_mapping(files.read_all(jobs), domain, sources))
        console.print(f"{m.TIMBREL_FREQUENT}: {sources.frequent!r}", markup=False)
        more = jobs_of(domain, setting, [m.TIMBREL_FREQUENT], sources, *counts)
        carry_out_missing(more, files, engine, console, carry_out)
        jobs = jobs + more
    return files.read_all(jobs)


def _settings(setting: str, episodes: dict[str, int]) -> dict[str, Any]:
    """What the results in a folder depend on; ``episodes`` of each run, by domain."""
    now: dict[str, Any] = {"version": __version__, "setting": setting}
    now |= {f"episodes of {name}": n for name, n in episodes.items()}
    return now | {f"arguments in {name}": _plain(DOMAINS[name], setting) for name in episodes}


def _plain(domain: Domain, setting: str) -> dict[str, Any]:
    """What the results of a domain depend on, as JSON represents it."""
    return dict(json.loads(json.dumps({**vars(domain.settings[setting]), "first_seed": domain.first_seed})))
