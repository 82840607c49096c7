"""Pictures for TensorBoard's images tab, drawn without a display. Importing this imports matplotlib."""

from __future__ import annotations

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
from sb3_combrel.transfer.mapping_transfer import MappingTransfer

#: Okabe and Ito's colours, which the colour-blind can distinguish too; they are repeated where there are more actions.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#555555")
NONE_COLOUR = "#EEEEEE"

PANELS_PER_ROW = 3
MAX_ROWS = 14
DPI = 90


def value_and_policy(agent: FittedRMaxAgent, plane: Plane) -> np.ndarray:
    """
    Draw V at the grid points of a plane, and the greedy action of the model there.

    :param agent: the agent to show
    :param plane: where
    :return: RGB, uint8, shape (height, width, 3)
    """
    figure = Figure(figsize=(8.6, 3.4), dpi=DPI)
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.08, right=0.79, bottom=0.14, top=0.84, wspace=0.3)
    values = agent.planner.values[plane.points]
    # V between grid points is interpolated, so the picture is too.
    image = left.imshow(values, origin="lower", extent=plane.extent, aspect="auto", interpolation="bilinear")
    _few_ticks(left)
    figure.colorbar(image, ax=left, ticks=MaxNLocator(4)).ax.tick_params(labelsize=8)
    _label(left, plane, "value V")
    _show_numbers(right, greedy_actions(agent, plane.points), plane, agent.task.n_actions)
    _label(right, plane, "greedy action")
    _legend(figure, agent.task.action_names, "an action without\na model", "target action")
    if plane.held:
        figure.suptitle(f"at {plane.held}", fontsize=9)
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


def source_actions(agent: FittedRMaxAgent, transfer: MappingTransfer, plane: Plane) -> np.ndarray:
    """
    Draw the source action that each target action is mapped to, over a plane (Figure 4 of the COMBREL paper).

    A dot marks a grid point where the target's own instances suffice, so that nothing is transferred.

    :param agent: the agent to show
    :param transfer: its transfer method
    :param plane: where
    :return: RGB, uint8, shape (height, width, 3)
    """
    names, numbers = chosen_source_actions(transfer, plane.points, agent.task.n_actions)
    n_columns = min(agent.task.n_actions, PANELS_PER_ROW)
    n_rows = -(-agent.task.n_actions // n_columns)
    figure = Figure(figsize=(2.05 * n_columns + 1.9, 2.1 * n_rows + 0.75), dpi=DPI)
    axes = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    height, width = figure.get_figheight(), figure.get_figwidth()
    figure.subplots_adjust(
        left=0.6 / width, right=1 - 1.45 / width, bottom=0.5 / height, top=1 - 0.6 / height, wspace=0.1, hspace=0.3
    )
    for action, panel in enumerate(axes.flat):
        if action >= agent.task.n_actions:
            panel.set_visible(False)
            continue
        _show_numbers(panel, numbers[action], plane, len(names))
        _mark_known(panel, agent, plane, action)
        panel.set_title(agent.task.action_names[action], fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel(plane.names[0], fontsize=8)
    for panel in axes[:, 0]:
        panel.set_ylabel(plane.names[1], fontsize=8)
    for panel in axes.flat:
        panel.tick_params(labelsize=7)
    _legend(figure, names, "none", "source action")
    where = f", at {plane.held}" if plane.held else ""
    figure.suptitle(f"source action for each target action{where}; dots: own data suffice", fontsize=9)
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


def state_mappings(history: ChoiceHistory, transfer: MappingTransfer) -> np.ndarray:
    """
    Draw the share of the choices that each state mapping had, over the run.

    :param history: the choices so far, at one time at least
    :param transfer: the transfer method that made them
    :return: RGB, uint8, shape (height, width, 3)
    """
    names, shares = state_mapping_shares(history, transfer)
    steps = np.array(history.steps, dtype=np.float64)
    # A column begins where the one before was noted, and ends at its own time.
    edges = np.concatenate([[0.0 if len(steps) < 2 else max(0.0, 2 * steps[0] - steps[1])], steps])
    figure = Figure(figsize=(8.0, 1.2 + 0.24 * max(len(names), 6)), dpi=DPI)
    axes = figure.subplots()
    height = figure.get_figheight()
    figure.subplots_adjust(left=0.24, right=0.98, bottom=0.5 / height, top=1 - 0.4 / height)
    mesh = axes.pcolormesh(edges, np.arange(len(names) + 1), shares, vmin=0.0, cmap="Blues")
    axes.set_yticks(np.arange(len(names)) + 0.5, names, fontsize=8)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("environment steps", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_title("state mappings: share of the state-action pairs that chose each", fontsize=9)
    figure.colorbar(mesh, ax=axes, fraction=0.05, pad=0.02, ticks=MaxNLocator(4)).ax.tick_params(labelsize=8)
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


# -------------------------------------------------------------------- drawing


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
    figure.legend(handles=patches, loc="center right", frameon=False, fontsize=8, title=title, title_fontsize=8)


def _label(axes: Axes, plane: Plane, title: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(plane.names[0], fontsize=8)
    axes.set_ylabel(plane.names[1], fontsize=8)
    axes.tick_params(labelsize=8)


def _pixels(figure: Figure) -> np.ndarray:
    # Agg directly, without pyplot, whose figures and back end belong to the user.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
