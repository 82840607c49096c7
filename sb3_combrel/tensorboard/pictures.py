"""Pictures for TensorBoard's images tab: RGB arrays, uint8, shape (height, width, 3), 640 pixels wide.

Importing this imports matplotlib; no display is needed. ``dpi`` makes them larger for files.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.pages.drawings import (
    CHARACTERS,
    FONT_SIZE,
    LINE,
    figure_of,
    label_plane,
    panels_with_legend,
    show_numbers,
    value_figure,
)
from sb3_combrel.pages.evidence_drawings import evidence_figure
from sb3_combrel.pages.palette import MAPPING_COLOURS, mapping_colours
from sb3_combrel.pages.plane import Plane
from sb3_combrel.pages.snapshot import snapshot_of
from sb3_combrel.tensorboard.history import ChoiceHistory
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.prior.prior_history import evidence_points

MAX_ROWS = 14
WIDTH = 6.4  # inches
DPI = 100


def over_planes(agent: FittedRMaxAgent, planes: Sequence[Plane], dpi: int = DPI) -> dict[str, np.ndarray]:
    """Draw what there is to show over each plane, and the evidence over time, by TensorBoard's tag."""
    drawn, snapshot = {}, snapshot_of(agent, planes)
    for plane in planes:
        over = "_".join(name for name in plane.names if name)
        drawn[f"value_and_policy/{over}"] = _pixels(value_figure(snapshot, plane, WIDTH), dpi)
        if varies_by_state(agent.transfer):
            drawn[f"source_action/{over}"] = _pixels(source_action_figure(agent, agent.transfer, plane, WIDTH), dpi)
    if is_prior(agent.transfer):
        drawn["evidence/over_time"] = _pixels(evidence_of_agent(agent, WIDTH), dpi)
    return drawn


def is_prior(transfer: Transfer | None) -> bool:
    """Return whether a method has evidence over time."""
    return isinstance(transfer, MappingTransfer) and transfer.use == "prior"


def varies_by_state(transfer: Transfer | None) -> bool:
    """Return whether a method chooses mappings state by state."""
    return isinstance(transfer, MappingTransfer) and transfer.makes_choices and not is_prior(transfer)


def colours_of_mappings(transfer: Transfer | None) -> dict[str, str]:
    """Give each mapping that was ever in use, or each source action, its colour by name, the same in all pictures of a run."""
    if not isinstance(transfer, MappingTransfer):
        return mapping_colours(())
    return mapping_colours(transfer.source_prior.candidates.names() if is_prior(transfer) else transfer.source_action_names())


def evidence_of_agent(agent: FittedRMaxAgent, width: float) -> Figure:
    """Draw the evidence over time of an agent with a source as prior."""
    transfer = agent.transfer
    assert isinstance(transfer, MappingTransfer)
    prior = transfer.source_prior
    points = evidence_points(prior)
    return evidence_figure(points, agent.task.action_names, colours_of_mappings(transfer), width)


def file_name(tag: str) -> str:
    """Make a name for the file of a picture from its tag."""
    kind, over = tag.split("/", 1)
    return f"{kind}_" + re.sub(r"\W+", "-", over)


