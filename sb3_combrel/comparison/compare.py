"""Learning with and without transfer, compared in one call: runs, measures, tests, a picture, and a sentence."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.common.checks import as_count, check_boolean, check_count, check_finite
from sb3_combrel.common.serialisation import to_plain
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.comparison.controls import CONTROL, is_control, name_of_control, random_control
from sb3_combrel.comparison.result import CompareResult, evaluate
from sb3_combrel.fitted_rmax.arguments import MAX_SEED
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.pages.snapshot import snapshot_of
from sb3_combrel.runs.described import described
from sb3_combrel.runs.job import Job, Result, Task, TransferLike, chosen_on_purpose, file_name
from sb3_combrel.runs.runner import Backend, check_all_succeeded, prepare_folder, read_results, run_missing
from sb3_combrel.sources.recipes import task_spec
from sb3_combrel.transfer.base import Transfer

# What ``compare`` passes to the learner itself.
_TAKEN = ("env", "transfer", "seed", "_init_setup_model")
# So many characters of a method's name begin the names of its files, which may have 255 bytes.
NAME_LENGTH = 40


@dataclass(frozen=True, kw_only=True)
class ComparedRun(Job):
    """A run of a comparison, whose result has the transfer method's report.

    :param is_shown: whether the result has values and policy too, for the page
    :param in_use: what the transfer method is once it is bound to the task, as :func:`settings_of` describes it
    :param classes: of the environment and its wrappers
    """

    is_shown: bool = False
    in_use: Any = None
    classes: tuple[type, ...] = ()

    @property
    def name(self) -> str:
        """Name of the run in files, with a digest: methods may differ in case or punctuation alone, or at their ends.

        In that of the control its settings count: it is another one where another method comes first.
        """
        told_by = self.method if self.method != CONTROL else json.dumps([self.method, self.in_use])
        digest = hashlib.sha256(told_by.encode()).hexdigest()[:8]
        return file_name(self.method[:NAME_LENGTH], f"{digest}{' shown' if self.is_shown else ''}", self.seed)

    def settings(self) -> dict[str, Any]:
        """What the result depends on; of a source that is named by its file, its content."""
        found = super().settings()
        found["transfer"] = found.pop("in_use")
        return found

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        """Report what transfer did, and what was learned."""
        return {
            "report": None if model.transfer is None else model.transfer.report(),
            "snapshot": snapshot_of(model.agent) if self.is_shown else None,
        }


def compare(
    env: Task,
    methods: Mapping[str, TransferLike],
    *,
    seeds: int | Sequence[int] = 10,
    steps: int = 20_000,
    baseline: str | None = None,
    controls: bool = True,
    threshold: float | None = None,
    n_jobs: int | None = 1,
    progress_bar: bool | None = None,
    output: str | os.PathLike[str] | None = None,
    **learner: Any,
) -> CompareResult:
    """Learn a task with several methods of transfer and without, and say whether transfer helped.

    Each method learns with the same seeds; everything is tested before the first run begins::

        result = sb3_combrel.compare(
            "combrel/MountainCar4D-v0", {"none": None, "COMBREL": COMBREL(source)}, seeds=10, steps=5_000, n_jobs=2
        )
        print(result.sentence)
        print(result.table)
        result.figure().savefig("curves.png")
        result.save("report.html")

    Where a method transfers through mappings, one that draws a mapping at random from the same set is compared as well, as
    the control "random mapping": what it gains is not owed to the right mapping.

    The question is answered by the return averaged over environment steps, exploration included, with the permutation test of
    the difference of means, corrected by Holm's method if several methods are compared with the baseline. The steps of
    learning the source do not count.

    :param env: id of the task, or a function without arguments that makes the environment; each run has its own
    :param methods: for each name a transfer method, as :class:`~sb3_combrel.FittedRMax` takes it, or None for no transfer
    :param seeds: number of runs of each method, with seeds from 0 on; or the seeds themselves
    :param steps: environment steps of each run; episodes that are not complete by then do not count
    :param baseline: the method that the others are compared with; None: the one without transfer
    :param controls: whether the control is added, unless there is one
    :param threshold: return that the time to threshold is measured to; None: the median, over the baseline's runs, of the mean
        return of their last episodes
    :param n_jobs: runs at a time, each in a process of its own; 1: one after the other in this process; None: one a core.
        Results do not depend on it.
    :param progress_bar: show which runs are complete; None: in a terminal or notebook
    :param output: folder in which finished runs are kept; None: in a temporary one, which stays, and is named, if the call
        fails or is stopped, unless the task or a method does not say what its arguments are. The same call, or one with more
        methods or seeds, goes on from there. Where the source of the environment's class, its wrappers or the function that
        makes it, or that of a method's class, has changed, it is refused, as where that of a class which these inherit from
        has, or a value that the function holds: a default, a variable of an enclosing function, plain global data,
        attributes of its object; and where the content of ``instances`` has. What else these call is not noticed: take
        another folder then
    :param learner: further arguments of :class:`~sb3_combrel.FittedRMax`, the same for all methods: ``gamma=0.99``
    :return: learning curves, measures, p-values, table, figure and sentence
    :raises TypeError: if :class:`~sb3_combrel.FittedRMax` has no such argument
    :raises ValueError: if an argument is wrong or a method does not fit the task, before any run; or if a run was too short
        for a single episode; or if the folder has runs of other settings, or a method does not say what its arguments are
    :raises FileNotFoundError: if a source does not exist
    :raises OSError: if the folder cannot be written to
    :raises ~sb3_combrel.runs.runner.JobError: if a run failed
    """
    baseline = check_methods(methods, baseline)
    numbers = check_seeds(seeds)
    steps = as_count("steps", steps)
    check_count("n_jobs", n_jobs, none_allowed=True)
    check_boolean("controls", controls)
    if progress_bar is not None:
        check_boolean("progress_bar", progress_bar)
    if threshold is not None:
        check_finite("threshold", threshold)
    check_learner(learner)
    task, folder = task_of(env), check_output(output)

    def first_run(method: str, transfer: TransferLike) -> ComparedRun:
        fixed: dict[str, Any] = {"group": "", "env": task, "n_steps": steps, "learner": learner}
        return ComparedRun(method=method, seed=numbers[0], transfer=transfer, is_shown=True, **fixed)

    first = {method: first_run(method, transfer) for method, transfer in methods.items()}
    in_use = {method: _try_out(run) for method, run in first.items()}
    if CONTROL in in_use and not is_control(in_use[CONTROL]):
        wanted = f"methods must call none but a mapping drawn at random {CONTROL!r}, which is the control's name"
        raise ValueError(f'{wanted}, got {in_use[CONTROL]!r}: give it another one, or take TIMBREL(source, "random")')
    control = random_control(in_use) if controls else None
    if control is not None:
        run = first_run(CONTROL, control)
        try:
            in_use[CONTROL], first[CONTROL] = _try_out(run), run
        except ValueError as error:
            warn_user(f"there is no control ({error}): controls=False leaves it out without a warning")
    can_be_kept = True
    try:
        first = _told_apart(first, in_use)
    except (ValueError, TypeError, OSError):
        if folder is not None:
            raise
        can_be_kept = False
    runs = [replace(run, seed=seed, is_shown=seed == numbers[0]) for run in first.values() for seed in numbers]
    console = Console(stderr=True)
    shown = console.is_terminal or console.is_jupyter if progress_bar is None else progress_bar
    with _kept_if_it_fails() if folder is None and can_be_kept else nullcontext(folder) as kept:
        results = run_missing(
            runs,
            output=kept,
            must_keep=folder is not None,
            backend=Backend(n_jobs=n_jobs),
            console=console if shown else None,
        )
        check_all_succeeded(results)
        check_episodes(results, steps, kept)
    by_method = {method: results[k * len(numbers) : (k + 1) * len(numbers)] for k, method in enumerate(first)}
    found = evaluate(by_method, baseline, threshold, _name_of(env), name_of_control(in_use))
    for words in found.warnings:
        warn_user(words)
    return found


def _name_of(env: Task) -> str:
    """What the page calls the task."""
    name = env if isinstance(env, str) else str(getattr(env, "__name__", type(env).__name__))
    return "the task" if name == "<lambda>" else name


def _try_out(run: ComparedRun) -> Transfer | None:
    """Make the model of a run, so that what does not fit is found before anything is learned; its transfer method, bound."""
    try:
        with closing(run.make_env()) as env, chosen_on_purpose():
            return run.make_model(env).transfer  # type: ignore[return-value]
    except (ValueError, TypeError, OSError) as error:
        # Subclasses may ask for more than a message.
        kind = next(kind for kind in (FileNotFoundError, OSError, TypeError, ValueError) if isinstance(error, kind))
        raise kind(f"{run.method}: {error}") from error


def _told_apart(first: Mapping[str, ComparedRun], in_use: Mapping[str, Transfer | None]) -> dict[str, ComparedRun]:
    """The first run of each method, with all by which its runs in a folder are told from others.

    :raises ValueError: if a method, or what makes the environment, does not say it
    """
    classes = _classes_of(next(iter(first.values())))
    found = {
        method: replace(run, in_use=_kept_settings(method, in_use[method]), classes=classes) for method, run in first.items()
    }
    for run in found.values():
        run.settings()
    return found


@contextmanager
def _kept_if_it_fails() -> Iterator[Path]:
    """A temporary folder for runs, which stays, and is named, if not all come to their end."""
    folder = Path(mkdtemp(prefix="sb3_combrel_compare_"))
    try:
        yield folder
    except BaseException as error:
        if read_results(folder):
            error.add_note(f"Finished runs are kept: the same call with output={str(folder)!r} goes on from them.")
        else:
            shutil.rmtree(folder)
        raise
    shutil.rmtree(folder)


def _classes_of(run: ComparedRun) -> tuple[type, ...]:
    """The classes of a run's environment, from the outermost wrapper on."""
    with closing(run.make_env()) as env:
        classes, inner = [type(env)], env
        while isinstance(inner, gym.Wrapper):
            inner = inner.env
            classes.append(type(inner))
    return tuple(classes)


