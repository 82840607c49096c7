"""Does exploration end? The iCub's tasks at the paper's breadth, at half and at twice that, with and without noise.

Run as ``python -m sb3_combrel.experiments.suite.breadths``; ``make icub-breadths`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.comparison.measures import episodes_to_reach
from sb3_combrel.comparison.tables import Table, write_csv
from sb3_combrel.experiments.tasks import icub_arm
from sb3_combrel.experiments.warm_up import warm_up
from sb3_combrel.runs.job import Job, Result
from sb3_combrel.runs.runner import Backend, check_all_succeeded, run_missing

BREADTHS = (0.05, 0.1, 0.2)
#: The resolution is the default one.
LEARNER: dict[str, Any] = {"degree": 0, **icub_arm.LEARNER}
TASKS = {"torso": icub_arm.SOURCE_ID, "arm": icub_arm.TARGET_ID}
#: Commands in which a task counts as learnt; the shortest plans that were found have 25 and 27.
LEARNT = {"torso": 27, "arm": 32}
#: Median of so many episodes must not exceed that.
WINDOW = 5
TITLE = "Both tasks of the iCub at several kernel breadths, with and without noise"


def jobs_of(n_seeds: int, n_episodes: int, breadths: Sequence[float]) -> list[Job]:
    """Make the runs, seed by seed; the group is the task, the method the whole setting."""
    return [
        Job(
            group=task,
            method=f"{task} {breadth:g}{noise}",
            seed=seed,
            env=env_id.replace("-v0", f"{noise.strip().title()}-v0"),
            n_episodes=n_episodes,
            max_episode_steps=icub_arm.MAX_EPISODE_STEPS,
            learner={**LEARNER, "model_breadth": breadth},
        )
        for seed in range(n_seeds)
        for (task, env_id), breadth, noise in product(TASKS.items(), breadths, ("", " noisy"))
    ]


def summary_of(results: Sequence[Result]) -> pd.DataFrame:
    """Return a row for each run: episodes until learnt (inf if never), median of the last ten, steps, and time of a step."""
    rows = []
    for result in results:
        steps = np.array(result.steps)
        episodes = episodes_to_reach(steps[None], LEARNT[result.group], WINDOW)[0]
        ms_per_step = 1000.0 * result.seconds / steps.sum()
        rows.append((result.method, result.seed, episodes, float(np.median(steps[-10:])), int(steps.sum()), ms_per_step))
    return pd.DataFrame(rows, columns=["setting", "seed", "episodes_until_learnt", "last_10_median", "steps", "ms_per_step"])


def table_of(summary: pd.DataFrame, n_episodes: int) -> Table:
    """Make a table with a row for each setting: episodes until learnt, commands in the end, and time of a step."""
    rows = []
    for setting, runs in summary.groupby("setting", sort=False):
        episodes, ends = runs["episodes_until_learnt"], runs["last_10_median"]
        learnt = f"{np.isfinite(episodes).sum()} of {len(runs)}"
        after = f"{episodes.median():.0f} ({episodes.min():.0f} to {episodes.max():.0f})"
        in_the_end = f"{ends.median():g} ({ends.min():g} to {ends.max():g})"
        steps, ms_per_step = f"{runs['steps'].median():,.0f}", f"{runs['ms_per_step'].median():.2f}"
        rows.append((str(setting), learnt, after, in_the_end, steps, ms_per_step))
    header = ("task, breadth", "learnt", "after episodes", "commands in the end", "steps in all", "ms a step")
    limits = " and ".join(map(str, LEARNT.values()))
    title = f"Fitted R-Max in {n_episodes} episodes: median of {WINDOW} episodes at most {limits} commands (torso, arm)"
    return Table(title, header, rows)


def breadths(
    output: Path = Path("breadths_experiment"),
    seeds: int = 5,
    episodes: int = 300,
    breadths: tuple[float, ...] = BREADTHS,
    workers: int | None = None,
) -> None:
    """Learn both tasks in every setting, and write ``summary.csv`` and ``tables.md``.

    :param output: folder for all results; a later call goes on from there
    :param seeds: runs of each setting, with the seeds from 0 on
    :param episodes: episodes of each run
    :param breadths: values of model_breadth
    :param workers: processes at a time; one a core by default
    :raises ValueError: if a number is not positive
    """
    for name, number in {"seeds": seeds, "episodes": episodes}.items():
        check_count(name, number)
    for breadth in breadths:
        check_positive("breadths", breadth)
    console = Console()
    warm_up()
    results = run_missing(jobs_of(seeds, episodes, breadths), output, Backend(n_jobs=workers), console)
    check_all_succeeded(results)
    summary = summary_of(results)
    as_text = {"episodes_until_learnt": summary["episodes_until_learnt"].map("{:.0f}".format)}
    write_csv(summary.round({"ms_per_step": 2}).assign(**as_text), output / "summary.csv")
    table = table_of(summary, episodes)
    (output / "tables.md").write_text(f"# {TITLE}\n\n{table.as_markdown()}")
    console.print(table.for_terminal())


if __name__ == "__main__":
    import tyro

    tyro.cli(breadths)
