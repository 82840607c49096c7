"""The demonstration: two-dimensional Mountain Car helps to learn the four-dimensional one."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from sb3_combrel import FittedRMax
from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.comparison.figures import COLOURS, MARKERS, draw_band, figure_of
from sb3_combrel.comparison.statistics import mean_of_runs, saving
from sb3_combrel.comparison.tables import Table
from sb3_combrel.experiments.film import film, greedy_episode
from sb3_combrel.experiments.tasks import mountain_car
from sb3_combrel.experiments.warm_up import warm_up
from sb3_combrel.runs.episodes import EVALUATION_SEED, EpisodeRecorder
from sb3_combrel.runs.job import Job, Result, chosen_on_purpose, file_name, make_env
from sb3_combrel.runs.runner import (
    FOLDER,
    Backend,
    check_all_succeeded,
    prepare_folder,
    read_result,
    result_file,
    run_missing,
)
from sb3_combrel.runs.source_files import FOLDER as SOURCES
from sb3_combrel.runs.source_files import SourceJob, load_or_learn

TENSORBOARD = "tensorboard"
FIGURE, TABLES, RESULTS = "learning_curves.png", "tables.md", "results.csv"
MODEL, VIDEO = "car.zip", "car.mp4"
#: Of the file of each source, before its seed.
SOURCE = "mountain_car_2d_seed"
#: All that the demonstration writes into its folder.
OUTPUTS = (SOURCES, FOLDER, TENSORBOARD, FIGURE, TABLES, RESULTS, MODEL, VIDEO)
MAPPINGS_SHOWN = 8
FILMED = "COMBREL"


@dataclass(frozen=True, kw_only=True)
class DemoRun(Job):
    """A run that leaves its model and TensorBoard logs in the output folder, and counts the mappings used."""

    folder: Path

    @property
    def model_file(self) -> Path:
        """The trained model."""
        return self.folder / FOLDER / f"{self.name}.zip"

    def settings(self) -> dict[str, Any]:
        """All but the folder, which may be moved."""
        return {name: value for name, value in super().settings().items() if name != "folder"}

    def carry_out(self) -> Result:
        """Learn; a run that was stopped is repeated from the start, so that its results are those of a run without a stop."""
        logs = self.folder / TENSORBOARD
        for earlier in logs.glob(f"{self.name}_[0-9]*"):
            shutil.rmtree(earlier, ignore_errors=True)
        assert self.n_episodes is not None and self.max_episode_steps is not None
        log = EpisodeLog(self.n_episodes)
        with closing(self.make_env()) as env, chosen_on_purpose():
            model = FittedRMax(env, transfer=self.transfer, seed=self.seed, tensorboard_log=str(logs), **self.learner)
            start = time.process_time()
            model.learn(self.n_episodes * self.max_episode_steps, log, log_interval=1, tb_log_name=self.name)
            seconds = time.process_time() - start
        transfer: Any = model.agent.transfer
        counts = {} if transfer is None else {str(mapping): count for mapping, count in transfer.mapping_counts()}
        model.save(self.model_file)
        more = {"mappings": counts, "wall_seconds": log.wall_seconds}
        return self.result(*(column.tolist() for column in log.episodes), model.num_timesteps, more, seconds)


class EpisodeLog(EpisodeRecorder):
    """Keeps and logs every episode, and stops the learning after the last of ``n_episodes``."""

    def __init__(self, n_episodes: int):
        super().__init__(n_episodes)
        self.wall_seconds: list[float] = []

    def _on_step(self) -> bool:
        # One step later: the algorithm plans and logs at the end of an episode only after it has asked the callbacks.
        if len(self.wall_seconds) >= self.n_episodes:  # type: ignore[operator]
            return False
        super()._on_step()
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                self.wall_seconds.append(float(info["episode"]["t"]))
                self.logger.record("rollout/ep_len", int(info["episode"]["l"]))
                self.logger.record("rollout/episode", len(self.wall_seconds))
        return True


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
    """Learn the target task without transfer, with a random mapping, with TIMBREL and with COMBREL, and report the results.

    Runs that an earlier call has completed in the same folder are kept; ``fresh`` deletes them first, and nothing else.

    :param model_breadth: breadth of the learner's kernel; None for the learner's own
    :param workers: processes at a time; None for one a core
    :raises ValueError: if a number is below 1, or the folder has results of other settings or other files
    """
    check_count("seeds", n_seeds)
    check_count("episodes", n_episodes)
    check_count("max_episode_steps", max_episode_steps)
    check_count("workers", workers, none_allowed=True)
    if model_breadth is not None:
        check_positive("model_breadth", model_breadth)
    console = console or Console()
    prepare_folder(output)
    if fresh:
        _forget(output)
    files = [output / SOURCES / f"{SOURCE}{seed}.npz" for seed in range(n_seeds)]
    learn = mountain_car.learn_source
    wanted = [SourceJob(group="mountain_car_2d", seed=seed, path=file, learn=learn) for seed, file in enumerate(files)]
    sources = load_or_learn(wanted, Backend(n_jobs=workers), console)
    learner = {**mountain_car.LEARNER, **({} if model_breadth is None else {"model_breadth": model_breadth})}
    task: dict[str, Any] = {"env": mountain_car.TARGET_ID, "n_episodes": n_episodes, "max_episode_steps": max_episode_steps}
    runs = [
        DemoRun(group="", method=method, seed=seed, learner=learner, transfer=transfer, folder=output, **task)
        for seed, source in enumerate(sources)
        for method, transfer in mountain_car.methods(source).items()
    ]
    incomplete = [run for run in runs if not run.model_file.exists()]
    for run in incomplete:
        result_file(output, run.name).unlink(missing_ok=True)
    if incomplete:
        with console.status("Compiling; the first time this takes a while ..."):
            warm_up()
        console.print(f"Learning {mountain_car.TARGET_ID}: {n_seeds} runs of {n_episodes} episodes with each method ...")
    results = run_missing(runs, output, Backend(n_jobs=workers), console)
    check_all_succeeded(results)
    _report(results, max_episode_steps, output, console)
    shutil.copyfile(_best([run for run in runs if run.method == FILMED], console).model_file, output / MODEL)
    _film(output, max_episode_steps, console)
    _epilogue(output, n_seeds, console)


def _forget(output: Path) -> None:
    """Delete what earlier calls have left, if there are results of the demonstration: files of their names, and its own."""
    runs = [file.stem for file in (output / FOLDER).glob("*.json") if _is_of_demo(output, file.stem)]
    if not runs:
        return
    logs = [log for name in runs for log in (output / TENSORBOARD).glob(f"{name}_[0-9]*")]
    for log in logs:
        shutil.rmtree(log, ignore_errors=True)
    files = [output / FOLDER / f"{name}{suffix}" for name in runs for suffix in (".json", ".zip")]
    files += [output / name for name in (FIGURE, TABLES, RESULTS, MODEL, VIDEO)]
    for file in (*files, *(output / SOURCES).glob(f"{SOURCE}[0-9]*.npz")):
        file.unlink(missing_ok=True)


def _is_of_demo(output: Path, name: str) -> bool:
    """Whether a file of a name is a result of the demonstration: the folder may have others'."""
    read = read_result(output, name)
    if read is None:
        return False
    settings, result = read
    return settings.get("env") == mountain_car.TARGET_ID and name == file_name("", result.method, result.seed)


