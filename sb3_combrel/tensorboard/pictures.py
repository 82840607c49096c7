"""Pictures for TensorBoard's images tab, as wide as its cards: RGB arrays, uint8, shape (height, width, 3).

Importing this imports matplotlib; no display is needed. ``dpi`` makes them larger for files.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.tensorboard.history import ChoiceHistory
from sb3_combrel.tensorboard.plane import Plane
from sb3_combrel.tensorboard.readings import action_values
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

#: Okabe and Ito's colours, which the colour-blind can distinguish too; they are repeated where there are more actions.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#555555")
NONE_COLOUR = "#EEEEEE"
AN_OPTIMISTIC_ACTION = "one has no model"

MAX_ROWS = 14
WIDTH = 3.5  # inches
DPI = 100
FONT_SIZE = 7
LINE = 0.14  # inches, of a line of text of that size
CHARACTERS = 62  # about as many fit into the width


def over_planes(agent: FittedRMaxAgent, planes: Sequence[Plane], dpi: int = DPI) -> dict[str, np.ndarray]:
    """Draw what there is to show over each plane, by TensorBoard's tag."""
    drawn = {}
    for plane in planes:
        over = "_".join(name for name in plane.names if name)
        drawn[f"value_and_policy/{over}"] = value_and_policy(agent, plane, dpi)
        if isinstance(agent.transfer, MappingTransfer) and agent.transfer.makes_choices:
            drawn[f"source_action/{over}"] = source_actions(agent, agent.transfer, plane, dpi)
    return drawn


def file_name(tag: str) -> str:
    """Make a name for the file of a picture from its tag."""
    kind, over = tag.split("/", 1)
    return f"{kind}_" + re.sub(r"\W+", "-", over)


def value_and_policy(agent: FittedRMaxAgent, plane: Plane, dpi: int = DPI) -> np.ndarray:
    """Draw V at the grid points of a plane, and the greedy action of the model there."""
    names = agent.task.action_names
    title = f"at {plane.held}" if plane.held else ""
    figure, (left, right) = _figure(1, 2, 1.5, title, names, AN_OPTIMISTIC_ACTION, "target action", dpi)
    # V between grid points is interpolated, so the picture is too.
    values = agent.planner.values[plane.points]
    image = left.imshow(values, origin="lower", extent=plane.extent, aspect="auto", interpolation="bilinear")
    bar = figure.colorbar(image, ax=left, ticks=MaxNLocator(3), fraction=0.09, pad=0.05)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1, pad=1)
    _label(left, plane, "value V")
    _show_numbers(right, greedy_actions(agent, plane.points), plane, agent.task.n_actions)
    _label(right, plane, "greedy action")
    return _pixels(figure)


def greedy_actions(agent: FittedRMaxAgent, points: np.ndarray) -> np.ndarray:
    """Find the action with the highest Q at grid points, -1 where one is optimistic; int64, the shape of the points."""
    q = action_values(agent, points)
    return np.where(np.isnan(q).any(axis=0), -1, np.nan_to_num(q, nan=-np.inf).argmax(axis=0))


