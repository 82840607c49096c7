"""What transfer did in a model: a report as text, and the dashboard's pictures as files."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.plane import Plane, VariablePair, numbered, plane_through
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.report import TransferReport

#: Larger than in TensorBoard's cards.
FILE_DPI = 220


def explain(
    model: FittedRMax | str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    variables: Sequence[VariablePair] | None = None,
    at: ArrayLike | None = None,
) -> TransferReport:
    """
    Say what transfer did in a model that has learned.

    Which mappings, by name; how sure they are, against the next best and against "no change"; where the target's own
    transitions contradicted the source; how many steps rested on it::

        report = sb3_combrel.explain("car.zip", output="explained")
        print(report)
        print(report.mappings[0].target_action, report.mappings[0].compliance)

    :param model: the model, or the path of its file
    :param output: a folder for the report, ``report.txt``, and the dashboard's pictures as PNG: V and policy over two state
        variables, and the source action that each target action is mapped to; and its table of the mappings used most,
        ``mappings.md``. A transfer method without mappings has the report and V only. None: nothing is written
    :param variables: pairs of state variables, by number or name, over which is drawn; None for the first two
    :param at: state (raw units) through which the pictures' plane goes; None for the middle of the state space
    :return: the report; ``print`` it, or read its fields
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is no model of Fitted R-Max, it has no transfer method or has not learned anything, or
        variables or state do not fit
    :raises ModuleNotFoundError: if pictures are wanted and matplotlib is not installed
    """
    if not isinstance(model, FittedRMax):
        model = _load(Path(model))
    if model.agent.transfer is None:
        raise ValueError(
            "the model has no transfer method, so there is nothing to explain; "
            "one that has: FittedRMax(env, transfer=COMBREL(source))"
        )
    if model.agent.model.n_instances == 0:
        raise ValueError("the model has not learned anything yet: call model.learn(total_timesteps) first")
    transfer = model.agent.transfer
    report = transfer.report()
    if output is not None:
        save_pictures(model, output, variables, at)
        (Path(output) / "report.txt").write_text(f"{report}\n")
        if isinstance(transfer, MappingTransfer):
            (Path(output) / "mappings.md").write_text(f"{mapping_table(transfer, model.agent.task.action_names)}\n")
    return report


def save_pictures(
    model: FittedRMax,
    folder: str | os.PathLike[str],
    variables: Sequence[VariablePair] | None = None,
    at: ArrayLike | None = None,
) -> list[Path]:
    """
    Save the dashboard's pictures of a model as PNG files.

    :param folder: where; it is made if need be, and files of the same names are replaced
    :param variables: see :func:`explain`; ``at``: the same
    :return: the files
    :raises ModuleNotFoundError: if matplotlib is not installed
    :raises ValueError: if variables or state do not fit
    """
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError("pictures need matplotlib: install it, or leave output out", name="matplotlib")
    from matplotlib.image import imsave

    from sb3_combrel.tensorboard import pictures

    agent, transfer = model.agent, model.agent.transfer
    planes = planes_of(model, variables, at)
    Path(folder).mkdir(parents=True, exist_ok=True)
    drawn: dict[str, np.ndarray] = {}
    for plane in planes:
        over = "_".join(re.sub(r"\W+", "-", name) for name in plane.names if name)
        drawn[f"value_and_policy_{over}"] = pictures.value_and_policy(agent, plane, FILE_DPI)
        if isinstance(transfer, MappingTransfer) and transfer.makes_choices:
            drawn[f"source_action_{over}"] = pictures.source_actions(agent, transfer, plane, FILE_DPI)
    files = [Path(folder) / f"{name}.png" for name in drawn]
    for file, picture in zip(files, drawn.values(), strict=True):
        imsave(file, picture)
    return files


def planes_of(model: FittedRMax, variables: Sequence[VariablePair] | None, at: ArrayLike | None) -> list[Plane]:
    """
    Find the planes over which pictures are drawn.

    :param variables: see :func:`explain`; ``at``: the same
    :raises ValueError: if they do not fit the task
    """
    task = model.agent.task
    if at is not None and np.shape(at) != (task.n_variables,):
        raise ValueError(f"at must be {task.n_variables} numbers, one a state variable, got {at!r}")
    names = task.state_names
    return [plane_through(model.agent.grid, task.scaling, names, pair, at) for pair in numbered(variables, names)]


def _load(path: Path) -> FittedRMax:
    if not path.exists() and not path.with_name(path.name + ".zip").exists():
        raise FileNotFoundError(f"there is no model file {path}, looked for in {Path.cwd()}; write one with: model.save(path)")
    return FittedRMax.load(path)