def _report(results: Sequence[Result], cap: int, output: Path, console: Console) -> None:
    methods = dict.fromkeys(result.method for result in results)
    by_method = {method: [result for result in results if result.method == method] for method in methods}
    steps = {method: np.array([result.steps for result in its_own]) for method, its_own in by_method.items()}
    draw_learning_curves(steps, output / FIGURE, "Mountain Car 4D, learned with 1000 instances of Mountain Car 2D", cap)
    results_frame(results).to_csv(output / RESULTS, index=False, lineterminator="\r\n")
    tables = [episodes_table(steps), savings_table(steps, mountain_car.NO_TRANSFER)]
    tables += [mappings_table(its_own, method) for method, its_own in by_method.items() if method != mountain_car.NO_TRANSFER]
    note = f"An episode that doesn't reach the goal is cut off after {cap} steps and counts as {cap}."
    (output / TABLES).write_text("\n".join(table.as_markdown() for table in tables) + f"\n{note}\n")
    for table in tables:
        console.print(table.for_terminal())
    console.print(note)


def results_frame(results: Sequence[Result]) -> pd.DataFrame:
    """Return a row for each episode of each run."""
    frames = []
    for result in results:
        columns = {"method": result.method, "seed": result.seed, "episode": range(1, len(result.steps) + 1)}
        reached, seconds = np.array(result.terminated, dtype=int), [f"{each:.2f}" for each in result.more["wall_seconds"]]
        frames.append(pd.DataFrame({**columns, "steps": result.steps, "reached_goal": reached, "seconds": seconds}))
    return pd.concat(frames)


