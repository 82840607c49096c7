"""The suite by which settings of the learner and transfer methods are compared: tasks, variants, seeds.

Run as ``python -m sb3_combrel.experiments.suite.command --tasks MountainCar4D CartPole-v1 --variants default b0.3:model_breadth=0.3
--seeds 0-9 --jobs 2 --output suite_output``; a later call with the same folder does what is missing.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from rich.progress import Progress

from sb3_combrel.common.checks import check_count
from sb3_combrel.comparison.statistics import TESTS
from sb3_combrel.comparison.tables import write_csv
from sb3_combrel.experiments.suite.report import cells_of, format_number, frozen_table, overview_table, task_table
from sb3_combrel.experiments.suite.runs import SOURCES, SuiteRun, Variant, carry_out, records
from sb3_combrel.experiments.suite.tasks import TASKS, Task, tasks_of
from sb3_combrel.experiments.suite.transfers import check_transfer
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings

TABLES = "tables.md"
DEFAULT = "default"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]*")


def variant_of(text: str) -> Variant:
    """
    Read a variant from the command line.

    :param text: ``default``; ``name:key=value,key=value``; or a JSON object ``{"name": ..., key: value, ...}``. Keys are
        arguments of :class:`~sb3_combrel.FittedRMax`, and ``transfer``; values are JSON, or text if they are not.
    :raises ValueError: if it is none of these, or an argument is unknown
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
    """
    Read seeds from the command line.

    :param text: numbers and ranges, such as ``0-9`` or ``0,2,5-7``
    :param first_seed: is added to each
    :raises ValueError: if it is not that
    """
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
    jobs: int = 1,
    evaluation_episodes: int = 100,
    reference: str | None = None,
    test: str = "welch",
    console: Console | None = None,
) -> None:
    """
    Learn each task with each variant and seed, and write ``runs.csv``, ``episodes.csv`` and ``tables.md``.

    What is complete is not done again; all runs in the folder are in the CSV files, the tables are of these arguments' runs.

    :param output: folder for all results
    :param tasks: what to learn
    :param variants: the settings to compare, with different names
    :param seeds: seeds of the runs
    :param jobs: processes at a time
    :param evaluation_episodes: episodes to play after learning
    :param reference: name of the variant that the others are compared with; None for the first
    :param test: ``"welch"`` or ``"mann-whitney"``
    :param console: where to write; None for the standard output
    :raises ValueError: if an argument is out of its range, or the folder has a run with the same name and other settings
    """
    names = [variant.name for variant in variants]
    reference = names[0] if reference is None and names else reference
    _check(variants, tasks, jobs, evaluation_episodes, reference, test)
    console = console or Console()
    runs = [SuiteRun(output, task, own, seed, evaluation_episodes) for seed in seeds for task in tasks for own in variants]
    missing = [run for run in runs if not run.is_complete()]
    if len(missing) < len(runs):
        console.print(f"{len(runs) - len(missing)} of {len(runs)} runs were complete already.")
    _learn_sources(missing, console)
    _carry_out_all(missing, jobs, console)
    write_csv(output)
    _write_tables(runs, tasks, names, str(reference), test, console)


def _check(
    variants: Sequence[Variant],
    tasks: Sequence[Task],
    jobs: int,
    evaluation_episodes: int,
    reference: str | None,
    test: str,
) -> None:
    check_count("jobs", jobs)
    check_count("evaluation_episodes", evaluation_episodes)
    names = [variant.name for variant in variants]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"variants must be at least one, with different names, got {names!r}")
    if reference not in names:
        raise ValueError(f"reference must be the name of a variant, one of {', '.join(names)}, got {reference!r}")
    if test not in TESTS:
        raise ValueError(f"test must be one of {', '.join(TESTS)}, got {test!r}")
    for variant in variants:
        for task in tasks:
            if variant.transfer is not None:
                check_transfer(variant.transfer, task)


def _learn_sources(runs: Sequence[SuiteRun], console: Console) -> None:
    """Learn, once for all runs, the source tasks that they need."""
    for run in runs:
        source = run.source
        if source is not None and not run.file_of(source).exists():
            console.print(f"Learning the source task {source.name} ...")
            (run.folder / SOURCES).mkdir(parents=True, exist_ok=True)
            source.learn().save(run.file_of(source))


def _carry_out_all(runs: Sequence[SuiteRun], jobs: int, console: Console) -> None:
    """Carry out runs, each in one thread of a process of its own, and write the CSV files after each."""
    if not runs:
        return
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("runs", total=len(runs))
        with parallel_config(backend="loky", inner_max_num_threads=1):
            finished = Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(carry_out)(run) for run in runs)
            for number, run in enumerate(finished, 1):
                write_csv(run.folder)
                progress.update(bar, completed=number)
                console.print(f"[{number}/{len(runs)}] {_line(run)}", markup=False, highlight=False, soft_wrap=True)


def _line(run: SuiteRun) -> str:
    row = json.loads(run.file.read_text())["row"]
    values = [f"{key} {format_number(row[key])}" for key in dict.fromkeys((run.task.headline, "greedy_mean", "ms_per_step"))]
    return f"{run.task.name}, {run.variant.name}, seed {run.seed}: {', '.join(values)}"


def _write_tables(
    runs: Sequence[SuiteRun], tasks: Sequence[Task], variants: Sequence[str], reference: str, test: str, console: Console
) -> None:
    names = {run.name for run in runs}
    rows = [record["row"] for record in records(runs[0].folder) if record["row"]["run"] in names]
    cells = cells_of(rows, tasks, variants, reference, test)
    overview = overview_table(cells, tasks, variants)
    frozen = frozen_table(cells, tasks, variants)
    tables = [overview, frozen, *(task_table(cells, task, variants, f"p against {reference}") for task in tasks)]
    (runs[0].folder / TABLES).write_text("\n".join(table.as_markdown() for table in tables))
    console.print(overview.for_terminal())


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text.strip()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Compare settings of Fitted R-Max and transfer methods over tasks.")
    parser.add_argument("--tasks", nargs="+", default=["all"], help=f"'all' or some of {', '.join(TASKS)}")
    parser.add_argument(
        "--variants", nargs="+", default=[DEFAULT], help="default, name:key=value,key=value, or JSON with a name"
    )
    parser.add_argument("--seeds", default="0-9", help="numbers and ranges")
    parser.add_argument("--first-seed", type=int, default=0, help="is added to each of the seeds")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--evaluation-episodes", type=int, default=100, help="played after learning")
    parser.add_argument("--reference", default=None, help="the variant to compare with; the first if not given")
    parser.add_argument("--test", choices=TESTS, default="welch")
    parser.add_argument(
        "--output", type=Path, default=Path("suite_output"), help="a later call continues from the results in it"
    )
    given = parser.parse_args()
    try:
        tasks, variants = tasks_of(given.tasks), [variant_of(text) for text in given.variants]
        seeds = seeds_of(given.seeds, given.first_seed)
        run_suite(given.output, tasks, variants, seeds, given.jobs, given.evaluation_episodes, given.reference, given.test)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
