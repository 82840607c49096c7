"""What a transfer method did, as a report to read, with all figures accessible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_combrel.common.serialisation import register_reader, register_writer

if TYPE_CHECKING:
    # What an agent imports goes without Stable-Baselines3, which sources use.
    from sb3_combrel.sources.source_instances import SourceInstances


class NotBoundError(ValueError, AttributeError):
    """Results were asked of a transfer object that no algorithm uses.

    It is both errors, as scikit-learn's ``NotFittedError`` is, so that ``hasattr`` works.
    """


#: A part of the states with fewer transitions says nothing.
MIN_IN_PART = 10
#: Said also of a source that was worse than no change on most of a few steps.
NOWHERE = f"In no part of the states with at least {MIN_IN_PART} steps was it contradicted on average."


@dataclass(frozen=True)
class MappingReport:
    """What one target action was taken for.

    Compliance is the mean of exp(-squared error / scale) over the target's own transitions with this action; errors are mean
    squared errors of predicted effects over those of "no change". What cannot be told is NaN.
    """

    target_action: str
    mapping: str  #: source action and variables, by name; with ``use="instances"`` of the mapping used most
    share: float = np.nan  #: fraction of this action's transfers that used this mapping
    n_mappings: int = 1  #: number of mappings that were used for this action
    compliance: float = np.nan  #: of this mapping; with ``use="instances"`` of what was chosen, averaged over states
    next_best: str = ""  #: the mapping of the highest compliance among the others; "" for none or another in each state
    next_best_compliance: float = np.nan
    no_change_compliance: float = np.nan  #: compliance of the prediction that no variable changes
    error: float = np.nan  #: prediction error of what was transferred
    next_best_error: float = np.nan
    n_compared: int = 0  #: transitions that ``error`` is of
    strength: float = np.nan  #: with ``use="prior"``, as how many of the target's own instances the source counts
    no_source: float = np.nan  #: the same: the posterior probability that the target's own instances alone predict better


@dataclass(frozen=True)
class Contradiction:
    """A part of the state space where the target's own transitions contradict what was transferred."""

    target_action: str
    variable: str  #: name of the state variable
    low: float  #: where the part begins along it, raw units
    high: float  #: where it ends
    n_compared: int  #: transitions there
    error: float  #: mean squared error of the effects over that of "no change", above 1; infinite where nothing moved

    @property
    def where(self) -> str:
        """The part in words."""
        return f"{self.variable} from {self.low:.3g} to {self.high:.3g}"

    def __str__(self) -> str:
        times = "nothing moved there, the source says it does" if np.isinf(self.error) else f"{self.error:.2f}"
        return f"{self.target_action}, {self.where}: {times} ({self.n_compared:,} steps)"


@dataclass(frozen=True)
class EvidencePoint:
    """What a source was worth at one time of learning, with ``use="prior"``; it holds until the next point."""

    step: int  #: steps of the target that were observed by then
    error: float  #: mean squared error of the mapping in use over that of "no change", also where the source has no data
    exceeded: float  #: by how much returns had exceeded the source's values
    bounds_values: bool  #: whether the source's values bounded what is unknown
    strengths: tuple[float, ...]  #: by target action: as how many of the target's own instances the source counted
    mappings: tuple[str, ...]  #: by target action: what it was taken for, as in :class:`MappingReport`


