"""What transfer did in a model: a report as text, and the dashboard's pictures as files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from sb3_combrel.common.files import check_folder
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.pages.plane import Plane, VariablePair, check_matplotlib, planes_of
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.report import TransferReport

#: Larger than in TensorBoard's cards.
FILE_DPI = 200
#: The page's file.
PAGE = "report.html"


def explain(
    model: FittedRMax | str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    variables: Sequence[VariablePair] | None = None,
    at: ArrayLike | None = None,
) -> TransferReport:
    """Say what transfer did in a model that has learned.

    Which mappings, by name; how sure they are, against the next best and against "no change"; where the target's own
    transitions contradicted the source; how many steps rested on it::

        report = sb3_combrel.explain("car.zip", output="explained")
        print(report)
        print(report.mappings[0].target_action, report.mappings[0].compliance)

    :param model: the model, or the path of its file
    :param output: a folder for the page ``report.html``, which holds all in one file to look at: returns, mappings, evidence
        over time, values, bound and policy, and where the source was contradicted; for the report, ``report.txt``; the
        pictures of the dashboard as PNG; and its table of the mappings used most, ``mappings.md``. None: nothing is written
    :param variables: pairs of state variables, by number or name, over which is drawn; None for a variable beside its own
        velocity, told by their names, or else the first two
    :param at: state (raw units) through which the pictures' plane goes; None for the middle of the state space
    :return: the report; ``print`` it, or read its fields. That of a model without transfer says so; its page has values and
        policy
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is no model of Fitted R-Max, it has not learned anything, or variables or state do not fit
    :raises OSError: if nothing can be written to ``output``
    :raises ModuleNotFoundError: if pictures are wanted and matplotlib is not installed
    """
    if output is not None:
        check_matplotlib("leave output out")
    elif variables is not None or at is not None:
        given = f"variables={variables!r}" if variables is not None else f"at={at!r}"
        raise ValueError(f"output must be a folder where {given} says what is drawn, got None: pictures are written there")
    if not isinstance(model, FittedRMax | str | os.PathLike):
        raise ValueError(f"model must be a FittedRMax model or the path of its file, got {model!r}")
    if not isinstance(model, FittedRMax):
        model = _load(Path(model))
    agent = model.agent
    if agent.model.n_instances == 0:
        raise ValueError("the model has not learned anything yet: call model.learn(total_timesteps) first")
    report = TransferReport.of_no_transfer() if agent.transfer is None else agent.transfer.report()
    if output is not None:
        folder = Path(output)
        planes = planes_of(agent.grid, agent.task.scaling, agent.task.state_names, variables, at)
        check_folder("output", folder)
        _save_pictures(agent, planes, folder)
        (folder / "report.txt").write_text(f"{report}\n", encoding="utf-8")
        if isinstance(agent.transfer, MappingTransfer):
            (folder / "mappings.md").write_text(
                f"{mapping_table(agent.transfer, agent.task.action_names)}\n", encoding="utf-8"
            )
        _write_page(model, report, planes, folder / PAGE)
    return report


def _load(path: Path) -> FittedRMax:
    if not path.exists() and not path.with_name(path.name + ".zip").exists():
        raise FileNotFoundError(f"there is no model file {path}, looked for in {Path.cwd()}; write one with: model.save(path)")
    return FittedRMax.load(path, verbose=0)


def _save_pictures(agent: FittedRMaxAgent, planes: Sequence[Plane], folder: Path) -> None:
    from matplotlib.image import imsave

    from sb3_combrel.tensorboard import pictures

    for tag, picture in pictures.over_planes(agent, planes, FILE_DPI).items():
        imsave(folder / f"{pictures.file_name(tag)}.png", picture)


def _write_page(model: FittedRMax, report: TransferReport, planes: Sequence[Plane], file: Path) -> None:
    # Matplotlib takes a moment to import.
    from sb3_combrel.tensorboard.model_page import model_page

    model_page(model, report, planes).write(file)
