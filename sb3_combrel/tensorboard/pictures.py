"""
Pictures for TensorBoard's images tab, drawn without a display. Importing this imports matplotlib.

They are as wide as the tab's cards, which would leave out pixels of wider ones; ``dpi`` makes them larger for files.
"""

from __future__ import annotations

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
CHARACTERS = 62
"""About as many fit into the width."""


def value_and_policy(agent: FittedRMaxAgent, plane: Plane, dpi: int = DPI) -> np.ndarray:
    """
    Draw V at the grid points of a plane, and the greedy action of the model there.

    :param agent: the agent to show
    :param plane: where
    :param dpi: pixels an inch; the picture is 3.5 inches wide
    :return: RGB, uint8, shape (height, width, 3)
    """
    names = agent.task.action_names
    title = f"at {plane.held}" if plane.held else ""
    figure, (left, right) = _figure(1, 2, 1.5, title, _legend_lines(names, AN_OPTIMISTIC_ACTION), dpi)
    values = agent.planner.values[plane.points]
    # V between grid points is interpolated, so the picture is too.
    image = left.imshow(values, origin="lower", extent=plane.extent, aspect="auto", interpolation="bilinear")
    _few_ticks(left)
    figure.subplots_adjust(wspace=0.26)
    bar = figure.colorbar(image, ax=left, ticks=MaxNLocator(3), fraction=0.09, pad=0.05)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1, pad=1)
    _label(left, plane, "value V")
    _show_numbers(right, greedy_actions(agent, plane.points), plane, agent.task.n_actions)
    _label(right, plane, "greedy action")
    right.set_ylabel("")
    right.set_yticklabels([])
    _legend(figure, names, AN_OPTIMISTIC_ACTION, "target action")
    return _pixels(figure)


def greedy_actions(agent: FittedRMaxAgent, points: np.ndarray) -> np.ndarray:
    """
    Find the action with the highest Q at grid points, -1 where one is optimistic.

    :param agent: the agent
    :param points: int64, any shape
    :return: int64, same shape
    """
    q = action_values(agent, points)
    return np.where(np.isnan(q).any(axis=0), -1, np.nan_to_num(q, nan=-np.inf).argmax(axis=0))