def source_action_figure(agent: FittedRMaxAgent, transfer: Transfer | None, plane: Plane, width: float) -> Figure:
    """Draw each target action's source action over a plane (Figure 4 of the COMBREL paper); a dot: own instances suffice."""
    assert isinstance(transfer, MappingTransfer)
    names, numbers = chosen_source_actions(transfer, plane.points, agent.task.n_actions)
    action_names = agent.task.action_names
    most = max(1, int(width * CHARACTERS) // (max(map(len, action_names)) + 10))
    n_columns = min(len(action_names), most, 5 if width > WIDTH else 3)
    n_rows = -(-len(action_names) // n_columns)
    where = f", at {plane.held}" if plane.held else ""
    title = f"source action for each target action{where}; dots: own data suffice"
    figure, panels = panels_with_legend(
        width, (n_rows, n_columns), 1.5, title, (names, "none", "source action"), MAPPING_COLOURS
    )
    for panel in panels[len(action_names) :]:
        panel.remove()
    for action, (panel, name) in enumerate(zip(panels, action_names, strict=False)):
        show_numbers(panel, numbers[action], plane, len(names))
        _mark_known(panel, agent, plane, action)
        label_plane(panel, plane, name)
    return figure


def chosen_source_actions(transfer: MappingTransfer, points: np.ndarray, n_actions: int) -> tuple[list[str], np.ndarray]:
    """Find names of all source actions, and numbers of those chosen, by target action and point; -1 for none."""
    chosen = transfer.choices().reshape(n_actions, -1)[:, points]
    # Only now: candidates are listed when they are first chosen.
    names = transfer.source_action_names()
    found = np.full(chosen.shape, -1, dtype=np.int64)
    for candidate in np.unique(chosen[chosen >= 0]):
        found[chosen == candidate] = names.index(transfer.candidate(int(candidate)).source_action)
    return names, found


def state_mappings(history: ChoiceHistory, transfer: MappingTransfer, dpi: int = DPI) -> np.ndarray:
    """Draw the share of the choices that each state mapping had, over the run; ``history`` has one time at least."""
    names, shares = state_mapping_shares(history, transfer)
    steps = np.array(history.steps, dtype=np.float64)
    # A column begins where the one before was noted, and ends at its own time.
    edges = np.concatenate([[0.0 if len(steps) < 2 else max(0.0, 2 * steps[0] - steps[1])], steps])
    labels = [textwrap.fill(name, int(WIDTH * CHARACTERS) // 2, break_long_words=True) for name in names]
    n_lines = sum(label.count("\n") + 1.4 for label in labels)
    figure = figure_of(WIDTH, 0.9 + 1.15 * LINE * max(n_lines, 6))
    axes = figure.subplots()
    # One hue: the colours of mappings would name others.
    mesh = axes.pcolormesh(edges, np.arange(len(names) + 1), shares, vmin=0.0, cmap="Greys")
    axes.set_yticks(np.arange(len(names)) + 0.5, labels, fontsize=FONT_SIZE)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("environment steps", fontsize=FONT_SIZE)
    axes.tick_params(axis="x", labelsize=FONT_SIZE)
    figure.suptitle("state mappings: share of the state-action pairs that chose each", fontsize=FONT_SIZE)
    figure.colorbar(mesh, ax=axes, fraction=0.07, pad=0.03, ticks=MaxNLocator(3)).ax.tick_params(labelsize=FONT_SIZE - 1)
    return _pixels(figure, dpi)


def state_mapping_shares(history: ChoiceHistory, transfer: MappingTransfer) -> tuple[list[str], np.ndarray]:
    """Find the state mappings chosen most, by name, "others" last, and their shares at each time, shape (n_names, n_times)."""
    table = history.table()
    by_name: dict[str, np.ndarray] = {}
    for candidate in np.flatnonzero(table.sum(axis=1)):
        name = transfer.candidate(int(candidate)).state_mapping
        by_name[name] = by_name.get(name, np.zeros(table.shape[1])) + table[candidate]
    ranked = sorted(by_name.items(), key=lambda item: -item[1].sum())
    if len(ranked) > MAX_ROWS:
        others = np.sum([counts for _, counts in ranked[MAX_ROWS - 1 :]], axis=0)
        ranked = [*ranked[: MAX_ROWS - 1], ("others", others)]
    names = [name for name, _ in ranked]
    counts = np.array([counts for _, counts in ranked]).reshape(len(names), table.shape[1])
    return names, counts / np.maximum(counts.sum(axis=0), 1.0)


def _mark_known(axes: Axes, agent: FittedRMaxAgent, plane: Plane, action: int) -> None:
    known = agent.model.known[plane.points + action * agent.grid.n_points]
    rows, columns = np.nonzero(known)
    left, right, bottom, top = plane.extent
    n_rows, n_columns = known.shape
    x = left + (columns + 0.5) * (right - left) / n_columns
    y = bottom + (rows + 0.5) * (top - bottom) / n_rows
    axes.plot(x, y, ".", color="black", markersize=3 if max(known.shape) < 20 else 1)


def _pixels(figure: Figure, dpi: int = DPI) -> np.ndarray:
    # Agg directly, without pyplot, whose figures and back end belong to the user.
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
