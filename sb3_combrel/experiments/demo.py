"""The demonstration: two-dimensional Mountain Car helps to learn the four-dimensional one."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from joblib import cpu_count
from rich.console import Console

import sb3_combrel
from sb3_combrel import FittedRMax, SourceInstances
from sb3_combrel.experiments import report
from sb3_combrel.experiments.figures import draw_learning_curves
from sb3_combrel.experiments.parallel import carry_out_all
from sb3_combrel.experiments.runs import Run
from sb3_combrel.experiments.tasks import mountain_car
from sb3_combrel.experiments.video import film, greedy_episode
from sb3_combrel.experiments.warm_up import warm_up
from sb3_combrel.runs.job import chosen_on_purpose, make_env

SETTINGS, SOURCE, RUNS, TENSORBOARD = "settings.json", "source.npz", "runs", "tensorboard"
FIGURE, TABLES, RESULTS = "learning_curves.png", "tables.md", "results.csv"
MODEL, VIDEO = "car.zip", "car.mp4"
#: All that the demonstration writes into its folder.
OUTPUTS = (SETTINGS, SOURCE, RUNS, TENSORBOARD, FIGURE, TABLES, RESULTS, MODEL, VIDEO)

FILMED = "COMBREL"
SOURCE_SEED = 0
#: Not the seed of any run.
EVALUATION_SEED = 1_000_000


def run_demo(
    output: Path,
    n_seeds: int,
    n_episodes: int,
    max_episode_steps: int,
    model_breadth: float | None = None,
    workers: int | None = None,
    fresh: bool = False,
    console: Console | None = None,
) -> None:
    """
    Learn the target task without transfer, with a random mapping, with TIMBREL and with COMBREL, and report the results.

    Runs that an earlier call has completed in the same folder are kept.

    :param output: folder for all results
    :param n_seeds: runs of each method
    :param n_episodes: episodes of each run
    :param max_episode_steps: steps after which an episode is cut off
    :param model_breadth: breadth of the learner's kernel; None for the learner's own
    :param workers: processes at a time; None for one a core
    :param fresh: delete the results in the folder first
    :param console: where to write; None for the standard output
    :raises ValueError: if a number is below 1, or the folder has results of other settings
    """
    workers = cpu_count() if workers is None else workers
    numbers = {"seeds": n_seeds, "episodes": n_episodes, "max_episode_steps": max_episode_steps, "workers": workers}
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    if model_breadth is not None and not model_breadth > 0.0:
        raise ValueError(f"model_breadth must be positive, got {model_breadth}")
    console = console or Console()
    learner = {**mountain_car.LEARNER, **({} if model_breadth is None else {"model_breadth": model_breadth})}
    prepare_folder(output, _settings(learner, max_episode_steps), fresh)
    source = _source(output / SOURCE, console)
    runs = [
        Run(output, method, seed, mountain_car.TARGET_ID, n_episodes, max_episode_steps, transfer, learner)
        for seed in range(n_seeds)
        for method, transfer in mountain_car.methods(source).items()
    ]
    if not all(run.is_complete() for run in runs):
        with console.status("Compiling; the first time this takes a while ..."):
            warm_up()
        console.print(f"Learning {mountain_car.TARGET_ID}: {n_seeds} runs of {n_episodes} episodes with each method ...")
    carry_out_all(runs, workers, console)
    _report(runs, output, console)
    shutil.copyfile(_best([run for run in runs if run.method == FILMED], console).model_file, output / MODEL)
    _film(output, max_episode_steps, console)
    _epilogue(output, n_seeds, console)


def prepare_folder(output: Path, settings: dict[str, Any], fresh: bool | None = None) -> None:
    """
    Prepare the folder for results; those of an earlier call with the same settings are kept.

    :param output: the folder
    :param settings: what the results depend on, as data that JSON can represent
    :param fresh: delete earlier results of the demonstration; nothing else is ever deleted. None: the command has no --fresh
    :raises ValueError: if there are results of other settings, or files that are not results of the command
    """
    file = output / SETTINGS
    if output.exists() and not file.exists() and any(output.iterdir()):
        raise ValueError(f"{output} has files that are not results of this command; choose another --output")
    if fresh:
        for name in OUTPUTS:
            path = output / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    elif file.exists():
        before = json.loads(file.read_text())
        other = sorted(key for key in {*before, *settings} if before.get(key) != settings.get(key))
        if other:
            differences = ", ".join(f"{key} was {before.get(key)!r} and is {settings.get(key)!r}" for key in other)
            remedy = "use another --output" if fresh is None else "use --fresh or another --output"
            raise ValueError(f"{output} has results of other settings ({differences}); {remedy}")
    output.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(".part")
    unfinished.write_text(json.dumps(settings, indent=2) + "\n")
    os.replace(unfinished, file)


def _settings(learner: dict[str, Any], max_episode_steps: int) -> dict[str, Any]:
    """Return what a run's results depend on, except for its seed and number of episodes."""
    return {
        "version": sb3_combrel.__version__,
        "source": mountain_car.SOURCE_ID,
        "target": mountain_car.TARGET_ID,
        "source_instances": mountain_car.N_INSTANCES,
        "source_seed": SOURCE_SEED,
        "learner": learner,
        "max_episode_steps": max_episode_steps,
    }


