"""What transfer did in a model: a report as text, and the dashboard's pictures as files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.plane import Plane, VariablePair, check_matplotlib, planes_of
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
    """Say what transfer did in a model that has learned.

    Which mappings, by name; how sure they are, against the next best and against "no change"; where the target's own
    transitions contradicted the source; how many steps rested on it::

        report = sb3_combrel.explain("car.zip", output="explained")
        print(report)
        print(report.mappings[0].target_action, report.mappings[0].compliance)

    :param model: the model, or the path of its file
    :param output: a folder for the report, ``report.txt``, the pictures of the dashboard as PNG (V and policy over two state
        variables, and the source action of each target action), and its table of the mappings used most, ``mappings.md``. A
        transfer method without mappings has the report and V only. None: nothing is written
    :param variables: pairs of state variables, by number or name, over which is drawn; None for the first two
    :param at: state (raw units) through which the pictures' plane goes; None for the middle of the state space
    :return: the report; ``print`` it, or read its fields
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is no model of Fitted R-Max, it has no transfer method or has not learned anything, or
        variables or state do not fit
    :raises ModuleNotFoundError: if pictures are wanted and matplotlib is not installed
    """
    agent = (model if isinstance(model, FittedRMax) else _load(Path(model))).agent
    if agent.transfer is None:
        raise ValueError(
            "the model has no transfer method, so there is nothing to explain; "
            "one that has: FittedRMax(env, transfer=COMBREL(source))"
        )
    if agent.model.n_instances == 0:
        raise ValueError("the model has not learned anything yet: call model.learn(total_timesteps) first")
    report = agent.transfer.report()
    if output is not None:
        check_matplotlib("leave output out")
        folder, planes = Path(output), planes_of(agent, variables, at)
        folder.mkdir(parents=True, exist_ok=True)
        _save_pictures(agent, planes, folder)
        (folder / "report.txt").write_text(f"{report}\n")
        if isinstance(agent.transfer, MappingTransfer):
            (folder / "mappings.md").write_text(f"{mapping_table(agent.transfer, agent.task.action_names)}\n")
    return report


def _load(path: Path) -> FittedRMax:
    if not path.exists() and not path.with_name(path.name + ".zip").exists():
        raise FileNotFoundError(f"there is no model file {path}, looked for in {Path.cwd()}; write one with: model.save(path)")
    return FittedRMax.load(path)


def _save_pictures(agent: FittedRMaxAgent, planes: Sequence[Plane], folder: Path) -> None:
    from matplotlib.image import imsave

    from sb3_combrel.tensorboard import pictures

    for tag, picture in pictures.over_planes(agent, planes, FILE_DPI).items():
        imsave(folder / f"{pictures.file_name(tag)}.png", picture)