def draw_learning_curves(steps: dict[str, np.ndarray], path: Path, title: str, cap: int) -> None:
    """Draw each method's steps, shape (n_runs, n_episodes), as means with bands of 95% confidence, into a PNG file."""
    figure = figure_of(7.0, 4.2)
    axes = figure.add_subplot()
    highest = 0.0
    for (method, samples), colour, marker in zip(steps.items(), COLOURS, MARKERS, strict=False):
        mean, low, high = mean_of_runs(samples)
        # No run can need more steps than the cap, nor fewer than none.
        low, high = np.maximum(low, 0), np.minimum(high, cap)
        highest = max(highest, float(high.max()))
        label = f"{method} ({len(samples)} runs)"
        draw_band(axes, np.arange(1, len(mean) + 1), (mean, low, high), colour, label=label, marker=marker, markersize=5)
    axes.set_xlabel("episode")
    axes.set_ylabel(f"steps to goal (at most {cap})")
    axes.set_title(title)
    if np.isfinite(highest) and highest > 0.0:
        axes.set_ylim(0, 1.05 * highest)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def episodes_table(steps: dict[str, np.ndarray]) -> Table:
    """Make a table of the steps of each episode and of all: mean of the runs, half of its 95% confidence interval."""
    n_runs, n_episodes = next(iter(steps.values())).shape
    columns = [
        [_mean_and_half(samples[:, episode]) for episode in range(n_episodes)] + [_mean_and_half(samples.sum(axis=1))]
        for samples in steps.values()
    ]
    labels = [str(episode + 1) for episode in range(n_episodes)] + ["all"]
    title = f"Steps to goal, mean of {n_runs} runs and 95% confidence interval"
    return Table(title, ("episode", *steps), list(zip(labels, *columns, strict=True)))


def savings_table(steps: dict[str, np.ndarray], baseline: str) -> Table:
    """Make a table of the steps saved over all episodes, compared with a baseline."""
    rows = []
    for method, samples in steps.items():
        if method != baseline:
            saved = saving(steps[baseline].sum(axis=1), samples.sum(axis=1))
            interval = "needs more runs" if np.isnan(saved.low) else f"{saved.low:,.0f} to {saved.high:,.0f}"
            p_value = "-" if np.isnan(saved.p_value) else f"{saved.p_value:.1e}"
            rows.append((method, f"{saved.steps:,.0f}", interval, f"{saved.share:.0%}", p_value))
    header = ("method", "steps saved", "95% interval", "share", "p (Welch)")
    return Table(f"Environment steps saved, compared with {baseline}", header, rows)


def mappings_table(results: Sequence[Result], method: str) -> Table:
    """Make a table of the mappings that a method used most, over all its runs."""
    counts = sum((Counter(result.more["mappings"]) for result in results), Counter())
    total = max(counts.total(), 1)
    rows = [(name, f"{count / total:.1%}") for name, count in counts.most_common(MAPPINGS_SHOWN)]
    return Table(f"Mappings that {method} used most ({len(counts)} in all)", ("mapping", "share of uses"), rows)


def _mean_and_half(samples: np.ndarray) -> str:
    mean, _, high = mean_of_runs(samples)
    return f"{mean:,.0f}" if np.isnan(high) else f"{mean:,.0f} ± {high - mean:,.0f}"


def _best(runs: Sequence[DemoRun], console: Console) -> DemoRun:
    """Return the run whose model needs the fewest steps without exploring."""
    with console.status("Trying the trained cars ..."):
        steps = [_drive(run) for run in runs]
    best = int(np.argmin(steps))
    needed = f"the trained {runs[0].method} cars need {', '.join(map(str, steps))} steps"
    console.print(f"Driven without exploring, {needed}; the video shows the one with seed {runs[best].seed}.")
    return runs[best]


def _drive(run: DemoRun) -> int:
    with closing(run.make_env()) as env:
        return sum(1 for _ in greedy_episode(load_car(run.model_file), env, EVALUATION_SEED))


def _film(output: Path, max_episode_steps: int, console: Console) -> None:
    from combrel_envs import RenderingError

    (output / VIDEO).unlink(missing_ok=True)
    size = {"width": 480, "height": 360}
    with closing(make_env(mountain_car.TARGET_ID, max_episode_steps, render_mode="rgb_array", **size)) as env:
        try:
            with console.status("Filming the trained car ..."):
                film(load_car(output / MODEL), env, output / VIDEO, EVALUATION_SEED)
        except (RenderingError, ModuleNotFoundError) as error:
            console.print(f"No video: {error}", style="yellow", markup=False)


def load_car(path: Path) -> FittedRMax:
    """Load a trained model that a run has left."""
    with chosen_on_purpose():
        return FittedRMax.load(path)


def _epilogue(output: Path, n_seeds: int, console: Console) -> None:
    what = {FIGURE: "steps to goal, episode by episode", TABLES: "the tables above", RESULTS: "every episode of every run"}
    what |= {VIDEO: "the trained car", MODEL: "the trained model: FittedRMax.load"}
    what |= {SOURCES: "source instances of each seed: SourceInstances.load", FOLDER: "result and model of each run"}
    what |= {TENSORBOARD: "logs of each run"}
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