def _kept_settings(method: str, transfer: Transfer | None) -> Any:
    """The settings of a method, by which its runs in a folder are told from others; ValueError if it does not say them."""
    try:
        return settings_of(transfer)
    except ValueError as error:
        raise ValueError(f"{method}: {error}") from error


def settings_of(transfer: Transfer | None) -> Any:
    """Describe a transfer method in use as JSON can hold it; a set of mappings by digest, as its name says the size only."""
    mappings = getattr(transfer, "mappings", None)
    if not isinstance(mappings, MappingSet):
        return described(transfer)
    digest = hashlib.sha256(json.dumps(to_plain(mappings)).encode()).hexdigest()[:12]
    return {"mappings": f"{mappings!r} {digest}", "method": described(transfer)}


def check_episodes(results: Sequence[Result], steps: int, folder: Path | None) -> None:
    """Raise a ValueError if no episode has ended in a run, with the seeds that can be compared from what is kept."""
    without = [each for each in results if not each.steps]
    if not without:
        return
    runs = "; ".join(f"{each.method}, seed {each.seed}" for each in without)
    wrong = f"steps={steps} is too few: no episode ended in the run of {runs}; take more, or a time limit"
    left = sorted({each.seed for each in results} - {each.seed for each in without})
    if left:
        # Only the user can say whether what is left is a fair sample: these runs are the worst ones.
        wrong += f". seeds={left} compares the others, without these, and says less of how bad a run may be"
        wrong += "" if folder is None else f"; their runs are kept in {folder}"
    raise ValueError(wrong)