def _source(path: Path, console: Console) -> SourceInstances:
    if path.exists():
        return SourceInstances.load(path)
    with console.status(f"Learning the source task {mountain_car.SOURCE_ID} ..."):
        source = mountain_car.learn_source(SOURCE_SEED)
    source.save(path)
    console.print(f"Learned {mountain_car.SOURCE_ID} by Q-learning and kept {len(source)} instances.")
    return source


def _report(runs: Sequence[Run], output: Path, console: Console) -> None:
    steps = {
        method: np.array([run.steps() for run in runs if run.method == method])
        for method in dict.fromkeys(run.method for run in runs)
    }
    cap = runs[0].max_episode_steps
    title = "Mountain Car 4D, learned with 1000 instances of Mountain Car 2D"
    draw_learning_curves(steps, output / FIGURE, title, cap)
    report.write_results(runs, output / RESULTS)
    tables = [report.episodes_table(steps), report.savings_table(steps, mountain_car.NO_TRANSFER)]
    tables += [report.mappings_table(runs, method) for method in steps if method != mountain_car.NO_TRANSFER]
    note = f"An episode that doesn't reach the goal is cut off after {cap} steps and counts as {cap}."
    (output / TABLES).write_text("\n".join(table.as_markdown() for table in tables) + f"\n{note}\n")
    for table in tables:
        console.print(table.for_terminal())
    console.print(note)


def _best(runs: Sequence[Run], console: Console) -> Run:
    """Return the run whose model needs the fewest steps without exploring."""
    with console.status("Trying the trained cars ..."):
        steps = [_drive(run) for run in runs]
    best = int(np.argmin(steps))
    console.print(
        f"Driven without exploring, the trained {runs[0].method} cars need {', '.join(map(str, steps))} steps; "
        f"the video shows the one with seed {runs[best].seed}."
    )
    return runs[best]


def _drive(run: Run) -> int:
    with closing(make_env(run.env_id, max_episode_steps=run.max_episode_steps)) as env:
        return sum(1 for _ in greedy_episode(load_car(run.model_file), env, EVALUATION_SEED))


def _film(output: Path, max_episode_steps: int, console: Console) -> None:
    from combrel_envs import RenderingError

    (output / VIDEO).unlink(missing_ok=True)
    size = {"width": 480, "height": 360}
    env = make_env(mountain_car.TARGET_ID, max_episode_steps=max_episode_steps, render_mode="rgb_array", **size)
    try:
        with console.status("Filming the trained car ..."):
            film(load_car(output / MODEL), env, output / VIDEO, EVALUATION_SEED)
    except (RenderingError, ModuleNotFoundError) as error:
        console.print(f"No video: {error}", style="yellow", markup=False)
    finally:
        env.close()


def load_car(path: Path) -> FittedRMax:
    """
    Load a trained model.

    :param path: a file that a run has left
    """
    with chosen_on_purpose():
        return FittedRMax.load(path)


def _epilogue(output: Path, n_seeds: int, console: Console) -> None:
    what = {
        FIGURE: "steps to goal, episode by episode",
        TABLES: "the tables above",
        RESULTS: "every episode of every run",
        VIDEO: "the trained car",
        MODEL: "the trained model: FittedRMax.load",
        SOURCE: "the source instances: SourceInstances.load",
        RUNS: "episodes, mappings and model of each run",
        TENSORBOARD: "logs of each run",
    }
    console.print(f"\nEverything is in {output.resolve()}:", highlight=False, soft_wrap=True)
    for name, meaning in what.items():
        if (output / name).exists():
            console.print(f"  {name:<22}{meaning}", highlight=False)
    console.print("\nWhat to try next:")
    for command in (
        f"tensorboard --logdir {output / TENSORBOARD}",
        f"sb3-combrel demo --output {output} --seeds {2 * n_seeds}   # more runs; these are kept",
        'sb3-combrel record combrel/MountainCar2D-v0 --n-instances 300   # a smaller source for COMBREL("source.npz")',
    ):
        console.print(f"  {command}", highlight=False, soft_wrap=True, markup=False)