def source_actions(agent: FittedRMaxAgent, transfer: MappingTransfer, plane: Plane, dpi: int = DPI) -> np.ndarray:
    """Draw each target action's source action over a plane (Figure 4 of the COMBREL paper); a dot: own instances suffice."""
    names, numbers = chosen_source_actions(transfer, plane.points, agent.task.n_actions)
    action_names = agent.task.action_names
    n_columns = min(len(action_names), 3 if max(map(len, action_names)) <= 14 else 2)
    n_rows = -(-len(action_names) // n_columns)
    where = f", at {plane.held}" if plane.held else ""
    title = f"source action for each target action{where}; dots: own data suffice"
    figure, panels = _figure(n_rows, n_columns, 1.05, title, names, "none", "source action", dpi)
    for panel in panels[len(action_names) :]:
        panel.remove()
    for action, (panel, name) in enumerate(zip(panels, action_names, strict=False)):
        _show_numbers(panel, numbers[action], plane, len(names))
        _mark_known(panel, agent, plane, action)
        _label(panel, plane, name)
    return _pixels(figure)


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
    labels = [textwrap.fill(name, CHARACTERS // 2, break_long_words=True) for name in names]
    n_lines = sum(label.count("\n") + 1.4 for label in labels)
    figure = Figure(figsize=(WIDTH, 0.85 + 1.15 * LINE * max(n_lines, 6)), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    mesh = axes.pcolormesh(edges, np.arange(len(names) + 1), shares, vmin=0.0, cmap="Blues")
    axes.set_yticks(np.arange(len(names)) + 0.5, labels, fontsize=FONT_SIZE)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(3, integer=True))
    axes.set_xlabel("environment steps", fontsize=FONT_SIZE)
    axes.tick_params(axis="x", labelsize=FONT_SIZE)
    figure.suptitle("state mappings: share of the state-action\npairs that chose each", fontsize=FONT_SIZE + 1)
    figure.colorbar(mesh, ax=axes, fraction=0.07, pad=0.03, ticks=MaxNLocator(3)).ax.tick_params(labelsize=FONT_SIZE - 1)
    return _pixels(figure)


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


def _figure(
    n_rows: int, n_columns: int, row_height: float, title: str, names: Sequence[str], for_none: str, names_of: str, dpi: int
) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels, with a title of any length above and a legend of the names' colours below."""
    lines = textwrap.wrap(title, CHARACTERS)
    n_columns_of_legend = max(1, min(len(names) + 1, CHARACTERS // (max(map(len, (*names, for_none))) + 5)))
    n_lines = len(lines) + 1 + -(-(len(names) + 1) // n_columns_of_legend)
    height = 0.6 + LINE * n_lines + row_height * n_rows + 0.2 * (n_rows - 1)
    figure = Figure(figsize=(WIDTH, height), dpi=dpi, layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    if lines:
        figure.suptitle("\n".join(lines), fontsize=FONT_SIZE)
    patches = [Patch(color=_colour(k), label=name) for k, name in enumerate(names)]
    figure.legend(
        handles=[*patches, Patch(color=NONE_COLOUR, label=for_none)],
        loc="outside lower center",
        ncols=n_columns_of_legend,
        frameon=False,
        fontsize=FONT_SIZE,
        title=names_of,
        title_fontsize=FONT_SIZE,
        borderpad=0.1,
        labelspacing=0.25,
        columnspacing=1.0,
        handlelength=1.2,
    )
    return figure, list(axes.flat)


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _show_numbers(axes: Axes, numbers: np.ndarray, plane: Plane, n_colours: int) -> None:
    """Draw a colour for each number, and light grey for -1."""
    palette = np.array([to_rgb(colour) for colour in (*map(_colour, range(n_colours)), NONE_COLOUR)])
    axes.imshow(palette[numbers], origin="lower", extent=plane.extent, aspect="auto", interpolation="nearest")


def _mark_known(axes: Axes, agent: FittedRMaxAgent, plane: Plane, action: int) -> None:
    known = agent.model.known[plane.points + action * agent.grid.n_points]
    rows, columns = np.nonzero(known)
    left, right, bottom, top = plane.extent
    n_rows, n_columns = known.shape
    x = left + (columns + 0.5) * (right - left) / n_columns
    y = bottom + (rows + 0.5) * (top - bottom) / n_rows
    axes.plot(x, y, ".", color="black", markersize=3 if max(known.shape) < 20 else 1)


def _label(axes: Axes, plane: Plane, title: str) -> None:
    axes.set_title(title, fontsize=FONT_SIZE, pad=3)
    axes.set_xlabel(plane.names[0], fontsize=FONT_SIZE, labelpad=1)
    axes.set_ylabel(plane.names[1], fontsize=FONT_SIZE, labelpad=1)
    axes.tick_params(labelsize=FONT_SIZE - 1, pad=2)
    # Most of the time that a picture takes is spent on ticks.
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.label_outer()


def _pixels(figure: Figure) -> np.ndarray:
    # Agg directly, without pyplot, whose figures and back end belong to the user.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
