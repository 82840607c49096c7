"""Does exploration end? The iCub's tasks at the paper's breadth, at half and at twice that, with and without noise.

Run as ``python -m sb3_combrel.experiments.suite.breadths``; ``make icub-breadths`` does.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import cpu_count
from rich.console import Console

from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.comparison.measures import episodes_to_reach
from sb3_combrel.comparison.tables import Table
from sb3_combrel.experiments.demo import prepare_folder
from sb3_combrel.experiments.parallel import carry_out_all
from sb3_combrel.experiments.runs import Run
from sb3_combrel.experiments.tasks import icub_arm
from sb3_combrel.experiments.tasks.icub_arm import MAX_EPISODE_STEPS, SOURCE_ID, TARGET_ID
from sb3_combrel.experiments.warm_up import warm_up

BREADTHS = (0.05, 0.1, 0.2)
#: The resolution is the default one.
LEARNER: dict[str, Any] = {"degree": 0, **icub_arm.LEARNER}
#: Commands in which a task counts as learnt; the shortest plans that were found have 25 and 27.
LEARNT = {SOURCE_ID: 27, TARGET_ID: 32}
#: Median of so many episodes must not exceed that.
WINDOW = 5
TITLE = "Both tasks of the iCub at several kernel breadths, with and without noise"


class Outcome(NamedTuple):
    """
    The outcome of one run.

    :param episodes: until the median of :data:`WINDOW` episodes was as in :data:`LEARNT`; inf if it never was
    :param in_the_end: median of the last ten episodes
    :param steps: environment steps of all episodes
    :param milliseconds: time of a step, simulation included, under whatever other load there was
    """

    episodes: float
    in_the_end: float
    steps: int
    milliseconds: float


def outcome(run: Run) -> Outcome:
    """Compute the outcome of a complete run."""
    steps = run.steps()
    task = run.env_id.replace("Noisy", "")
    seconds = float(run.episodes()[run.n_episodes - 1]["seconds"])
    return Outcome(
        float(episodes_to_reach(steps[None], LEARNT[task], WINDOW)[0]),
        float(np.median(steps[-10:])),
        int(steps.sum()),
        1000.0 * seconds / steps.sum(),
    )


def run_experiment(
    output: Path, n_seeds: int, n_episodes: int, breadths: Sequence[float], workers: int, console: Console | None = None
) -> None:
    """
    Learn both tasks in every setting, and write ``summary.csv`` and ``tables.md``; what is complete is not done again.

    :param output: folder for all results
    :param n_seeds: runs of each setting, with the seeds from 0 on
    :param n_episodes: episodes of each run
    :param breadths: values of ``model_breadth``
    :param workers: processes at a time
    :param console: where to write; None for the standard output
    :raises ValueError: if a number is not positive
    """
    for name, number in {"n_seeds": n_seeds, "n_episodes": n_episodes, "workers": workers}.items():
        check_count(name, number)
    for breadth in breadths:
        check_positive("breadths", breadth)
    console = console or Console()
    prepare_folder(output, {"tasks": sorted(LEARNT), "learner": LEARNER})
    warm_up()
    runs = [
        Run(output, name, seed, env_id, n_episodes, MAX_EPISODE_STEPS, None, {**LEARNER, "model_breadth": breadth})
        for seed in range(n_seeds)
        for name, env_id, breadth in settings(breadths)
    ]
    carry_out_all(runs, workers, console)
    write_summary(runs, output / "summary.csv")
    table = table_of(runs)
    (output / "tables.md").write_text(f"# {TITLE}\n\n{table.as_markdown()}")
    console.print(table.for_terminal())


def settings(breadths: Sequence[float]) -> list[tuple[str, str, float]]:
    """Return name, task and breadth of every setting."""
    tasks = {"torso": SOURCE_ID, "arm": TARGET_ID}
    return [
        (f"{task} {breadth:g}{noise}", env_id.replace("-v0", f"{noise.strip().title()}-v0"), breadth)
        for (task, env_id), breadth, noise in product(tasks.items(), breadths, ("", " noisy"))
    ]


def write_summary(runs: Sequence[Run], path: Path) -> None:
    """Write one line for each run."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("setting", "seed", "episodes_until_learnt", "last_10_median", "steps", "ms_per_step"))
        for run in runs:
            found = outcome(run)
            writer.writerow((run.method, run.seed, f"{found.episodes:.0f}", *found[1:3], f"{found.milliseconds:.2f}"))


def table_of(runs: Sequence[Run]) -> Table:
    """Make a table with a row for each setting: episodes until learnt, commands in the end, and time of a step."""
    rows = []
    for setting in dict.fromkeys(run.method for run in runs):
        found = [outcome(run) for run in runs if run.method == setting]
        episodes, ends, steps, milliseconds = (np.array(column) for column in zip(*found, strict=True))
        rows.append(
            (
                setting,
                f"{np.isfinite(episodes).sum()} of {len(found)}",
                f"{np.median(episodes):.0f} ({episodes.min():.0f} to {episodes.max():.0f})",
                f"{np.median(ends):g} ({ends.min():g} to {ends.max():g})",
                f"{np.median(steps):,.0f}",
                f"{np.median(milliseconds):.2f}",
            )
        )
    header = ("task, breadth", "learnt", "after episodes", "commands in the end", "steps in all", "ms a step")
    limits = " and ".join(str(n) for n in LEARNT.values())
    title = (
        f"Fitted R-Max in {runs[0].n_episodes} episodes: median of {WINDOW} episodes at most {limits} commands (torso, arm)"
    )
    return Table(title, header, rows)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="The iCub's tasks at several breadths, with and without noise.")
    parser.add_argument(
        "--output", type=Path, default=Path("breadths_experiment"), help="a later call continues from the results in it"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--breadths", type=float, nargs="+", default=BREADTHS)
    parser.add_argument("--workers", type=int, default=None, help="processes at a time; one a core by default")
    arguments = parser.parse_args()
    workers = arguments.workers or cpu_count()
    run_experiment(arguments.output, arguments.seeds, arguments.episodes, arguments.breadths, workers)


if __name__ == "__main__":
    main()
