"""The command ``sb3-combrel``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sb3_combrel.common.version import __version__

NEEDS_EXTRA = "this needs {missing}, which is not installed: pip install 'sb3-combrel[experiments]'"
OF_EXTRA = ("combrel_envs", "matplotlib", "mujoco", "dm_control", "moviepy", "tyro")


def demo(
    output: Path = Path("demo_output"),
    seeds: int = 10,
    episodes: int = 12,
    max_episode_steps: int = 2000,
    model_breadth: float | None = None,
    workers: int | None = None,
    fresh: bool = False,
) -> None:
    """Learn 4D Mountain Car without transfer, with TIMBREL and with COMBREL from the 2D one, and compare.

    It can be stopped at any time; the same command continues from there.

    :param output: folder for the figure, the tables, the video, the models and the logs
    :param seeds: runs of each method
    :param episodes: episodes of each run
    :param max_episode_steps: steps after which an episode is cut off
    :param model_breadth: breadth of the learner's kernel; by default the learner's own
    :param workers: processes at a time; one a core by default
    :param fresh: delete earlier results in the folder first
    """
    from sb3_combrel.experiments.demo import run_demo

    run_demo(output, seeds, episodes, max_episode_steps, model_breadth, workers, fresh)


def record(
    env_id: str,
    /,
    output: Path = Path("source.npz"),
    n_instances: int = 1000,
    total_timesteps: int | None = None,
    seed: int = 0,
    method: str = "random",
    overwrite: bool = False,
) -> None:
    """Learn a source task and keep a sample of its experience as source instances.

    By Q-learning; where state variables have no bounds, by 100 episodes of Fitted R-Max.

    :param env_id: id of a task with few state variables and discrete actions, such as combrel/MountainCar2D-v0 or
        package:Task-v0
    :param output: file to write
    :param n_instances: instances to keep
    :param total_timesteps: steps of Q-learning, by default 30,000
    :param seed: seed of learner, task and sample
    :param method: how to choose the instances, "random" or "covering"
    :param overwrite: replace the file if it exists
    """
    from rich.console import Console

    from sb3_combrel import SourceInstances
    from sb3_combrel.common.checks import check_count
    from sb3_combrel.common.files import check_folder
    from sb3_combrel.common.scaling import has_bounds
    from sb3_combrel.runs.job import make_env

    console = Console()
    if output.is_dir():
        raise ValueError(f"output must be a file, such as {output / 'source.npz'}, got the folder {output}")
    file = output if output.suffix == ".npz" else output.with_name(output.name + ".npz")
    if file.exists() and not overwrite:
        raise ValueError(f"{file} exists; use --overwrite or another --output")
    check_count("seed", seed, min=0)
    check_folder("output", file.parent)
    asked: dict[str, Any] = {"n_instances": n_instances, "seed": seed, "method": method}
    with closing(make_env(env_id)) as env:
        if has_bounds(env.observation_space):
            steps = 30_000 if total_timesteps is None else total_timesteps
            with console.status(f"Learning {env_id} by Q-learning for {steps:,} steps ..."):
                source = SourceInstances.from_q_learning(env, total_timesteps=steps, **asked)
        elif total_timesteps is not None:
            why = f"{env_id} has state variables without bounds, and is learned by 100 episodes of Fitted R-Max"
            raise ValueError(f"total_timesteps must be left out, got {total_timesteps}: {why}")
        else:
            with console.status(f"Learning {env_id} by Fitted R-Max, as its state variables have no bounds ..."):
                source = SourceInstances.from_fitted_rmax(env, **asked)
    console.print(source, markup=False, soft_wrap=True)
    console.print(f"written to {source.save(file)}; use it as COMBREL({str(file)!r})", soft_wrap=True)


def reproduce(
    target: str,
    /,
    setting: str = "paper",
    runs: int | None = None,
    episodes: int | None = None,
    jobs: int | None = None,
    output: Path | None = None,
    backend: str = "loky",
    address: str | None = None,
) -> None:
    """Reproduce a figure or table of the COMBREL paper, with controls.

    It can be stopped at any time; the same command continues from there.

    :param target: fig2, fig3, fig4, fig5, fig6, table2, table4, table5, table6, diagnosis (what transfer saves at
        breadths of the learner's kernel), baselines (setting best: DQN and QR-DQN), or all
    :param setting: paper (the paper's parameters) or best (this package's defaults)
    :param runs: of each method; by default 10 on the iCub, on Mountain Car 5 in setting paper, 15 in best
    :param episodes: of each run; by default 200 and 300
    :param jobs: local processes at a time; one a core by default
    :param output: folder for all results; by default reproduction/ and the name of the setting
    :param backend: loky (local processes), or ray or dask: a cluster that is running
    :param address: of the cluster, such as 10.0.0.1:6379 (ray) or tcp://10.0.0.1:8786 (dask)
    """
    from sb3_combrel.experiments.paper.reproduce import reproduce as run
    from sb3_combrel.runs.runner import Backend

    where = Backend(backend, jobs, address)
    made = run(target, setting=setting, runs=runs, episodes=episodes, output=output, backend=where)
    print("Written:", *made, sep="\n  ")


def explain(model: Path, /, output: Path | None = None, variables: tuple[str, str] | None = None) -> None:
    """Say what transfer did in a model: which mappings, how sure, what the target contradicted, how many steps rested on it.

    :param model: file of a model that FittedRMax has saved
    :param output: folder for a page to look at, report.html, the report, a table of mappings, and pictures; by default the
        report is printed only
    :param variables: two state variables over which values are drawn; by default one beside its own velocity
    """
    from sb3_combrel.tensorboard.explain import explain as run

    report = run(model, output, None if variables is None else [variables])
    print(report)
    if output is not None:
        print(f"\nWritten into {output}; to look at: {output / 'report.html'}")


def benchmark(
    pairs: tuple[str, ...] = ("all",),
    methods: tuple[str, ...] = ("all",),
    seeds: int = 10,
    first_seed: int = 7000,
    jobs: int | None = None,
    backend: str = "loky",
    address: str | None = None,
    output: Path = Path("benchmark"),
) -> None:
    """Compare methods of transfer on pairs of tasks with a known answer: a table and a picture a pair, and mean ranks.

    It can be stopped at any time; the same command continues from there. More in docs/benchmark.md.

    :param pairs: names of pairs, or all; or your own: path/to/file.py, which defines PAIR, or package.module:Name
    :param methods: names of methods, or all; or your own: package.module:Name or path/to/file.py:Name
    :param seeds: runs of each method on each pair
    :param first_seed: seed of the first
    :param jobs: local processes at a time; one a core by default
    :param backend: loky (local processes), or ray or dask: a cluster that is running
    :param address: of the cluster, such as 10.0.0.1:6379 (ray) or tcp://10.0.0.1:8786 (dask)
    :param output: folder for all results
    """
    from sb3_combrel.experiments.benchmark.command import benchmark as run
    from sb3_combrel.runs.runner import Backend

    where = Backend(backend, jobs, address)
    made = run(pairs, methods, seeds=seeds, first_seed=first_seed, output=output, backend=where)
    print("Written:", *made, sep="\n  ")


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "record": record,
    "explain": explain,
    "reproduce": reproduce,
    "benchmark": benchmark,
}
#: Those that keep what they have finished.
RESUMED = ("demo", "reproduce", "benchmark")


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line.

    :param args: arguments, those of the process by default
    :return: exit status: 0, or 1 if something was wrong with the arguments or a run failed, or 130 if the user stopped it
    """
    if list(sys.argv[1:] if args is None else args) == ["--version"]:
        print(f"sb3-combrel {__version__}")
        return 0
    try:
        import tyro
    except ModuleNotFoundError:
        print(f"sb3-combrel: {NEEDS_EXTRA.format(missing='tyro')}", file=sys.stderr)
        return 1
    from gymnasium.error import Error as GymnasiumError

    from sb3_combrel.runs.runner import JobError

    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="sb3-combrel",
            description="Transfer learning with Fitted R-Max for Stable-Baselines3.",
            args=args,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    except (ValueError, OSError, GymnasiumError, ModuleNotFoundError, JobError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name in OF_EXTRA:
            error = ModuleNotFoundError(NEEDS_EXTRA.format(missing=error.name))
        print(f"sb3-combrel: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        command = (sys.argv[1:] if args is None else list(args))[:1]
        goes_on = any(name in RESUMED for name in command)
        print("\nStopped." + " The same command goes on from here." * goes_on, file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
