"""What a transfer method did, as a report to read, with all figures accessible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    # What an agent imports goes without Stable-Baselines3, which sources use.
    from sb3_combrel.sources.source_instances import SourceInstances


class NotBoundError(ValueError, AttributeError):
    """
    Results were asked of a transfer object that no algorithm uses.

    It is both errors, as scikit-learn's ``NotFittedError`` is, so that ``hasattr`` works.
    """


@dataclass(frozen=True)
class MappingReport:
    """
    What one target action was taken for.

    Compliance is the mean of exp(-squared error / scale) over the target's own transitions with this action; errors are mean
    squared errors of predicted effects over those of "no change". What cannot be told is NaN.

    :param target_action: name of the target action
    :param mapping: source action and variables, by name; with ``use="instances"`` of the mapping used most
    :param share: fraction of this action's transfers that used this mapping
    :param n_mappings: number of mappings that were used for this action
    :param compliance: of this mapping; with ``use="instances"`` of what was chosen, averaged over states
    :param next_best: the mapping of the highest compliance among the others, by name; "" for none or another in each state
    :param next_best_compliance: its compliance
    :param no_change_compliance: compliance of the prediction that no variable changes
    :param error: prediction error of what was transferred
    :param next_best_error: prediction error of the next best
    :param n_compared: transitions that ``error`` is of
    :param trust: with ``use="prior"``, how far what the source claims to know is believed, from 0 to 1; else NaN
    """

    target_action: str
    mapping: str
    share: float = np.nan
    n_mappings: int = 1
    compliance: float = np.nan
    next_best: str = ""
    next_best_compliance: float = np.nan
    no_change_compliance: float = np.nan
    error: float = np.nan
    next_best_error: float = np.nan
    n_compared: int = 0
    trust: float = np.nan


@dataclass(frozen=True)
class Contradiction:
    """
    A part of the state space where the target's own transitions contradict what was transferred.

    :param target_action: name of the target action
    :param variable: name of the state variable
    :param low: where the part begins along it, raw units
    :param high: where it ends
    :param n_compared: transitions there
    :param error: mean squared error of the predicted effects over that of "no change", above 1; infinite where nothing moved
    """

    target_action: str
    variable: str
    low: float
    high: float
    n_compared: int
    error: float

    def __str__(self) -> str:
        times = "nothing moved there, the source says it does" if np.isinf(self.error) else f"{self.error:.2f}"
        where = f"{self.variable} from {self.low:.3g} to {self.high:.3g}"
        return f"{self.target_action}, {where}: {times} ({self.n_compared:,} steps)"


@dataclass(frozen=True)
class TransferReport:
    """
    What a transfer method did: print it, or read its fields.

    :param method: the method with its arguments
    :param use: "instances" or "prior"
    :param sources: the source tasks
    :param n_steps: steps of the target that were observed; None if the method does not count them
    :param n_rested: of these, steps whose action transferred instances predicted, or whose outcome the source, as a prior,
        claimed to know; None as above
    :param mappings: one for each target action that was mapped
    :param next_best: with a factored mapping, the next best division of the target's variables, by name; else ""
    :param next_best_error: its prediction error; ``error``: that of what was transferred, over all actions
    :param n_compared: steps on which predictions of the source were compared with what happened
    :param n_worse: of these, steps on which they were worse than "no change"
    :param contradictions: where they were worse on average, the worst first
    :param not_used: pairs of a target action and a variable for which the source explains so little that it is not used
    :param ends: episode ends where the source predicts them (confirmed), and ends predicted or not, wrongly (contradicted)
    :param rewards: transitions whose reward the source predicts rightly, and wrongly
    :param bounds_values: whether what is unknown counts as worth no more than the source's state that it is taken for
    :param statistics: the figures of the log, by name
    """

    method: str
    use: str
    sources: tuple[str, ...] = ()
    n_steps: int | None = None
    n_rested: int | None = None
    mappings: tuple[MappingReport, ...] = ()
    error: float = np.nan
    next_best: str = ""
    next_best_error: float = np.nan
    n_compared: int = 0
    n_worse: int = 0
    contradictions: tuple[Contradiction, ...] = ()
    not_used: tuple[tuple[str, str], ...] = ()
    ends: tuple[int, int] = (0, 0)
    rewards: tuple[int, int] = (0, 0)
    bounds_values: bool = False
    statistics: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        parts = [self._heading(), self._mappings(), self._contradictions()]
        if not self.mappings:
            parts.append(self._statistics())
        return "\n\n".join(part for part in parts if part)

    def _heading(self) -> str:
        lines = [self.method]
        if self.sources:
            lines.append(f"From {'; '.join(self.sources)}.")
        if self.n_steps is not None and self.n_rested is not None:
            share = 100 * self.n_rested / max(self.n_steps, 1)
            how = "the source claimed to know the outcome" if self.use == "prior" else "transferred instances predicted it"
            lines.append(f"{self.n_rested:,} of {self.n_steps:,} steps ({share:.0f} %) rested on the source: {how}.")
        if self.bounds_values:
            lines.append("The value of what is unknown is bounded by the source's value there.")
        return "\n".join(lines)

    def _mappings(self) -> str:
        if not self.mappings:
            return ""
        shared = any(each.n_mappings > 1 for each in self.mappings)
        rows = [("target action", "mapped to", *(("share", "mappings") if shared else ()), *_FIGURES)]
        for each in self.mappings:
            shares = (_text(each.share), f"{each.n_mappings}") if shared else ()
            compliances = (each.compliance, each.next_best_compliance, each.no_change_compliance)
            figures = tuple(_text(value) for value in (*compliances, each.error, each.next_best_error, each.trust))
            rows.append((each.target_action, each.mapping, *shares, *figures))
        kept = [column for column in zip(*rows, strict=True) if any(cell != "-" for cell in column[1:])]
        shown = [column[0] for column in kept]
        lines = [text for name, text in _EXPLANATIONS.items() if name in shown]
        lines += _aligned(list(zip(*kept, strict=True)))
        lines += [f"Next best for {each.target_action}: {each.next_best}." for each in self.mappings if each.next_best]
        if np.isfinite(self.error):
            lines.append(f"Prediction error over all actions: {_text(self.error)} (no change: 1).")
        if self.next_best:
            lines.append(f"Next best division: {self.next_best}; its prediction error: {_text(self.next_best_error)}.")
        return "\n".join(lines)

    def _contradictions(self) -> str:
        if not self.n_compared:
            return "No prediction of the source has been compared with what happened." if self.mappings else ""
        lines = [
            f'Compared on {self.n_compared:,} steps, the source was worse than "no change" on {self.n_worse:,} '
            f"({100 * self.n_worse / self.n_compared:.0f} %)."
        ]
        if self.contradictions:
            lines.append("Contradicted (prediction error above 1):")
            lines += [f"  {each}" for each in self.contradictions]
        else:
            lines.append("Nowhere was it contradicted on average.")
        if self.not_used:
            pairs = ", ".join(f"{variable} under {action}" for action, variable in self.not_used)
            lines.append(f"Not used any more, as the source explains too little of it: {pairs}.")
        for name, (right, wrong) in (("Ends of episodes", self.ends), ("Rewards", self.rewards)):
            if right or wrong:
                lines.append(f"{name}: {right:,} as the source predicts, {wrong:,} not.")
        return "\n".join(lines)

    def _statistics(self) -> str:
        if not self.statistics:
            return "The method says nothing of its mappings, and has no figures."
        rows = [(name, f"{value:g}") for name, value in self.statistics.items()]
        return "\n".join(["The method says nothing of its mappings; its figures:", *_aligned(rows)])


def describe_sources(sources: Sequence[SourceInstances]) -> tuple[str, ...]:
    """Name source tasks, and how many instances each has."""
    return tuple(f"{source.origin.get('env') or 'an unnamed task'} ({len(source):,} instances)" for source in sources)


_FIGURES = ("compliance", "next best", "no change", "error", "next best's", "trust")
_EXPLANATIONS = {
    "compliance": "Compliance: how well the mapping predicts the target's own transitions, 1 is exact; of the next best, and "
    'of "no change".',
    "error": 'Error: squared, of predicted effects, over that of "no change"; below 1 is better than that.',
    "trust": "Trust: how far what the source claims to know is believed, 0: not at all.",
}


def _text(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of cells in columns, text to the left and numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.ljust(w) if k < 2 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  " + "  ".join(cells).rstrip())
    return lines
