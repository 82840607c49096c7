"""The suite by which settings of the learner and transfer methods are compared: tasks, variants, seeds.

Run as ``python -m sb3_combrel.experiments.suite.command --tasks MountainCar4D CartPole-v1 --variants default
b0.3:model_breadth=0.3 --seeds 0-9 --jobs 2 --output suite_output``; a later call with the same folder does what is missing.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Console

from sb3_combrel.common.checks import check_count
from sb3_combrel.common.files import write_whole
from sb3_combrel.comparison.statistics import TESTS
from sb3_combrel.comparison.tables import write_tables
from sb3_combrel.experiments.suite.report import cells_of, frozen_table, headline_table, task_table
from sb3_combrel.experiments.suite.runs import Variant, suite_runs, write_csv_files
from sb3_combrel.experiments.suite.tasks import Task, tasks_of
from sb3_combrel.experiments.suite.transfers import check_transfer
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.runs.runner import Backend, check_all_succeeded, prepare_folder, run_missing
from sb3_combrel.runs.source_files import FOLDER, SourceJob, load_or_learn

TABLES, BY_TASK = "tables", "tasks.md"
DEFAULT = "default"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]*")


def variant_of(text: str) -> Variant:
    """Read a variant from the command line.

    :param text: ``default``; ``name:key=value,key=value``; or a JSON object ``{"name": ..., key: value, ...}``. Keys are
        arguments of :class:`~sb3_combrel.FittedRMax`, and ``transfer``; values are JSON, or text if they are not.
    """
    if text.lstrip().startswith("{"):
        arguments = json.loads(text)
        name = arguments.pop("name", None)
    else:
        name, _, rest = text.partition(":")
        pairs = [pair.partition("=") for pair in rest.split(",") if pair]
        if any(not equals for _, equals, _ in pairs):
            raise ValueError(f"variants must look like name:key=value,key=value, got {text!r}")
        arguments = {key.strip(): _value(value) for key, _, value in pairs}
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"a variant's name must be letters, digits, '.', '+' or '-', got {name!r} in {text!r}")
    if not arguments and name != DEFAULT:
        raise ValueError(f"a variant without arguments must be called {DEFAULT!r}, got {text!r}")
    transfer = arguments.pop("transfer", None)
    unknown = [key for key in arguments if key not in (*FittedRMaxSettings.names(), "policy_kwargs")]
    if unknown:
        raise ValueError(f"FittedRMax has no argument {', '.join(unknown)} (in the variant {text!r})")
    return Variant(name, arguments, transfer)


def seeds_of(text: str, first_seed: int = 0) -> list[int]:
    """Read seeds such as ``0-9`` or ``0,2,5-7`` from the command line; ``first_seed`` is added to each."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"seeds must be numbers and ranges, such as 0-9 or 0,2,5-7, got {text!r}")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return [first_seed + seed for seed in dict.fromkeys(seeds)]


def run_suite(
    output: Path,
    tasks: Sequence[Task],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    jobs: int | None = 1,
    evaluation_episodes: int = 100,
    reference: str | None = None,
    test: str = "welch",
    console: Console | None = None,
) -> None:
    """Learn each task with each variant and seed, and write ``runs.csv``, ``episodes.csv``, ``tables.md`` and ``tasks.md``.

    What is complete is not done again; all runs in the folder are in the CSV files, the tables are of these arguments' runs.

    :raises ValueError: if an argument is out of its range, or the folder has a run with the same name and other settings
    """
    check_count("jobs", jobs, none_allowed=True)
    check_count("evaluation_episodes", evaluation_episodes)
    names = [variant.name for variant in variants]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"variants must be at least one, with different names, got {names!r}")
    reference = names[0] if reference is None else reference
    if reference not in names:
        raise ValueError(f"reference must be the name of a variant, one of {', '.join(names)}, got {reference!r}")
    if test not in TESTS:
        raise ValueError(f"test must be one of {', '.join(TESTS)}, got {test!r}")
    for variant, task in product(variants, tasks):
        if variant.transfer is not None:
            check_transfer(variant.transfer, task)
    console = console or Console()
    prepare_folder(output)
    wanted = {source.name: source for task in tasks for own in variants if (source := own.source(task)) is not None}
    files = [
        SourceJob(group=source.name, seed=seed, path=output / FOLDER / f"{source.name}_seed{seed}.npz", learn=source.learn)
        for seed in seeds
        for source in wanted.values()
    ]
    backend = Backend(n_jobs=jobs)
    sources = dict(zip([(file.group, file.seed) for file in files], load_or_learn(files, backend, console), strict=True))
    runs = suite_runs(tasks, variants, seeds, evaluation_episodes, sources)
    results = run_missing(runs, output, backend, console)
    write_csv_files(output)
    check_all_succeeded(results)
    cells = cells_of([result.more["row"] for result in results], tasks, names, reference, test)
    write_tables([headline_table(cells, tasks, names, reference), frozen_table(cells, tasks, names)], output / TABLES, console)
    by_task = [task_table(cells, task, names, f"p against {reference}") for task in tasks]
    write_whole(output / BY_TASK, "\n".join(table.as_markdown() for table in by_task).encode())


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text.strip()


def suite(
    tasks: list[str] = ["all"],  # noqa: B006 - tyro shows it, nobody changes it
    variants: list[str] = [DEFAULT],  # noqa: B006
    seeds: str = "0-9",
    first_seed: int = 0,
    jobs: int | None = None,
    evaluation_episodes: int = 100,
    reference: str | None = None,
    test: str = "welch",
    output: Path = Path("suite_output"),
) -> None:
    """Compare settings of Fitted R-Max and transfer methods over tasks.

    :param tasks: names of tasks, or all
    :param variants: default, name:key=value,key=value, or JSON with a name
    :param seeds: numbers and ranges, such as 0-9 or 0,2,5-7
    :param first_seed: is added to each of the seeds
    :param jobs: processes at a time; one a core by default
    :param evaluation_episodes: played after learning
    :param reference: the variant that the others are compared with; the first by default
    :param test: welch, mann-whitney or permutation
    :param output: folder for all results; a later call goes on from there
    """
    chosen, numbers = [variant_of(text) for text in variants], seeds_of(seeds, first_seed)
    run_suite(output, tasks_of(tasks), chosen, numbers, jobs, evaluation_episodes, reference, test)


def main() -> None:
    """Run the command line."""
    import tyro

    try:
        tyro.cli(suite, config=(tyro.conf.FlagCreatePairsOff,))
    except ValueError as error:
        sys.exit(f"suite: {error}")


if __name__ == "__main__":
    main()
