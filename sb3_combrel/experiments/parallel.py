"""Several learning runs at once, with a display of their progress."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from sb3_combrel.experiments.runs import Run, carry_out

UPDATE_SECONDS = 0.5


def carry_out_all(runs: Sequence[Run], workers: int, console: Console) -> None:
    """
    Carry out the runs that are not complete yet, each in one thread of a process of its own.

    :param runs: what to do, in this order
    :param workers: processes at a time
    :param console: where to show the progress
    """
    missing = [run for run in runs if not run.is_complete()]
    if len(missing) < len(runs):
        console.print(f"{len(runs) - len(missing)} of {len(runs)} runs were complete already.")
    if not missing:
        return
    with _progress_of(runs, console), parallel_config(backend="loky", inner_max_num_threads=1):
        jobs = (delayed(carry_out)(run) for run in missing)
        for run in Parallel(n_jobs=workers, return_as="generator_unordered")(jobs):
            # Where no bars can be drawn, as in a log file, print lines.
            if not console.is_terminal:
                console.print(f"  {run.method}, seed {run.seed}: {run.steps().sum():,} steps in {run.n_episodes} episodes")


@contextmanager
def _progress_of(runs: Sequence[Run], console: Console) -> Iterator[None]:
    """Show one bar for each method, from the files that the runs write."""
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes, {task.fields[steps]:,} steps"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        by_method: dict[str, list[Run]] = {}
        for run in runs:
            by_method.setdefault(run.method, []).append(run)
        bars = {
            method: progress.add_task(method, total=sum(run.n_episodes for run in its_runs), steps=0)
            for method, its_runs in by_method.items()
        }

        def update() -> None:
            for method, its_runs in by_method.items():
                steps = [run.steps() for run in its_runs]
                n_episodes, n_steps = sum(map(len, steps)), sum(int(s.sum()) for s in steps)
                progress.update(bars[method], completed=n_episodes, steps=n_steps)

        over = threading.Event()

        def keep_updating() -> None:
            while not over.wait(UPDATE_SECONDS):
                update()

        watcher = threading.Thread(target=keep_updating, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()
            update()