@dataclass(frozen=True)
class TransferReport:
    """What a transfer method did: print it, or read its fields."""

    method: str  #: with its arguments
    use: str  #: "instances", "prior" or "actions"; "none" of a model without transfer
    sources: tuple[str, ...] = ()
    n_steps: int | None = None  #: steps of the target that were observed; None if the method does not count them
    #: Of these, steps whose action transferred instances predicted; None with ``use="prior"``.
    n_rested: int | None = None
    mappings: tuple[MappingReport, ...] = ()  #: one for each target action that was mapped
    #: Prediction error of what was transferred, over all actions; with ``use="prior"`` also where the source has no data.
    error: float = np.nan
    next_best: str = ""  #: with a factored mapping, the next best division of the target's variables, by name
    next_best_error: float = np.nan
    n_compared: int = 0  #: steps on which predictions of the source were compared with what happened, where it has data
    n_worse: int = 0  #: of these, steps on which they were worse than "no change"
    contradictions: tuple[Contradiction, ...] = ()  #: where they were worse on average, the worst first
    ends: tuple[int, int] = (0, 0)  #: episode ends where the source predicts them, and ends predicted or not, wrongly
    rewards: tuple[int, int] = (0, 0)  #: transitions whose reward the source predicts rightly, and wrongly
    bounds_values: bool = False  #: whether what is unknown is worth no more than the source's state that it is taken for
    why_unbounded: str = ""  #: with ``use="prior"``: why not
    bound: tuple[float, ...] = ()  #: the least, the median and the largest of these bounds over the sample of states
    #: What bounds values, where that is not the mapping in use: whole copies in place of parts of a source, or mirror images.
    bounded_through: str = ""
    statistics: Mapping[str, float] = field(default_factory=dict)  #: the figures of the log, by name
    source_actions: tuple[str, ...] = ()  #: with ``use="instances"``, the names of the source actions of all sources
    history: tuple[EvidencePoint, ...] = ()  #: the evidence over time; empty where none is kept

    @classmethod
    def of_no_transfer(cls) -> TransferReport:
        """Return the report of a model without a transfer method."""
        return cls(method="no transfer", use="none")

    @property
    def sentence(self) -> str:
        """How well the source explained the target, in one sentence."""
        if self.use == "none":
            return "The model has no transfer method: what it knows is its own."
        if self.says_nothing:
            return NO_MAPPING
        if not self.mappings and not self.n_compared:
            return "The method does not say how well the source explains the target; its figures may."
        if not self.n_compared or np.isnan(self.error):
            return "Nothing can be said of the source: none of its predictions has been compared with what happened."
        well = "well" if self.error < 0.5 else "in part" if self.error < 1.0 else "no better than that nothing changes"
        worse = 100 * self.n_worse / self.n_compared
        judged = f"its prediction error is {_text(self.error)} (no change: 1)"
        where = f"where it has data it was worse than no change on {worse:.0f} % of {self.n_compared:,} steps"
        more = ", and its values bound those of what is unknown" if self.bounds_values else ""
        return f"The source explains the target {well}: {judged}; {where}{more}."

    @property
    def says_nothing(self) -> bool:
        """Whether a source was compared with the target, and is taken for nothing."""
        nothing = self.use == "prior" and bool(self.mappings) and all(np.isnan(each.strength) for each in self.mappings)
        return nothing and bool(self.n_steps)

    @property
    def comparison(self) -> str:
        """How often the source was worse than "no change", in one sentence."""
        if self.says_nothing:
            return NO_MAPPING
        if not self.n_compared:
            return "No prediction of the source has been compared with what happened."
        share = f"{self.n_worse:,} ({100 * self.n_worse / self.n_compared:.0f} %)"
        return f'Compared on {self.n_compared:,} steps, the source was worse than "no change" on {share}.'

    def __str__(self) -> str:
        if self.use == "none":
            return self.sentence
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
            rested = f"{self.n_rested:,} of {self.n_steps:,} steps ({share:.0f} %)"
            lines.append(f"{rested} rested on the source: transferred instances predicted it.")
        if self.bounds_values:
            more = self.statistics.get("transfer/bound_exceeded", 0.0)
            raised = f", and {more:.3g} more, by which returns exceeded it" if more > 0.0 else ""
            through = f", seen through {self.bounded_through}" if self.bounded_through else ""
            how = f"; from {self.bound[0]:.3g} to {self.bound[-1]:.3g}, median {self.bound[1]:.3g}" if self.bound else ""
            lines.append(f"The value of what is unknown is bounded by the source's value there{through}{raised}{how}.")
        elif self.why_unbounded:
            lines.append(f"The source's values do not bound that of what is unknown: {self.why_unbounded}.")
        return "\n".join(lines)

    def _mappings(self) -> str:
        if not self.mappings:
            return ""
        shared = any(each.n_mappings > 1 for each in self.mappings)
        rows = [("target action", "mapped to", *(("share", "mappings") if shared else ()), *_FIGURES)]
        for each in self.mappings:
            shares = (_text(each.share), f"{each.n_mappings}") if shared else ()
            compliances = (each.compliance, each.next_best_compliance, each.no_change_compliance)
            figures = tuple(
                _text(value) for value in (*compliances, each.error, each.next_best_error, each.strength, each.no_source)
            )
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
        if self.says_nothing or not self.n_compared:
            return self.comparison if self.mappings else ""
        where = [f"  {each}" for each in self.contradictions]
        lines = [self.comparison, *(["Contradicted (prediction error above 1):", *where] if where else [NOWHERE])]
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
    """Name source tasks, and how many instances each has, and of which actions it has none."""
    return tuple(
        f"{source.origin.get('env') or 'an unnamed task'} ({len(source):,} instances{source.words_for_missing_actions()})"
        for source in sources
    )


NO_MAPPING = "The source is taken for nothing: no mapping explains the target better than that nothing changes."
_FIGURES = ("compliance", "next best", "no change", "error", "next best's", "strength", "no source")
_EXPLANATIONS = {
    "compliance": "Compliance: how well the mapping predicts the target's own transitions, 1 is exact; of the next best, and "
    'of "no change". Where strength is shown, the likelihood of all transitions decides, and the next best may have more.',
    "error": 'Error: squared, of predicted effects, over that of "no change"; below 1 is better than that.',
    "strength": "Strength: as how many of the target's own instances the source counts where it has data. No source: how "
    "probable it is that these alone predict better.",
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


def _read(kind: Any, **content: Any) -> Any:
    return kind(**{name: tuple(each) if isinstance(each, list) else each for name, each in content.items()})


for _kind in (MappingReport, Contradiction, EvidencePoint, TransferReport):
    register_writer(_kind, lambda one: (type(one).__name__, dict(vars(one))))
    register_reader(_kind.__name__, partial(_read, _kind))