def source_actions(agent: FittedRMaxAgent, transfer: MappingTransfer, plane: Plane, dpi: int = DPI) -> np.ndarray:
    """
    Draw the source action that each target action is mapped to, over a plane (Figure 4 of the COMBREL paper).

    A dot marks a grid point where the target's own instances suffice, so that nothing is transferred.

    :param agent: the agent to show
    :param transfer: its transfer method
    :param plane: where
    :param dpi: pixels an inch; the picture is 3.5 inches wide
    :return: RGB, uint8, shape (height, width, 3)
    """
    names, numbers = chosen_source_actions(transfer, plane.points, agent.task.n_actions)
    action_names = agent.task.action_names
    n_columns = min(agent.task.n_actions, 3 if max(map(len, action_names)) <= 14 else 2)
    n_rows = -(-agent.task.n_actions // n_columns)
    where = f", at {plane.held}" if plane.held else ""
    title = f"source action for each target action{where}; dots: own data suffice"
    figure, panels = _figure(n_rows, n_columns, 1.05, title, _legend_lines(names, "none"), dpi)
    for action, panel in enumerate(panels):
        if action >= agent.task.n_actions:
            panel.set_visible(False)
            continue
        _show_numbers(panel, numbers[action], plane, len(names))
        _mark_known(panel, agent, plane, action)
        _label(panel, plane, action_names[action])
        if action % n_columns:
            panel.set_ylabel("")
            panel.set_yticklabels([])
        if action + n_columns < agent.task.n_actions:
            panel.set_xlabel("")
            panel.set_xticklabels([])
    _legend(figure, names, "none", "source action")
    return _pixels(figure)


def chosen_source_actions(transfer: MappingTransfer, points: np.ndarray, n_actions: int) -> tuple[list[str], np.ndarray]:
    """
    Find the source action chosen for every target action at points of the sample.

    :param transfer: a transfer method that makes choices
    :param points: int64, any shape
    :param n_actions: number of target actions
    :return: names of all source actions, and for each target action and point a number into them, -1 for none
    """
    names = transfer.source_action_names()
    chosen = transfer.choices().reshape(n_actions, -1)[:, points]
    found = np.full(chosen.shape, -1, dtype=np.int64)
    for candidate in np.unique(chosen[chosen >= 0]):
        found[chosen == candidate] = names.index(transfer.candidate(int(candidate)).source_action)
    return names, found


def state_mappings(history: ChoiceHistory, transfer: MappingTransfer, dpi: int = DPI) -> np.ndarray:
    """
    Draw the share of the choices that each state mapping had, over the run.

    :param history: the choices so far, at one time at least
    :param transfer: the transfer method that made them
    :param dpi: pixels an inch; the picture is 3.5 inches wide
    :return: RGB, uint8, shape (height, width, 3)
    """
    names, shares = state_mapping_shares(history, transfer)
    steps = np.array(history.steps, dtype=np.float64)
    # A column begins where the one before was noted, and ends at its own time.
    edges = np.concatenate([[0.0 if len(steps) < 2 else max(0.0, 2 * steps[0] - steps[1])], steps])
    labels = [textwrap.fill(name, CHARACTERS // 2, break_long_words=True) for name in names]
    n_lines = sum(label.count("\n") + 1 for label in labels)
    height = 0.85 + 1.15 * LINE * max(n_lines + 0.4 * len(labels), 6)
    figure = Figure(figsize=(WIDTH, height), dpi=dpi)
    axes = figure.subplots()
    longest = max((len(line) for label in labels for line in label.split("\n")), default=0)
    left = min(0.6, 0.06 + longest / CHARACTERS)
    figure.subplots_adjust(left=left, right=0.91, bottom=0.4 / height, top=1 - 0.38 / height)
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
    """
    Find the state mappings chosen most, by name, and their shares of the choices at each time.

    :param history: the choices so far
    :param transfer: the transfer method that made them
    :return: names, the most chosen first and "others" last; float64, shape (n_names, n_times), columns add up to 1, or
        are 0 while nothing is chosen
    """
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
    n_rows: int, n_columns: int, row_height: float, title: str, n_legend_lines: int, dpi: int
) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels, with room for a title of any length above and for a legend of so many lines below."""
    lines = textwrap.wrap(title, CHARACTERS)
    above, below = LINE * len(lines) + 0.24, LINE * n_legend_lines + 0.4
    height = above + below + row_height * n_rows + 0.2 * (n_rows - 1)
    figure = Figure(figsize=(WIDTH, height), dpi=dpi)
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    figure.subplots_adjust(
        left=0.14, right=0.97, bottom=below / height, top=1 - above / height, wspace=0.12, hspace=0.24 / row_height
    )
    if lines:
        figure.text(0.5, 1 - 0.04 / height, "\n".join(lines), ha="center", va="top", fontsize=FONT_SIZE)
    return figure, list(axes.flat)


def _legend_columns(names: Sequence[str], for_none: str) -> int:
    longest = max(len(name) for name in (*names, for_none))
    return max(1, min(len(names) + 1, CHARACTERS // (longest + 5)))


def _legend_lines(names: Sequence[str], for_none: str) -> int:
    """Return how many lines a legend has, its title among them."""
    return 1 + -(-(len(names) + 1) // _legend_columns(names, for_none))


def _show_numbers(axes: Axes, numbers: np.ndarray, plane: Plane, n_colours: int) -> None:
    """Draw a colour for each number, and light grey for -1."""
    palette = np.array([*(to_rgb(COLOURS[k % len(COLOURS)]) for k in range(n_colours)), to_rgb(NONE_COLOUR)])
    axes.imshow(palette[numbers], origin="lower", extent=plane.extent, aspect="auto", interpolation="nearest")
    _few_ticks(axes)


def _few_ticks(axes: Axes) -> None:
    """Draw two or three ticks on an axis: most of the time that a picture takes is spent on ticks."""
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3))


def _mark_known(axes: Axes, agent: FittedRMaxAgent, plane: Plane, action: int) -> None:
    known = agent.model.known[plane.points + action * agent.grid.n_points]
    rows, columns = np.nonzero(known)
    left, right, bottom, top = plane.extent
    n_rows, n_columns = known.shape
    x = left + (columns + 0.5) * (right - left) / n_columns
    y = bottom + (rows + 0.5) * (top - bottom) / n_rows
    axes.plot(x, y, ".", color="black", markersize=3 if max(known.shape) < 20 else 1)


def _legend(figure: Figure, names: Sequence[str], for_none: str, title: str) -> None:
    colours = [COLOURS[k % len(COLOURS)] for k in range(len(names))]
    patches = [Patch(color=c, label=name) for c, name in zip((*colours, NONE_COLOUR), (*names, for_none), strict=True)]
    figure.legend(
        handles=patches,
        loc="lower center",
        ncols=_legend_columns(names, for_none),
        frameon=False,
        fontsize=FONT_SIZE,
        title=title,
        title_fontsize=FONT_SIZE,
        borderpad=0.1,
        labelspacing=0.25,
        columnspacing=1.0,
        handlelength=1.2,
    )


def _label(axes: Axes, plane: Plane, title: str) -> None:
    axes.set_title(title, fontsize=FONT_SIZE, pad=3)
    axes.set_xlabel(plane.names[0], fontsize=FONT_SIZE, labelpad=1)
    axes.set_ylabel(plane.names[1], fontsize=FONT_SIZE, labelpad=1)
    axes.tick_params(labelsize=FONT_SIZE - 1, pad=2)


def _pixels(figure: Figure) -> np.ndarray:
    # Agg directly, without pyplot, whose figures and back end belong to the user.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