def check_output(output: Any) -> Path | None:
    """Return the folder that runs are kept in, ready to be written to; None for none."""
    if output is None:
        return None
    if not isinstance(output, str | os.PathLike):
        raise ValueError(f"output must be the path of a folder, or None, got {output!r}")
    folder = Path(output)
    prepare_folder(folder)
    return folder


def check_methods(methods: Any, baseline: Any) -> str:
    """Check the methods of :func:`compare`, and return the baseline's name."""
    if not isinstance(methods, Mapping) or not all(isinstance(name, str) for name in methods):
        raise ValueError(f"methods must be a dict from names to transfer methods, got {methods!r}")
    if len(methods) < 2:
        example = '{"none": None, "COMBREL": COMBREL(source)}'
        raise ValueError(f"methods must have at least two, such as {example}, got {methods!r}")
    for name, transfer in methods.items():
        if not (transfer is None or isinstance(transfer, Transfer | dict | str)):
            raise ValueError(f"methods must be transfer methods or None for no transfer, got {transfer!r} for {name!r}")
        if isinstance(transfer, dict) and (len(transfer) != 1 or not isinstance(next(iter(transfer.values())), dict | None)):
            wanted = 'a method\'s name and its arguments, {"COMBREL": {"source": "source.npz"}}'
            other = "; arguments of the learner are those of compare, and the same for all methods"
            raise ValueError(f"a dict in methods must be {wanted}, got {transfer!r} for {name!r}{other}")
    if baseline is None:
        without = [name for name, transfer in methods.items() if transfer is None]
        if len(without) != 1:
            raise ValueError(f"baseline must be one of {', '.join(methods)}, as {len(without)} methods are without transfer")
        return without[0]
    if baseline not in methods:
        raise ValueError(f"baseline must be one of {', '.join(methods)}, got {baseline!r}")
    return str(baseline)


def check_seeds(seeds: Any) -> list[int]:
    """Return the seeds."""
    if isinstance(seeds, Sequence | np.ndarray) and not isinstance(seeds, str):
        numbers = [as_count("seeds", seed, min=0, max=MAX_SEED) for seed in seeds]
        if not numbers or len(set(numbers)) < len(numbers):
            raise ValueError(f"seeds must be different whole numbers, at least one, got {list(seeds)!r}")
        return numbers
    return list(range(as_count("seeds", seeds)))


def check_learner(learner: Mapping[str, Any]) -> None:
    """Raise a TypeError unless the learner has all of these arguments."""
    known = [name for name in inspect.signature(FittedRMax).parameters if name not in _TAKEN]
    own = [each.name for each in inspect.signature(compare).parameters.values() if each.kind != each.VAR_KEYWORD]
    for name in learner:
        if name not in known:
            meant = did_you_mean(name, [*own, *known]) or f"; FittedRMax has {', '.join(known)}"
            wanted = "compare takes its own arguments and those of FittedRMax, such as gamma=0.99"
            raise TypeError(f"{wanted}, got {name!r}{meant}")


def task_of(env: Any) -> Task:
    """Return what makes the environment of each run."""
    if isinstance(env, str):
        spec = task_spec(env)
        if spec is None:
            raise ValueError(f"env must be the id of an environment or a function that makes one; there is no {env!r}")
        return spec
    if not callable(env):
        wanted = "env must be the id of an environment or a function that makes one, as each run has its own"
        raise ValueError(f"{wanted}, got {env!r}; for example env=lambda: MyEnv()")
    return env  # type: ignore[no-any-return]
